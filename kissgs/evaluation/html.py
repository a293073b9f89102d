"""An evaluation as one HTML file to look at: figures, pictures side by side, and where they differ."""

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
from kissgs.evaluation.error_maps import STOPS, difference, full_scale, heat_map, worst_place
from kissgs.evaluation.evaluate import over, take_picture
from kissgs.evaluation.html_tables import (
    change_of,
    extremes_lines,
    figure_cards,
    in_words,
    summary_line,
    views_table,
)
from kissgs.evaluation.results import Comparison, Evaluation, ViewComparison, spell
from kissgs.rendering.images import to_bytes
from kissgs.rendering.rasterizer import Device

MOST_VIEWS = 12
"""Shown with pictures: some 10 MB of them."""

MOST_ELSEWHERE = 4
"""Views of the surroundings that are shown with pictures."""

LARGEST = 1280
"""Pixels a side of the large pictures; what is larger is reduced."""

QUALITY = 90
"""Of the large pictures' WebP; lossless, they would take five times as much."""

CROP, SMALLEST_CROP = 160, 64
"""Pixels a side of what is shown enlarged: half of a picture's shorter side, within these."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Side:
    """One of the two scenes: its name for people, its Gaussians, and the bytes of its file if it has one."""

    name: str
    splats: Splats
    bytes: int | None = None


def html_report(
    evaluation: Evaluation,
    reference: Side,
    candidate: Side,
    *,
    device: Device = "cpu",
    threads: int = 0,
    progress: Progress = silent,
) -> str:
    """Write an evaluation as a page that needs nothing beside itself: styles, script and pictures are in it.

    Up to :data:`MOST_VIEWS` views are shown with pictures, evenly chosen, the worst first. Of the ``surroundings``, the
    worst :data:`MOST_ELSEWHERE` follow.

    Args:
        evaluation: of these two scenes.
        reference: the scene as it was, clean.
        candidate: what became of it, clean.
        device: as for the evaluation.
        threads: of the processor; 0 means one each.
        progress: receives the stage ``"html"``.

    Raises:
        InvalidViewsError: a photograph cannot be read.
        UnsupportedError: a picture would take too much memory; no CUDA here.
    """
    shown, around = chosen_views(evaluation), evaluation.surroundings
    parts = [(f"view-{i}", evaluation, evaluation.views[i]) for i in shown]
    if around is not None:
        elsewhere = sorted(range(len(around.views)), key=lambda i: around.views[i].badness)[:MOST_ELSEWHERE]
        parts += [(f"elsewhere-{i}", around, around.views[i]) for i in elsewhere]
    worst = min((compared for _, _, compared in parts), key=lambda compared: compared.badness)
    full, sections = full_scale(worst.comparison.candidate_vs_reference.psnr), []
    for done, (anchor, of, compared) in enumerate(parts):
        progress("html", done / len(parts))
        view, scenes = compared.view, (reference.splats, candidate.splats)
        background = over(view, of.background)
        pictures = [take_picture(scene, view.camera, background, device, threads) for scene in scenes]
        photo = view.load_photo() if of.against == "photos" else None
        sections.append(_section(anchor, compared, _Pictures(pictures[0], pictures[1], photo), full))
    progress("html", 1.0)
    return Template(files("kissgs.evaluation").joinpath("report.html").read_text(encoding="utf-8")).substitute(
        title=escape(f"{candidate.name} compared with {reference.name}"),
        reference=escape(reference.name),
        candidate=escape(candidate.name),
        summary=escape(summary_line(evaluation, len(shown)) + _sentence(evaluation.note)),
        figures="\n".join(figure_cards(evaluation, reference.bytes, candidate.bytes)),
        table=views_table(evaluation, shown),
        extremes=escape(extremes_lines(evaluation)),
        sections="\n".join(sections),
        colours=", ".join("#" + bytes(stop).hex() for stop in STOPS),
        quality=QUALITY,
        largest=LARGEST,
    )


def chosen_views(evaluation: Evaluation) -> list[int]:
    """Which views to show: first that where the scenes' renderings are least alike, then others, evenly spread."""
    count = len(evaluation.views)
    worst = min(range(count), key=lambda i: evaluation.views[i].badness)
    chosen = np.unique(np.rint(np.linspace(0, count - 1, min(count, MOST_VIEWS))).astype(int)).tolist()
    chosen.remove(min(chosen, key=lambda i: abs(i - worst)))
    return [worst, *chosen]


def _sentence(note: str) -> str:
    return f" {note[0].upper()}{note[1:]}." if note else ""


@dataclass(frozen=True, slots=True, eq=False)
class _Pictures:
    reference: Float32[np.ndarray, "H W 3"]
    candidate: Float32[np.ndarray, "H W 3"]
    photo: UInt8[np.ndarray, "H W 3"] | None


def _section(anchor: str, compared: ViewComparison, pictures: _Pictures, full: int) -> str:
    name = escape(compared.view.name)
    levels = difference(pictures.candidate, pictures.reference)
    place = worst_place(levels, max(SMALLEST_CROP, min(CROP, min(levels.shape) // 2)))
    layers = {
        "reference": to_bytes(pictures.reference),
        "candidate": to_bytes(pictures.candidate),
        **({} if pictures.photo is None else {"photograph": pictures.photo}),
        "difference": heat_map(levels, full),
    }
    mark, images = _mark(place, levels.shape), {layer: _large(image) for layer, image in layers.items()}
    figures = [_slider(name, images["reference"], images["candidate"], mark)]
    if pictures.photo is not None:
        figures.append(_picture(images["photograph"], f"photograph {name}", "the photograph"))
    caption = (
        f'<span class="legend">0 <i></i> {full} levels of 255 or more</span>the difference of the two '
        "renderings, root mean square over red, green and blue"
    )
    figures.append(_picture(images["difference"], f"difference in {name}", caption, mark))
    crops = [_picture(_lossless(image[place]), f"{layer}, enlarged", layer) for layer, image in layers.items()]
    shape = "tall" if levels.shape[0] > levels.shape[1] else "wide" if pictures.photo is None else "wide photographed"
    return (
        f'<section class="card" id="{anchor}"><h2>{name}</h2><p class="numbers">{_numbers(compared.comparison)} · '
        f"{compared.place}</p>"
        f'<div class="pictures {shape}">{"".join(figures)}</div>'
        f'<div class="crops">{"".join(crops)}</div></section>'
    )


def _numbers(comparison: Comparison) -> str:
    found = comparison.candidate_vs_reference
    between = f"candidate to reference {spell(found.psnr, 2)} dB, {in_words(found)}"
    if comparison.reference is None:
        return between
    candidate = f"candidate to photograph {spell(comparison.candidate.psnr, 2)} dB ({change_of(comparison)})"
    return f"{candidate}, {in_words(comparison.candidate)} · {between}"


def _slider(name: str, reference: str, candidate: str, mark: str) -> str:
    return (
        f'<figure class="slider"><div class="stage"><img src="{candidate}" alt="candidate, {name}">'
        f'<img class="before" src="{reference}" alt="reference, {name}">{mark}<span class="tag left">reference</span>'
        '<span class="tag right">candidate</span><input type="range" min="0" max="100" value="50" step="0.1" '
        f'aria-label="how much of {name} shows the reference"></div><figcaption>drag to compare; the square is '
        "enlarged below</figcaption></figure>"
    )


def _picture(source: str, alternative: str, caption: str, mark: str = "") -> str:
    return (
        f'<figure><div class="stage"><img src="{source}" alt="{alternative}">{mark}</div>'
        f"<figcaption>{caption}</figcaption></figure>"
    )


def _mark(place: tuple[slice, slice], shape: tuple[int, ...]) -> str:
    rows, columns = place
    edges = {"top": rows.start / shape[0], "left": columns.start / shape[1]}
    edges |= {"height": (rows.stop - rows.start) / shape[0], "width": (columns.stop - columns.start) / shape[1]}
    return f'<span class="mark" style="{"; ".join(f"{edge}: {100 * at:.2f}%" for edge, at in edges.items())}"></span>'


def _large(pixels: UInt8[np.ndarray, "H W 3"]) -> str:
    image = Image.fromarray(pixels)
    image.thumbnail((LARGEST, LARGEST), Image.Resampling.BOX)
    return _data_uri(image, quality=QUALITY)


def _lossless(pixels: UInt8[np.ndarray, "H W 3"]) -> str:
    return _data_uri(Image.fromarray(np.ascontiguousarray(pixels)), lossless=True)


def _data_uri(image: Image.Image, **options: int) -> str:
    stream = io.BytesIO()
    image.save(stream, "WEBP", **options)
    return "data:image/webp;base64," + base64.b64encode(stream.getvalue()).decode()
