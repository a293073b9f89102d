"""What ``kissgs bench --plot`` draws: speed, size, quality, parts and stages of one scene; or times over its size."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from kissgs.benchmark.bd_rate import pareto
from kissgs.benchmark.plots import MARKERS, new_figure
from kissgs.benchmark.results import Figure as Quality
from kissgs.benchmark.results import Measured

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from matplotlib.text import Annotation

INK, FAINT = "#222222", "#999999"

COLOURS = (*(f"C{n}" for n in (0, 1, 2, 3, 4, 5, 6, 8, 9)), "#1a3a6b", "#8a6d00", "#7fbf7b")
GREYS = {"all else": FAINT, "another tool's file": "#cccccc"}

PLACES = ((8, 6), (8, -13), (-8, 6), (-8, -13), (0, 11), (0, -18), (14, 18), (-14, 18), (14, -26), (-14, -26))
"""Where the label of a point may stand, in points from it: the first at which it covers nothing is taken."""

METADATA = ("container_meta.yaml", "meta.json", "scene.json")

FEW = 0.015
"""Share of the longest bar below which parts are drawn as "all else"."""

Parts = Sequence[tuple[str, Mapping[str, float]]]


def comparison_plot(rows: Sequence[Measured], path: Path) -> None:
    """One scene, its pictures compared: speed-size, size-quality with Pareto front, bytes by file, seconds by stage.

    Raises:
        OutputError: the file system refuses.
        UnsupportedError: there is no matplotlib, or no such format.
    """
    photographed = any(row.psnr("photographs") is not None for row in rows)
    layout: list[Any] = [["speed", "original"], ["bytes", "stages"]]
    if photographed:
        layout = [["speed", "speed"], ["original", "photographs"], ["bytes", "stages"]]
    whole = [row for row in rows if row.quality_offset_db is None]
    with new_figure(path, 10, 11.5 if photographed else 8.5) as figure:
        panels = figure.subplot_mosaic(layout)
        _bars(panels["bytes"], [(row.name, _kilobytes(row)) for row in whole], "kilobytes, by file")
        ours = [(row.name, row.took.stage_seconds) for row in whole if not row.is_peer]
        _bars(panels["stages"], ours, "seconds, by stage")
        labels = {"speed": _speed(panels["speed"], whole), "original": _quality(panels["original"], rows, "original")}
        if photographed:
            labels["photographs"] = _quality(panels["photographs"], rows, "photographs")
        figure.draw_without_rendering()  # only then it is known where points lie
        for name, of in labels.items():
            _spread(figure, panels[name], of)


def growth_plot(rows: Sequence[Measured], path: Path) -> None:
    """Seconds of each stage over the number of Gaussians, both logarithmic; a panel for each preset.

    Raises:
        OutputError: the file system refuses.
        UnsupportedError: there is no matplotlib, or no such format.
    """
    presets = list(dict.fromkeys(row.encoder for row in rows))
    stages = list(dict.fromkeys(stage for row in rows for stage in row.took.stage_seconds))
    across = min(len(presets), 2)
    down = -(-len(presets) // across)
    times = [seconds for row in rows for seconds in (*row.took.stage_seconds.values(), row.took.encode_seconds)]
    low, high = max(min(times), 1e-3) / 1.5, max(*times, 1e-2) * 1.5
    with new_figure(path, 10, 1 + 4 * down) as figure:
        panels = figure.subplots(down, across, squeeze=False).ravel()
        for axes in panels[len(presets) :]:
            axes.set_axis_off()
        for axes, preset in zip(panels, presets, strict=False):
            of = sorted((row for row in rows if row.encoder == preset), key=lambda row: row.gaussians)
            _times(axes, of, stages)
            axes.set(title=preset, yscale="log", ylim=(low, high), ylabel="seconds")
            marks = [10.0**power for power in range(-4, 6) if low <= 10.0**power <= high]
            axes.set_yticks(marks, [f"{mark:,g}" for mark in marks])
            axes.minorticks_off()
            axes.grid(alpha=0.3)
        handles = {
            name: handle for axes in panels for handle, name in zip(*axes.get_legend_handles_labels(), strict=True)
        }
        figure.legend(handles.values(), handles.keys(), loc="outside lower center", ncols=6, fontsize="small")


def _times(axes: Axes, rows: Sequence[Measured], stages: Sequence[str]) -> None:
    """A line for each stage that there is, alike in all panels, and a thick one for all together."""
    counts = [row.gaussians for row in rows]
    for number, stage in enumerate(stages):
        seconds = [row.took.stage_seconds.get(stage, 0.0) or math.nan for row in rows]
        style = {"color": COLOURS[number % len(COLOURS)], "marker": MARKERS[number % len(MARKERS)]}
        if not all(map(math.isnan, seconds)):
            axes.plot(counts, seconds, label=stage, markersize=4, linewidth=1.2, **style)  # type: ignore[arg-type]
    whole = [row.took.encode_seconds for row in rows]
    axes.plot(counts, whole, label="together", marker="o", markersize=5, linewidth=2.2, color=INK)
    axes.set(xscale="log", xlabel="Gaussians")
    axes.set_xticks(counts, [_count(count) for count in counts])


def _speed(axes: Axes, rows: Sequence[Measured]) -> list[Annotation]:
    """Of presets and peers; a better one lies further down and to the left."""
    places = [(row.took.encode_cpu_seconds, row.bytes / max(row.gaussians, 1)) for row in rows]
    labels = _points(axes, rows, places)
    axes.set(xscale="log", xlabel="encoding, CPU seconds", ylabel="bytes per Gaussian")
    axes.set_ylim(0, 1.15 * max(size for _, size in places))
    _tick(axes, [seconds for seconds, _ in places])
    return labels


def _quality(axes: Axes, rows: Sequence[Measured], quality: Quality) -> list[Annotation]:
    """Curves, presets and peers, and the front of them all; a better one lies further up and to the left."""
    places = [(row.bytes / 1000, row.psnr(quality)) for row in rows]
    known = [(row, (x, y)) for row, (x, y) in zip(rows, places, strict=True) if y is not None and math.isfinite(y)]
    front = [known[index][1] for index in pareto([place for _, place in known])]
    if front:
        style = {"color": "#e8c860", "linewidth": 5, "alpha": 0.6, "solid_joinstyle": "round"}
        axes.step(*zip(*front, strict=True), where="post", label="Pareto front", zorder=1, **style)  # type: ignore[arg-type]
    for number, preset in enumerate(
        dict.fromkeys(row.encoder for row, _ in known if row.quality_offset_db is not None)
    ):
        curve = sorted(place for row, place in known if row.encoder == preset)
        line = ("-", "--", ":")[number % 3]
        label = f"{preset}, by quality_offset_db"
        axes.plot(*zip(*curve, strict=True), line, color=INK, marker=".", linewidth=1.2, label=label)
    whole = [(row, place) for row, place in known if row.quality_offset_db is None]
    labels = _points(axes, [row for row, _ in whole], [place for _, place in whole])
    what = "the scene's own pictures" if quality == "original" else "photographs"
    if quality == "photographs":
        means = [row.pictures.mean.reference for row, _ in known if row.pictures is not None]
        itself = next((mean.psnr for mean in means if mean is not None), math.nan)
        if math.isfinite(itself):
            axes.axhline(itself, color=FAINT, linewidth=1, linestyle="--", label="the scene as it was")
    axes.set(xscale="log", xlabel="kilobytes", ylabel=f"PSNR to {what}, dB")
    _tick(axes, [size for _, (size, _) in known])
    if axes.get_legend_handles_labels()[0]:
        axes.legend(loc="lower right", fontsize="small")
    return labels


def _points(axes: Axes, rows: Sequence[Measured], places: Sequence[tuple[float, float]]) -> list[Annotation]:
    """Presets as filled circles, peers as open squares, each with its name."""
    labels = []
    for row, place in zip(rows, places, strict=True):
        style = {"marker": "s", "facecolors": "white"} if row.is_peer else {"marker": "o", "facecolors": "#c0392b"}
        axes.scatter(*place, s=44, edgecolors="#c0392b", linewidths=1.5, zorder=3, **style)  # type: ignore[arg-type]
        labels.append(axes.annotate(row.name, place, textcoords="offset points", xytext=PLACES[0], fontsize=10))
    return labels


def _tick(axes: Axes, values: Sequence[float]) -> None:
    """A logarithmic axis around the values, in words that people read."""
    low, high = min(values, default=1.0) * 0.8, max(values, default=1.0) * 1.35
    ticks = [digit * 10.0**power for power in range(-4, 10) for digit in (1, 2, 5)]
    ticks = [tick for tick in ticks if low <= tick <= high]
    axes.set_xlim(low, high)
    axes.set_xticks(ticks, [f"{tick:,.4g}" for tick in ticks])
    axes.minorticks_off()
    axes.grid(alpha=0.3)


def _spread(figure: Figure, axes: Axes, labels: Sequence[Annotation]) -> None:
    """Move labels to where they cover least: of points, lines, each other, and what stands in the corner."""
    dot = figure.dpi / 72 * 5
    points = axes.transData.transform([label.xy for label in labels])
    taken = [_around(point, dot) for point in points]
    for line in axes.get_lines():
        corners = line.get_transform().transform(line.get_xydata())
        taken += [_around(place, 1) for a, b in pairwise(corners) for place in np.linspace(a, b, 40)]
    legend = axes.get_legend()
    if legend is not None:
        taken.append(tuple(legend.get_window_extent().extents))
    inside = axes.get_window_extent()
    for label in labels:
        places = []
        for number, offset in enumerate(PLACES):
            _put(label, offset)
            x0, y0, x1, y1 = box = tuple(label.get_window_extent().extents)
            outside = x0 < inside.x0 or x1 > inside.x1 or y0 < inside.y0 or y1 > inside.y1
            own = _distance(box, axes.transData.transform(label.xy))
            mistaken = sum(_distance(box, point) < 1.5 * own for point in points) - 1
            places.append((outside, sum(_overlap(box, other) for other in taken) + 10 * mistaken, number, box))
        *_, best, box = min(places)
        _put(label, PLACES[best])
        taken += [box] * 40  # worse to cover than a line


def _put(label: Annotation, offset: tuple[int, int]) -> None:
    label.set_position(offset)
    label.set_horizontalalignment("left" if offset[0] > 0 else "right" if offset[0] < 0 else "center")


def _around(place: np.ndarray, reach: float) -> tuple[float, ...]:
    return place[0] - reach, place[1] - reach, place[0] + reach, place[1] + reach


def _distance(box: tuple[float, ...], place: np.ndarray) -> float:
    """From the box to the place, 1 at least."""
    across = max(box[0] - place[0], place[0] - box[2], 0)
    along = max(box[1] - place[1], place[1] - box[3], 0)
    return max(math.hypot(across, along), 1.0)


def _overlap(one: tuple[float, ...], other: tuple[float, ...]) -> bool:
    return one[0] < other[2] and other[0] < one[2] and one[1] < other[3] and other[1] < one[3]


def _bars(axes: Axes, bars: Parts, title: str) -> None:
    """Stacked, the first on top. What would be too thin to see is told as all else."""
    longest = max((sum(parts.values()) for _, parts in bars), default=0.0) or 1.0
    names = dict.fromkeys(part for _, parts in bars for part in parts)
    told = [name for name in names if max(parts.get(name, 0.0) for _, parts in bars) >= FEW * longest]
    rest = [name for name in names if name not in told]
    rows, left = range(len(bars)), np.zeros(len(bars))
    for name in [*told, *(["all else"] if rest else [])]:
        of = rest if name == "all else" else [name]
        widths = np.array([sum(parts.get(part, 0.0) for part in of) for _, parts in bars])
        colour = GREYS.get(name) or COLOURS[told.index(name) % len(COLOURS)]
        axes.barh(rows, widths, left=left, label=name, color=colour, edgecolor="white", linewidth=0.6)
        left += widths
    for row, end in zip(rows, left, strict=True):
        text = f"{end:,.3g}" if end < 100 else f"{end:,.0f}"
        place = (float(end), row)
        axes.annotate(text, place, xytext=(4, 0), textcoords="offset points", va="center", fontsize=9)
    axes.set_xlim(0, 1.15 * longest)
    axes.set_yticks(rows, [name for name, _ in bars])
    axes.invert_yaxis()
    axes.set_xlabel(title)
    axes.legend(loc="upper center", bbox_to_anchor=(0.45, -0.16), ncols=3, fontsize=8.5, frameon=False)


def _kilobytes(row: Measured) -> dict[str, float]:
    """By file without its ending, the three of metadata in one; of a peer, all in one."""
    if row.is_peer:
        return {"another tool's file": row.bytes / 1000}
    planes = {name.removesuffix(".webp"): size / 1000 for name, size in row.file_bytes.items() if name not in METADATA}
    return {**planes, "metadata": sum(row.file_bytes.get(name, 0) for name in METADATA) / 1000}


def _count(count: int) -> str:
    return f"{count / 1e6:.3g}M" if count >= 1e6 else f"{count / 1000:.3g}k" if count >= 1000 else str(count)
