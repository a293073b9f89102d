"""Plots of benchmark results, made with matplotlib."""

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

    from kissgs.benchmark.compaction_study import CompactionPoint
    from kissgs.benchmark.finetuning_curves import RatePoint

FORMATS = ("svg", "png", "pdf")

LINES, MARKERS = ("-", "--", ":"), ("o", "s", "^", "D", "v")

COLOURS = 10
"""Number of matplotlib's default colours; after as many curves, the next line style is used."""

ZOOM_DB = 4.0
"""Range below the best PSNR that the second panel of a compaction plot shows, decibels."""


def check_plot(path: Path) -> str:
    """Check that a plot can be written, before a long measurement; return its format, an extension without the dot.

    Raises:
        OutputError: the file cannot be written.
        UnsupportedError: matplotlib is not installed, or the format is unknown.
    """
    kind = path.suffix.lower().lstrip(".")
    if kind not in FORMATS:
        raise UnsupportedError(f"{path}: unknown format of a plot; choose a file name that ends in .svg, .png or .pdf")
    if find_spec("matplotlib") is None:
        raise UnsupportedError("plots need matplotlib, which is not installed: pip install 'kissgs[bench]'")
    refuse_existing(path, overwrite=True)
    return kind


def compaction_plot(points: Sequence[CompactionPoint], path: Path) -> None:
    """Plot PSNR over count, a curve for each strategy and a line for the input: all, and the best enlarged.

    Raises:
        OutputError: the file cannot be written.
        UnsupportedError: matplotlib is not installed, or the format is unknown.
    """
    (uncompressed,) = (point for point in points if point.strategy == "input")
    with new_figure(path, 10, 4.5) as figure:
        whole, enlarged = panels = figure.subplots(1, 2)
        for axes in panels:
            _draw(axes, points, uncompressed)
        whole.set_ylabel("PSNR of held-out views, dB")
        best = max((point.psnr for point in points if math.isfinite(point.psnr)), default=0.0)
        enlarged.set_ylim(best - ZOOM_DB, best + 0.1 * ZOOM_DB)
        figure.legend(*whole.get_legend_handles_labels(), loc="outside right upper", fontsize="small")


def finetuning_plot(points: Sequence[RatePoint], path: Path) -> None:
    """Plot PSNR over bytes, a curve with and one without fine-tuning: of held-out views, and to the scene's renderings.

    Raises:
        OutputError: the file cannot be written.
        UnsupportedError: matplotlib is not installed, or the format is unknown.
    """
    titles = (("psnr", "PSNR of held-out views, dB"), ("psnr_to_scene", "PSNR to renderings of the scene, dB"))
    with new_figure(path, 10, 4) as figure:
        panels = figure.subplots(1, 2)
        for axes, (name, title) in zip(panels, titles, strict=True):
            for variant, marker in zip(dict.fromkeys(point.variant for point in points), MARKERS, strict=False):
                all_points = [
                    (point.bytes / 1000, getattr(point, name)) for point in points if point.variant == variant
                ]
                curve = sorted(xy for xy in all_points if math.isfinite(xy[1])) or [(math.nan, math.nan)]
                axes.plot(*zip(*curve, strict=True), marker=marker, markersize=4, label=variant)
            axes.set_xlabel("kilobytes")
            axes.set_ylabel(title)
            axes.grid(alpha=0.3)
        panels[0].legend()


@contextmanager
def new_figure(path: Path, width: float, height: float) -> Iterator[Figure]:
    """Yield a figure of this size in inches, and write it to ``path`` afterwards, with the same bytes each time.

    Raises:
        OutputError: the file cannot be written.
        UnsupportedError: matplotlib is not installed, or the format is unknown.
    """
    kind = check_plot(path)
    from matplotlib import rc_context
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width, height), layout="constrained")
    yield figure
    undated = {"svg": {"Date": None}, "pdf": {"CreationDate": None}}.get(kind)
    with rc_context({"svg.hashsalt": "kissgs"}), atomic_file(path, overwrite=True) as file:
        figure.savefig(file, format=kind, metadata=undated, dpi=150)


def _draw(axes: Axes, points: Sequence[CompactionPoint], uncompressed: CompactionPoint) -> None:
    for number, strategy in enumerate(dict.fromkeys(point.strategy for point in points if point.strategy != "input")):
        line, marker = LINES[number // COLOURS % len(LINES)], MARKERS[number % len(MARKERS)]
        curve = sorted((point.count, point.psnr) for point in points if point.strategy == strategy)
        axes.plot(*zip(*curve, strict=True), line, marker=marker, markersize=4, label=strategy)
    if math.isfinite(uncompressed.psnr):
        axes.axhline(uncompressed.psnr, color="black", linewidth=0.8, label=f"input, {uncompressed.count:,} Gaussians")
    axes.set_xscale("log")
    ticks = sorted({point.count for point in points})
    axes.set_xticks(ticks, [f"{count / 1000:.3g}k" if count >= 1000 else str(count) for count in ticks])
    axes.minorticks_off()
    axes.set_xlabel("Gaussians")
    axes.grid(alpha=0.3)
