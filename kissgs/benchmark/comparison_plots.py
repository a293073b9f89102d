"""Plot of codec measurements on one scene: speed, size, quality, files and stages."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from kissgs.benchmark.bd_rate import pareto_front
from kissgs.benchmark.plots import new_figure
from kissgs.benchmark.results import Measurement, PsnrTarget, curve_name, curves

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from matplotlib.text import Annotation

BLACK, GREY = "#222222", "#999999"

COLOURS = (*(f"C{n}" for n in (0, 1, 2, 3, 4, 5, 6, 8, 9)), "#1a3a6b", "#8a6d00", "#7fbf7b")
"""Colours of files and stages, in order."""

OTHER, EXTERNAL = "other", "file of an external codec"
GREYS = {OTHER: GREY, EXTERNAL: "#cccccc"}

LABEL_OFFSETS = ((8, 6), (8, -13), (-8, 6), (-8, -13), (0, 11), (0, -18), (14, 18), (-14, 18), (14, -26), (-14, -26))
"""Candidate positions of a label relative to its point, in typographic points, preferred ones first."""

METADATA = ("container_meta.yaml", "meta.json", "scene.json")

MIN_PART = 0.015
"""Parts shorter than this share of the longest bar are merged into :data:`OTHER`."""

Parts = Sequence[tuple[str, Mapping[str, float]]]
"""Bars of a stacked bar chart: the name of each, and the length of its parts by name."""


def comparison_plot(rows: Sequence[Measurement], path: Path) -> None:
    """Plot one scene: size over speed, quality over size with the Pareto front, bytes by file, seconds by stage.

    Args:
        rows: measurements of one scene, with evaluations.
        path: file to write, ``.svg``, ``.png`` or ``.pdf``; overwritten.

    Raises:
        OutputError: the file cannot be written.
        UnsupportedError: matplotlib is not installed, or the format is unknown.
    """
    photographed = any(row.psnr("photographs") is not None for row in rows)
    layout: list[Any] = [["speed", "original"], ["bytes", "stages"]]
    if photographed:
        layout = [["speed", "speed"], ["original", "photographs"], ["bytes", "stages"]]
    whole = [row for row in rows if row.quality_offset_db is None]
    with new_figure(path, 10, 11.5 if photographed else 8.5) as figure:
        panels = figure.subplot_mosaic(layout)
        _bars(panels["bytes"], [(row.name, _kilobytes(row)) for row in whole], "kilobytes, by file")
        stages = [(row.name, row.median_run.stage_seconds) for row in whole if not row.is_external]
        _bars(panels["stages"], stages, "seconds, by stage")
        labels = {
            "speed": _speed(panels["speed"], whole),
            "original": quality_panel(panels["original"], rows, "original"),
        }
        if photographed:
            labels["photographs"] = quality_panel(panels["photographs"], rows, "photographs")
        figure.draw_without_rendering()  # the positions of points are known only after the layout
        for name, panel_labels in labels.items():
            place_labels(figure, panels[name], panel_labels)


def _speed(axes: Axes, rows: Sequence[Measurement]) -> list[Annotation]:
    """Draw size over encoding time of presets and external codecs; better ones are further down and left."""
    positions = [(row.median_run.encode_cpu_seconds, row.bytes / max(row.gaussians, 1)) for row in rows]
    labels = labelled_points(axes, rows, positions)
    axes.set(xscale="log", xlabel="encoding, CPU seconds", ylabel="bytes per Gaussian")
    axes.set_ylim(0, 1.15 * max(size for _, size in positions))
    set_log_axis(axes, [seconds for seconds, _ in positions])
    return labels


def quality_panel(axes: Axes, rows: Sequence[Measurement], target: PsnrTarget) -> list[Annotation]:
    """Draw quality over size, as curves, points and their Pareto front; better ones are further up and left."""
    positions = [(row.bytes / 1000, row.psnr(target)) for row in rows]
    known = [(row, (x, y)) for row, (x, y) in zip(rows, positions, strict=True) if y is not None and math.isfinite(y)]
    front = [known[index][1] for index in pareto_front([position for _, position in known])]
    if front:
        style = {"color": "#e8c860", "linewidth": 5, "alpha": 0.6, "solid_joinstyle": "round"}
        axes.step(*zip(*front, strict=True), where="post", label="Pareto front", zorder=1, **style)  # type: ignore[arg-type]
    for number, (preset, container) in enumerate(curves(row for row, _ in known)):
        curve = sorted(position for row, position in known if (row.codec, row.container) == (preset, container))
        line = ("-", "--", ":")[number % 3]
        label = f"{curve_name(preset, container)}, by quality_offset_db"
        axes.plot(*zip(*curve, strict=True), line, color=BLACK, marker=".", linewidth=1.2, label=label)
    whole = [(row, position) for row, position in known if row.quality_offset_db is None]
    labels = labelled_points(axes, [row for row, _ in whole], [position for _, position in whole])
    if target == "photographs":
        references = [row.evaluation.mean.reference for row, _ in known if row.evaluation is not None]
        uncompressed = next((mean.psnr for mean in references if mean is not None), math.nan)
        if math.isfinite(uncompressed):
            axes.axhline(uncompressed, color=GREY, linewidth=1, linestyle="--", label="uncompressed scene")
    images = "renderings of the scene" if target == "original" else "photographs"
    axes.margins(y=0.1)  # room for labels
    axes.set(xscale="log", xlabel="kilobytes", ylabel=f"PSNR to {images}, dB")
    set_log_axis(axes, [size for _, (size, _) in known])
    if axes.get_legend_handles_labels()[0]:
        axes.legend(loc="best", fontsize="small")
    return labels


def labelled_points(
    axes: Axes, rows: Sequence[Measurement], positions: Sequence[tuple[float, float]]
) -> list[Annotation]:
    """Draw presets as filled circles and external codecs as open squares; return their labels."""
    labels = []
    for row, position in zip(rows, positions, strict=True):
        style = {"marker": "s", "facecolors": "white"} if row.is_external else {"marker": "o", "facecolors": "#c0392b"}
        axes.scatter(*position, s=44, edgecolors="#c0392b", linewidths=1.5, zorder=3, **style)  # type: ignore[arg-type]
        label = axes.annotate(row.name, position, textcoords="offset points", xytext=LABEL_OFFSETS[0], fontsize=10)
        labels.append(label)
    return labels


def set_log_axis(axes: Axes, values: Sequence[float]) -> None:
    """Set the limits of a logarithmic x axis around the values, with ticks in decimal notation at 1, 2, 5, 10, …"""
    low, high = min(values, default=1.0) * 0.8, max(values, default=1.0) * 1.35
    ticks = [digit * 10.0**power for power in range(-4, 10) for digit in (1, 2, 5)]
    ticks = [tick for tick in ticks if low <= tick <= high]
    axes.set_xlim(low, high)
    axes.set_xticks(ticks, [f"{tick:,.4g}" for tick in ticks])
    axes.minorticks_off()
    axes.grid(alpha=0.3)


def place_labels(figure: Figure, axes: Axes, labels: Sequence[Annotation]) -> None:
    """Move each label to where it overlaps least with points, lines, other labels and the legend."""
    radius = figure.dpi / 72 * 5
    points = axes.transData.transform([label.xy for label in labels])
    occupied = [_square(point, radius) for point in points]
    for line in axes.get_lines():
        vertices = line.get_transform().transform(line.get_xydata())
        occupied += [_square(point, 1) for a, b in pairwise(vertices) for point in np.linspace(a, b, 40)]
    legend = axes.get_legend()
    if legend is not None:
        occupied.append(tuple(legend.get_window_extent().extents))
    inside = axes.get_window_extent()
    for label in labels:
        candidates = []
        for number, offset in enumerate(LABEL_OFFSETS):
            _set_offset(label, offset)
            x0, y0, x1, y1 = box = tuple(label.get_window_extent().extents)
            outside = x0 < inside.x0 or x1 > inside.x1 or y0 < inside.y0 or y1 > inside.y1
            own = _distance(box, axes.transData.transform(label.xy))
            ambiguous = sum(_distance(box, point) < 1.5 * own for point in points) - 1
            candidates.append((outside, sum(_overlap(box, other) for other in occupied) + 10 * ambiguous, number, box))
        *_, best, box = min(candidates)
        _set_offset(label, LABEL_OFFSETS[best])
        occupied += [box] * 40  # to cover a label is worse than to cover a line


def _set_offset(label: Annotation, offset: tuple[int, int]) -> None:
    label.set_position(offset)
    label.set_horizontalalignment("left" if offset[0] > 0 else "right" if offset[0] < 0 else "center")


def _square(center: np.ndarray, radius: float) -> tuple[float, ...]:
    return center[0] - radius, center[1] - radius, center[0] + radius, center[1] + radius


def _distance(box: tuple[float, ...], point: np.ndarray) -> float:
    """Return the distance from the box to the point, at least 1."""
    across = max(box[0] - point[0], point[0] - box[2], 0)
    along = max(box[1] - point[1], point[1] - box[3], 0)
    return max(math.hypot(across, along), 1.0)


def _overlap(one: tuple[float, ...], other: tuple[float, ...]) -> bool:
    return one[0] < other[2] and other[0] < one[2] and one[1] < other[3] and other[1] < one[3]


def _bars(axes: Axes, bars: Parts, title: str) -> None:
    """Draw stacked horizontal bars, the first on top, with parts below :data:`MIN_PART` merged."""
    longest = max((sum(parts.values()) for _, parts in bars), default=0.0) or 1.0
    names = dict.fromkeys(part for _, parts in bars for part in parts)
    shown = [name for name in names if max(parts.get(name, 0.0) for _, parts in bars) >= MIN_PART * longest]
    merged = [name for name in names if name not in shown]
    rows, left = range(len(bars)), np.zeros(len(bars))
    for name in [*shown, *([OTHER] if merged else [])]:
        members = merged if name == OTHER else [name]
        widths = np.array([sum(parts.get(part, 0.0) for part in members) for _, parts in bars])
        colour = GREYS.get(name) or COLOURS[shown.index(name) % len(COLOURS)]
        axes.barh(rows, widths, left=left, label=name, color=colour, edgecolor="white", linewidth=0.6)
        left += widths
    for row, end in zip(rows, left, strict=True):
        text = f"{end:,.3g}" if end < 100 else f"{end:,.0f}"
        position = (float(end), row)
        axes.annotate(text, position, xytext=(4, 0), textcoords="offset points", va="center", fontsize=9)
    axes.set_xlim(0, 1.15 * longest)
    axes.set_yticks(rows, [name for name, _ in bars])
    axes.invert_yaxis()
    axes.set_xlabel(title)
    axes.legend(loc="upper center", bbox_to_anchor=(0.45, -0.16), ncols=3, fontsize=8.5, frameon=False)


def _kilobytes(row: Measurement) -> dict[str, float]:
    """Return the kilobytes of each plane, and of all metadata files together; of an external codec, of its file."""
    if row.is_external:
        return {EXTERNAL: row.bytes / 1000}
    planes = {name.removesuffix(".webp"): size / 1000 for name, size in row.file_bytes.items() if name not in METADATA}
    return {**planes, "metadata": sum(row.file_bytes.get(name, 0) for name in METADATA) / 1000}
