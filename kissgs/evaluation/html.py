"""HTML report of an evaluation, one file: metrics, images side by side, error maps."""

from __future__ import annotations

import base64
import io
from dataclasses import dataclass
from html import escape
from importlib.resources import files
from string import Template

import numpy as np
from PIL import Image

from kissgs.core.array_types import Float32, UInt8
from kissgs.core.progress import Progress, silent
from kissgs.core.splats import Splats
from kissgs.evaluation.error_maps import INFERNO, full_scale, heat_map, rms_difference, worst_crop
from kissgs.evaluation.evaluate import background_of, render_clamped
from kissgs.evaluation.html_tables import (
    metric_cards,
    other_metrics,
    psnr_change,
    summary_line,
    views_table,
    worst_views_text,
)
from kissgs.evaluation.metric_text import format_metric
from kissgs.evaluation.results import Comparison, Evaluation, ViewComparison
from kissgs.rendering.images import to_bytes
from kissgs.rendering.rasterizer import Device

MAX_VIEWS = 12
"""Largest number of views shown with images, about 10 MB in all."""

MAX_SURROUNDINGS = 4
"""Largest number of views of the surroundings shown with images."""

MAX_SIDE = 1280
"""Longer side of the large images, pixels; larger ones are reduced."""

QUALITY = 90
"""WebP quality of the large images; lossless, they would be five times as large."""

MAX_CROP, MIN_CROP = 160, 64
"""Limits of the side of an enlarged crop, pixels; within them it is half of the image's shorter side."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ReportScene:
    """One of the two scenes of a report.

    Attributes:
        name: name to display.
        splats: the scene, clean.
        bytes: size of its file; None if it has none.
    """

    name: str
    splats: Splats
    bytes: int | None = None


def html_report(
    evaluation: Evaluation,
    reference: ReportScene,
    candidate: ReportScene,
    *,
    device: Device = "cpu",
    threads: int = 0,
    progress: Progress = silent,
) -> str:
    """Return an evaluation as a self-contained HTML page, with styles, script and images embedded.

    The worst :data:`MAX_VIEWS` views are shown with images, the worst first. The worst
    :data:`MAX_SURROUNDINGS` views of the ``surroundings`` follow.

    Args:
        evaluation: evaluation of the two scenes.
        reference: the original scene.
        candidate: the evaluated scene.
        device: see :func:`kissgs.evaluate`.
        threads: number of threads; 0 means one per processor.
        progress: receives the stage ``"html"``.

    Raises:
        InvalidViewsError: a photograph cannot be read.
        UnsupportedError: an image would take too much memory, or CUDA is missing.
    """
    shown, surroundings = select_views(evaluation), evaluation.surroundings
    entries = [(f"view-{i}", evaluation, evaluation.views[i]) for i in shown]
    if surroundings is not None:
        worst_first = sorted(range(len(surroundings.views)), key=lambda i: surroundings.views[i].ranking_psnr)
        entries += [(f"surroundings-{i}", surroundings, surroundings.views[i]) for i in worst_first[:MAX_SURROUNDINGS]]
    worst = min((compared for _, _, compared in entries), key=lambda compared: compared.ranking_psnr)
    full, sections = full_scale(worst.comparison.candidate_vs_reference.psnr), []
    for done, (anchor, group, compared) in enumerate(entries):
        progress("html", done / len(entries))
        view = compared.view
        background = background_of(view, group.background)
        images = _ViewImages(
            reference=render_clamped(reference.splats, view.camera, background, device, threads),
            candidate=render_clamped(candidate.splats, view.camera, background, device, threads),
            photo=view.load_photo() if group.against == "photos" else None,
        )
        sections.append(_section(anchor, compared, images, full))
    progress("html", 1.0)
    return Template(files("kissgs.evaluation").joinpath("report.html").read_text(encoding="utf-8")).substitute(
        title=escape(f"{candidate.name} compared with {reference.name}"),
        reference=escape(reference.name),
        candidate=escape(candidate.name),
        summary=escape(summary_line(evaluation, len(shown)) + _sentence(evaluation.note)),
        cards="\n".join(metric_cards(evaluation, reference.bytes, candidate.bytes)),
        table=views_table(evaluation, shown),
        worst_views=escape(worst_views_text(evaluation)),
        sections="\n".join(sections),
        colours=", ".join("#" + bytes(color).hex() for color in INFERNO),
        quality=QUALITY,
        max_side=MAX_SIDE,
    )


def select_views(evaluation: Evaluation) -> list[int]:
    """Return the indices of the views to show: those of the lowest PSNR, the worst first."""
    views = evaluation.views
    return sorted(range(len(views)), key=lambda i: views[i].ranking_psnr)[:MAX_VIEWS]


def _sentence(note: str) -> str:
    return f" {note[0].upper()}{note[1:]}." if note else ""


@dataclass(frozen=True, slots=True, eq=False)
class _ViewImages:
    reference: Float32[np.ndarray, "H W 3"]
    candidate: Float32[np.ndarray, "H W 3"]
    photo: UInt8[np.ndarray, "H W 3"] | None


def _section(anchor: str, compared: ViewComparison, images: _ViewImages, full: int) -> str:
    name = escape(compared.view.name)
    levels = rms_difference(images.candidate, images.reference)
    crop = worst_crop(levels, max(MIN_CROP, min(MAX_CROP, min(levels.shape) // 2)))
    layers = {
        "reference": to_bytes(images.reference),
        "candidate": to_bytes(images.candidate),
        **({} if images.photo is None else {"photograph": images.photo}),
        "difference": heat_map(levels, full),
    }
    mark, sources = _mark(crop, levels.shape), {layer: _large(pixels) for layer, pixels in layers.items()}
    figures = [_slider(name, sources["reference"], sources["candidate"], mark)]
    if images.photo is not None:
        figures.append(_figure(sources["photograph"], f"photograph {name}", "the photograph"))
    caption = (
        f'<span class="legend">0 <i></i> {full} levels of 255 or more</span>difference of the two '
        "renderings, root mean square over RGB"
    )
    figures.append(_figure(sources["difference"], f"difference in {name}", caption, mark))
    crops = [_figure(_lossless(pixels[crop]), f"{layer}, enlarged", layer) for layer, pixels in layers.items()]
    shape = "tall" if levels.shape[0] > levels.shape[1] else "wide" if images.photo is None else "wide photographed"
    return (
        f'<section class="card" id="{anchor}"><h2>{name}</h2><p class="numbers">{_numbers(compared.comparison)} · '
        f"{compared.pose}</p>"
        f'<div class="images {shape}">{"".join(figures)}</div>'
        f'<div class="crops">{"".join(crops)}</div></section>'
    )


def _numbers(comparison: Comparison) -> str:
    metrics = comparison.candidate_vs_reference
    to_reference = f"candidate to reference {format_metric(metrics.psnr, 2)} dB, {other_metrics(metrics)}"
    if comparison.reference is None:
        return to_reference
    psnr = f"candidate to photograph {format_metric(comparison.candidate.psnr, 2)} dB ({psnr_change(comparison)})"
    return f"{psnr}, {other_metrics(comparison.candidate)} · {to_reference}"


def _slider(name: str, reference: str, candidate: str, mark: str) -> str:
    return (
        f'<figure class="slider"><div class="stage"><img src="{candidate}" alt="candidate, {name}">'
        f'<img class="before" src="{reference}" alt="reference, {name}">{mark}<span class="tag left">reference</span>'
        '<span class="tag right">candidate</span><input type="range" min="0" max="100" value="50" step="0.1" '
        f'aria-label="how much of {name} shows the reference"></div><figcaption>drag to compare; the square is '
        "enlarged below</figcaption></figure>"
    )


def _figure(source: str, alternative: str, caption: str, mark: str = "") -> str:
    return (
        f'<figure><div class="stage"><img src="{source}" alt="{alternative}">{mark}</div>'
        f"<figcaption>{caption}</figcaption></figure>"
    )


def _mark(crop: tuple[slice, slice], shape: tuple[int, ...]) -> str:
    rows, columns = crop
    edges = {"top": rows.start / shape[0], "left": columns.start / shape[1]}
    edges |= {"height": (rows.stop - rows.start) / shape[0], "width": (columns.stop - columns.start) / shape[1]}
    return f'<span class="mark" style="{"; ".join(f"{edge}: {100 * at:.2f}%" for edge, at in edges.items())}"></span>'


def _large(pixels: UInt8[np.ndarray, "H W 3"]) -> str:
    image = Image.fromarray(pixels)
    image.thumbnail((MAX_SIDE, MAX_SIDE), Image.Resampling.BOX)
    return _data_uri(image, quality=QUALITY)


def _lossless(pixels: UInt8[np.ndarray, "H W 3"]) -> str:
    return _data_uri(Image.fromarray(np.ascontiguousarray(pixels)), lossless=True)


def _data_uri(image: Image.Image, **options: int) -> str:
    stream = io.BytesIO()
    image.save(stream, "WEBP", **options)
    return "data:image/webp;base64," + base64.b64encode(stream.getvalue()).decode()
