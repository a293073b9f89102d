"""HTML report of an evaluation, one file: metrics, images side by side, error maps."""

from __future__ import annotations

import base64
import io
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from html import escape
from importlib.resources import files
from string import Template

import numpy as np
from PIL import Image, ImageColor

from kissgs.core.array_types import Float32, UInt8
from kissgs.core.context import DEFAULT_CONTEXT, Context
from kissgs.core.splats import Splats
from kissgs.evaluation.evaluate import background_of, render_clamped
from kissgs.evaluation.results import LARGE_LOSS, Comparison, Evaluation, ViewComparison, format_metric
from kissgs.rendering.images import to_bytes
from kissgs.rendering.metrics import PATCH, patch_edges

# Error maps: differences of two images per pixel, as colours, and the crop with the largest error.

INFERNO = ("#000004", "#1b0c41", "#4a0c6b", "#781c6d", "#a52c60", "#cf4446", "#ed6925", "#fb9b06", "#f7d13d", "#fcffa4")
"""Matplotlib's colour map "inferno" at ten points: its lightness grows evenly."""

FULL_SCALES = (1, 2, 3, 5, 10, 15, 20, 30, 50, 100, 255)  # of 255 levels, for which the brightest colour may stand
WINDOW = 32  # side of the square over which the largest error is searched, pixels


def rms_difference(
    image: Float32[np.ndarray, "H W 3"], other: Float32[np.ndarray, "H W 3"]
) -> Float32[np.ndarray, "H W"]:
    """Return the root mean square error over RGB of each pixel, in levels of an 8-bit image, 0 to 255."""
    return np.asarray(255 * np.sqrt(np.square(image - other).mean(axis=2)), np.float32)


def full_scale(psnr: float) -> int:
    """Return the error, in levels, of the brightest colour: one of FULL_SCALES above four times the RMS error."""
    wanted = 4 * 255 * 10 ** (-psnr / 20) if math.isfinite(psnr) else 0.0
    return next((scale for scale in FULL_SCALES if scale >= wanted), FULL_SCALES[-1])


def heat_map(levels: Float32[np.ndarray, "H W"], full: float) -> UInt8[np.ndarray, "H W 3"]:
    """Return ``levels`` as RGB colours, black for 0 to pale yellow for ``full`` and above; NaN counts as ``full``."""
    steps, channels = np.linspace(0, 255, len(INFERNO)), zip(*map(ImageColor.getrgb, INFERNO), strict=True)
    table = np.stack([np.interp(np.arange(256), steps, channel) for channel in channels], axis=1)
    share = np.nan_to_num(levels / full, nan=1.0).clip(0, 1)
    return np.rint(table).astype(np.uint8)[np.rint(share * 255).astype(np.uint8)]


def worst_crop(levels: Float32[np.ndarray, "H W"], side: int) -> tuple[slice, slice]:
    """Return rows and columns of a square of ``side`` pixels around the :data:`WINDOW` of the largest mean square."""
    height, width = levels.shape
    down, across = min(WINDOW, height), min(WINDOW, width)
    squares = np.square(np.nan_to_num(levels.astype(np.float64), nan=255.0))
    corners = np.pad(squares, ((1, 0), (1, 0))).cumsum(axis=0).cumsum(axis=1)
    strips = corners[down:] - corners[:-down]
    sums = strips[:, across:] - strips[:, :-across]  # over every window
    top, left = np.unravel_index(sums.argmax(), sums.shape)
    if sums[top, left] <= 0:
        top, left = (height - down) // 2, (width - across) // 2
    return _interval(int(top) + down // 2, side, height), _interval(int(left) + across // 2, side, width)


def _interval(middle: int, side: int, length: int) -> slice:
    start = max(0, min(middle - side // 2, length - side))
    return slice(start, min(start + side, length))


# Text and tables of the page.


def _cards(evaluation: Evaluation, before: int | None, after: int | None) -> Iterator[tuple[str, str, str]]:
    """Yield name, value and remark of each mean, and of the bytes of both files if known."""
    mean, to_reference = evaluation.mean, evaluation.mean.candidate_vs_reference.texts()
    if mean.reference is not None:
        of_reference, of_candidate = mean.reference.texts(), mean.candidate.texts()
        change = f"{_signed(mean.change or 0.0, 2)} dB: the reference has {of_reference.pop('PSNR')} dB"
        yield "PSNR, candidate to photographs", f"{of_candidate.pop('PSNR')} dB", change
        for name, text in of_candidate.items():
            yield f"{name}, candidate to photographs", text, f"the reference has {of_reference[name]}"
    psnr = to_reference.pop("PSNR")
    others = ", ".join(f"{name} {text}" for name, text in to_reference.items())
    yield "PSNR, candidate to reference", f"{psnr} dB", f"of their renderings; {others}"
    worst = evaluation.worst.comparison.candidate_vs_reference.texts()["PSNR"]
    yield "PSNR, worst view", f"{worst} dB", f"{format_metric(evaluation.fifth_percentile, 2)} dB is the 5th percentile"
    detail = evaluation.detail
    remark = (
        f"to {'photographs' if mean.reference else 'the reference'}, patches of {PATCH}×{PATCH} pixels; worst one "
        f"{_signed(detail.worst)}, {format_metric(100 * detail.share_below, 2)} % lose more than {LARGE_LOSS}"
    )
    yield "SSIM, worst 1 % of patches", _signed(detail.worst_percent), remark
    counts = f"{evaluation.candidate_count:,} of {evaluation.reference_count:,} Gaussians"
    if before and after:
        change = f"{before / after:.1f}× smaller" if before >= after else f"{after / before:.1f}× larger"
        yield "Size", change, f"{before / 1e6:,.2f} → {after / 1e6:,.2f} MB; {counts}"
    else:
        yield "Gaussians", f"{evaluation.candidate_count:,}", counts


def _signed(change: float, digits: int = 4) -> str:
    return _red_if_negative(format_metric(change, digits, signed=True))


def _red_if_negative(text: str) -> str:
    return f'<span class="worse">−{text[1:]}</span>' if text.startswith("-") else text


def _views_table(evaluation: Evaluation, shown: Sequence[int]) -> str:
    """Return a table with a row for each view, linked to its images if it is among ``shown``, and the means."""
    mean = evaluation.mean
    metrics = list(mean.candidate_vs_reference.texts())
    groups = [("candidate to reference", metrics)]
    if mean.reference is not None:
        to_photo = [(f"{side} to photograph", metrics) for side in ("reference", "candidate")]
        groups = [*to_photo, ("change", ["dB"]), *groups]
    upper = "".join(f'<th colspan="{len(columns)}">{title}</th>' for title, columns in groups)
    lower = "".join(f"<th>{column}</th>" for _, columns in groups for column in columns)
    names = [escape(compared.view.name) for compared in evaluation.views]
    links = [f'<a href="#view-{i}">{name}</a>' if i in shown else name for i, name in enumerate(names)]
    rows = [_row(link, compared.comparison) for link, compared in zip(links, evaluation.views, strict=True)]
    return (
        f"<table><thead><tr><th></th>{upper}</tr><tr><th>view</th>{lower}</tr></thead>"
        f"<tbody>{''.join(rows)}</tbody><tfoot>{_row('mean', mean)}</tfoot></table>"
    )


def _row(name: str, comparison: Comparison) -> str:
    cells = "".join(f"<td>{_red_if_negative(cell)}</td>" for cell in comparison.cells())
    return f"<tr><td>{name}</td>{cells}</tr>"


MAX_VIEWS = 12  # largest number of views shown with images, about 10 MB in all
MAX_SURROUNDINGS = 4  # largest number of views of the surroundings shown with images
MAX_PATCHES = 6  # largest number of patches shown, those that lose most SSIM
MAX_SIDE = 1280  # longer side of the large images, pixels; larger ones are reduced
QUALITY = 90  # WebP quality of the large images; lossless, they would be five times as large
MAX_CROP, MIN_CROP = 160, 64  # side of an enlarged crop, pixels; within these, half of the image's shorter side


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ReportScene:
    """One of the two scenes of a report, clean; ``bytes`` is the size of its file, if it has one."""

    name: str
    splats: Splats
    bytes: int | None = None


def html_report(
    evaluation: Evaluation, reference: ReportScene, candidate: ReportScene, context: Context = DEFAULT_CONTEXT
) -> str:
    """Return an evaluation as one HTML page with images of the worst views, then of the worst surroundings."""
    shown = _worst_first(evaluation)[:MAX_VIEWS]
    entries = [(f"view-{i}", evaluation, evaluation.views[i]) for i in shown]
    beyond = ""
    if (around := evaluation.surroundings) is not None:
        mean = around.mean.candidate_vs_reference.summary
        beyond = f" Surroundings, {around.views_used} ({around.source}): {mean}; {around.extremes}."
        worst = _worst_first(around)[:MAX_SURROUNDINGS]
        entries += [(f"surroundings-{i}", around, around.views[i]) for i in worst]
    lowest = min((compared for _, _, compared in entries), key=lambda compared: compared.ranking_psnr)
    full, sections = full_scale(lowest.comparison.candidate_vs_reference.psnr), []
    for done, (anchor, group, compared) in enumerate(entries):
        context.progress("html", done / len(entries))
        renderings, photo = _images(group, compared, (reference, candidate), context)
        sections.append(_section(anchor, compared, renderings, photo, full))
    patches = _worst_patches(evaluation, (reference, candidate), context)
    context.progress("html", 1.0)
    images = "Their images are" if len(shown) == len(evaluation.views) else f"Images of the worst {len(shown)} are"
    used = f"{evaluation.views_used}, {evaluation.size.replace('x', '×')}: {evaluation.source}"
    summary = f"{used}. {images} below, the worst first."
    if evaluation.note:
        summary += f" {evaluation.note[0].upper()}{evaluation.note[1:]}."
    return Template(files("kissgs.evaluation").joinpath("report.html").read_text(encoding="utf-8")).substitute(
        title=escape(f"{candidate.name} compared with {reference.name}"),
        reference=escape(reference.name),
        candidate=escape(candidate.name),
        summary=escape(summary),
        cards="\n".join(
            f'<div class="card"><dt>{name}</dt><dd>{value}</dd><dd class="remark">{remark}</dd></div>'
            for name, value, remark in _cards(evaluation, reference.bytes, candidate.bytes)
        ),
        table=_views_table(evaluation, shown),
        worst_views=escape(f"Candidate to reference: {evaluation.extremes}.{beyond}"),
        sections="\n".join([patches, *sections]),
        colours=", ".join(INFERNO),
        quality=QUALITY,
        max_side=MAX_SIDE,
    )


def _worst_first(evaluation: Evaluation) -> list[int]:
    """Return the indices of all views, that of the lowest PSNR first."""
    return sorted(range(len(evaluation.views)), key=lambda i: evaluation.views[i].ranking_psnr)


Patch = tuple[int, int, int]  # index of a view, and row and column of a patch in it


def _worst_patches(evaluation: Evaluation, scenes: Sequence[ReportScene], context: Context) -> str:
    """Return a section with crops around the patches that lose most detail, the worst first and none beside another;
    empty without any loss."""
    remaining = [np.where(np.isnan(view.patch_changes), -np.inf, view.patch_changes) for view in evaluation.views]
    patches, figures = list[Patch](), dict[Patch, str]()
    while len(patches) < MAX_PATCHES:
        i = min(range(len(remaining)), key=lambda each: remaining[each].min())
        row, column = map(int, np.unravel_index(remaining[i].argmin(), remaining[i].shape))
        if remaining[i][row, column] >= 0:
            break
        remaining[i][max(row - 2, 0) : row + 3, max(column - 2, 0) : column + 3] = np.inf
        patches.append((i, row, column))
    for i in dict.fromkeys(i for i, _, _ in patches):
        compared = evaluation.views[i]
        renderings, photo = _images(evaluation, compared, scenes, context)
        layers = {} if photo is None else {"photograph": photo}
        layers |= zip(("reference", "candidate"), map(to_bytes, renderings), strict=True)
        figures |= {patch: _patch(compared, patch, layers) for patch in patches if patch[0] == i}
    if not patches:
        return ""
    target = "the reference" if evaluation.against == "renderings" else "the photograph"
    return (
        '<section class="card"><h2>Patches that lose most detail</h2><p class="numbers">The square marks a patch of '
        f"{PATCH}×{PATCH} pixels; the figure is its change of SSIM to {target}.</p>"
        f'<div class="patches">{"".join(figures[patch] for patch in patches)}</div></section>'
    )


def _patch(compared: ViewComparison, patch: Patch, layers: dict[str, UInt8[np.ndarray, "H W 3"]]) -> str:
    """Return a patch and as much on either side of it, cut from each of these images of a view."""
    view, place = compared.view, patch[1:]
    sides, crop, inside = (view.camera.height, view.camera.width), list[slice](), list[slice]()
    for number, length in zip(place, sides, strict=True):
        start, stop = map(int, patch_edges(length)[number : number + 2])
        crop.append(_interval((start + stop) // 2, 3 * PATCH, length))
        inside.append(slice(start - crop[-1].start, stop - crop[-1].start))
    rows, columns = crop
    mark = _mark((inside[0], inside[1]), (rows.stop - rows.start, columns.stop - columns.start))
    name = escape(view.name)
    images = [
        _figure(_lossless(pixels[rows, columns]), f"{layer}, part of {name}", layer, mark)
        for layer, pixels in layers.items()
    ]
    change = _signed(float(compared.patch_changes[place[0], place[1]]))
    return f'<div><h3>{name} <small>{change}</small></h3><div class="crops">{"".join(images)}</div></div>'


def _images(
    evaluation: Evaluation, compared: ViewComparison, scenes: Sequence[ReportScene], context: Context
) -> tuple[list[Float32[np.ndarray, "H W 3"]], UInt8[np.ndarray, "H W 3"] | None]:
    """Return the renderings of both scenes from a view, and its photograph if it was compared with that."""
    view, background = compared.view, background_of(compared.view, evaluation.background)
    renderings = [render_clamped(scene.splats, view.camera, background, context) for scene in scenes]
    return renderings, view.load_photo() if evaluation.against == "photos" else None


def _section(
    anchor: str,
    compared: ViewComparison,
    renderings: Sequence[Float32[np.ndarray, "H W 3"]],
    photo: UInt8[np.ndarray, "H W 3"] | None,
    full: int,
) -> str:
    """Return the images of a view; the renderings are those of reference and candidate."""
    name, (reference, candidate) = escape(compared.view.name), renderings
    levels = rms_difference(candidate, reference)
    crop = worst_crop(levels, max(MIN_CROP, min(MAX_CROP, min(levels.shape) // 2)))
    layers = {"reference": to_bytes(reference), "candidate": to_bytes(candidate)}
    layers |= {} if photo is None else {"photograph": photo}
    layers["difference"] = heat_map(levels, full)
    mark, sources = _mark(crop, levels.shape), dict[str, str]()
    for layer, pixels in layers.items():
        image = Image.fromarray(pixels)
        image.thumbnail((MAX_SIDE, MAX_SIDE), Image.Resampling.BOX)
        sources[layer] = _data_uri(image, quality=QUALITY)
    figures = [
        f'<figure class="slider"><div class="stage"><img src="{sources["candidate"]}" alt="candidate, {name}">'
        f'<img class="before" src="{sources["reference"]}" alt="reference, {name}">{mark}'
        '<span class="tag left">reference</span><span class="tag right">candidate</span>'
        '<input type="range" min="0" max="100" value="50" step="0.1" '
        f'aria-label="how much of {name} shows the reference"></div><figcaption>drag to compare; the square is '
        "enlarged below</figcaption></figure>"
    ]
    if photo is not None:
        figures.append(_figure(sources["photograph"], f"photograph {name}", "the photograph"))
    caption = (
        f'<span class="legend">0 <i></i> {full} levels of 255 or more</span>difference of the two '
        "renderings, root mean square over RGB"
    )
    figures.append(_figure(sources["difference"], f"difference in {name}", caption, mark))
    crops = [_figure(_lossless(pixels[crop]), f"{layer}, enlarged", layer) for layer, pixels in layers.items()]
    shape = "tall" if levels.shape[0] > levels.shape[1] else "wide" if photo is None else "wide photographed"
    comparison = compared.comparison
    numbers = f"candidate to reference {comparison.candidate_vs_reference.summary}"
    if comparison.change is not None:
        change = _signed(comparison.change, 2)
        numbers = f"candidate to photograph {comparison.candidate.summary}, change {change} dB · {numbers}"
    return (
        f'<section class="card" id="{anchor}"><h2>{name}</h2><p class="numbers">{numbers} · {compared.pose}</p>'
        f'<div class="images {shape}">{"".join(figures)}</div>'
        f'<div class="crops">{"".join(crops)}</div></section>'
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


def _lossless(pixels: UInt8[np.ndarray, "H W 3"]) -> str:
    return _data_uri(Image.fromarray(np.ascontiguousarray(pixels)), lossless=True)


def _data_uri(image: Image.Image, **options: int) -> str:
    stream = io.BytesIO()
    image.save(stream, "WEBP", **options)
    return "data:image/webp;base64," + base64.b64encode(stream.getvalue()).decode()
