"""Plot of what a time limit buys: quality over size with the Pareto front, and size over time."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from kissgs.benchmark.comparison_plots import labelled_points, place_labels, quality_panel, set_log_axis
from kissgs.benchmark.plots import new_figure
from kissgs.benchmark.results import Measurement


def frontier_plot(rows: Sequence[Measurement], path: Path) -> None:
    """Plot the measurements of one scene.

    Args:
        rows: measurements of one scene, with evaluations.
        path: file to write, ``.svg``, ``.png`` or ``.pdf``; overwritten.

    Raises:
        OutputError: the file cannot be written.
        UnsupportedError: matplotlib is not installed, or the format is unknown.
    """
    photographed = any(row.psnr("photographs") is not None for row in rows)
    with new_figure(path, 11, 4.8) as figure:
        quality, speed = figure.subplots(1, 2)
        labels = [(quality, quality_panel(quality, rows, "photographs" if photographed else "original"))]
        positions = [(row.median_run.encode_seconds, row.bytes / 1000) for row in rows]
        labels.append((speed, labelled_points(speed, rows, positions)))
        speed.set(xscale="log", xlabel="encoding, seconds", ylabel="kilobytes")
        speed.set_ylim(0, 1.15 * max(size for _, size in positions))
        set_log_axis(speed, [seconds for seconds, _ in positions])
        figure.draw_without_rendering()  # the positions of points are known only after the layout
        for axes, texts in labels:
            place_labels(figure, axes, texts)
