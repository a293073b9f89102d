"""Plots, by matplotlib: what benchmarks found, for people."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING

from kissgs.core.errors import UnsupportedError
from kissgs.io.atomic import atomic_file, refuse_existing

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from kissgs.benchmark.compaction_study import Point
    from kissgs.benchmark.finetuning_curves import RatePoint

FORMATS = ("svg", "png", "pdf")

LINES, MARKERS = ("-", "--", ":"), ("o", "s", "^", "D", "v")

COLOURS = 10
"""Of matplotlib, before they begin again: then the next kind of line is taken."""

CLOSE = 4.0
"""Decibels below the best down to which the second panel shows what the first crowds."""


def check_plot(path: Path) -> str:
    """See that a plot can be drawn there, before the work that it is to show; returns its format.

    Raises:
        OutputError: the file system refuses.
        UnsupportedError: there is no matplotlib, or no such format.
    """
    kind = path.suffix.lower().lstrip(".")
    if kind not in FORMATS:
        raise UnsupportedError(f"{path}: plots are {', '.join(FORMATS)}; name such a file")
    if find_spec("matplotlib") is None:
        raise UnsupportedError("plots are matplotlib's, which is missing: pip install 'kissgs[bench]'")
    refuse_existing(path, overwrite=True)
    return kind


def compaction_plot(points: Sequence[Point], path: Path) -> None:
    """PSNR over count, a curve for each way, the input as a level line: all, and the best from near.

    Raises:
        OutputError: the file system refuses.
        UnsupportedError: there is no matplotlib, or no such format.
    """
    (before,) = (point for point in points if point.way == "input")
    with new_figure(path, 10, 4.5) as figure:
        whole, near = panels = figure.subplots(1, 2)
        for axes in panels:
            _draw(axes, points, before)
        whole.set_ylabel("PSNR of held-out views, dB")
        best = max((point.psnr for point in points if math.isfinite(point.psnr)), default=0.0)
        near.set_ylim(best - CLOSE, best + 0.1 * CLOSE)
        figure.legend(*whole.get_legend_handles_labels(), loc="outside right upper", fontsize="small")


def finetuning_plot(points: Sequence[RatePoint], path: Path) -> None:
    """PSNR over bytes, a curve for each way: of held-out views, and of pictures of the scene as it was.

    Raises:
        OutputError: the file system refuses.
        UnsupportedError: there is no matplotlib, or no such format.
    """
    titles = (("psnr", "PSNR of held-out views, dB"), ("psnr_to_scene", "PSNR to the scene's own pictures, dB"))
    with new_figure(path, 10, 4) as figure:
        panels = figure.subplots(1, 2)
        for axes, (name, title) in zip(panels, titles, strict=True):
            for way, marker in zip(dict.fromkeys(point.way for point in points), MARKERS, strict=False):
                of = [(point.bytes / 1000, getattr(point, name)) for point in points if point.way == way]
                curve = sorted(place for place in of if math.isfinite(place[1])) or [(math.nan, math.nan)]
                axes.plot(*zip(*curve, strict=True), marker=marker, markersize=4, label=way)
            axes.set_xlabel("kilobytes")
            axes.set_ylabel(title)
            axes.grid(alpha=0.3)
        panels[0].legend()


@contextmanager
def new_figure(path: Path, width: float, height: float) -> Iterator[Figure]:
    """A figure of so many inches, which is then written to ``path``: the same bytes each time.

    Raises:
        OutputError: the file system refuses.
        UnsupportedError: there is no matplotlib, or no such format.
    """
    kind = check_plot(path)
    from matplotlib import rc_context
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width, height), layout="constrained")
    yield figure
    undated = {"svg": {"Date": None}, "pdf": {"CreationDate": None}}.get(kind)
    with rc_context({"svg.hashsalt": "kissgs"}), atomic_file(path, overwrite=True) as file:
        figure.savefig(file, format=kind, metadata=undated, dpi=150)


def _draw(axes: Axes, points: Sequence[Point], before: Point) -> None:
    for number, way in enumerate(dict.fromkeys(point.way for point in points if point.way != "input")):
        line, marker = LINES[number // COLOURS % len(LINES)], MARKERS[number % len(MARKERS)]
        curve = sorted((point.count, point.psnr) for point in points if point.way == way)
        axes.plot(*zip(*curve, strict=True), line, marker=marker, markersize=4, label=way)
    if math.isfinite(before.psnr):
        axes.axhline(before.psnr, color="black", linewidth=0.8, label=f"input, {before.count:,} Gaussians")
    axes.set_xscale("log")
    ticks = sorted({point.count for point in points})
    axes.set_xticks(ticks, [f"{count / 1000:.3g}k" if count >= 1000 else str(count) for count in ticks])
    axes.minorticks_off()
    axes.set_xlabel("Gaussians")
    axes.grid(alpha=0.3)
