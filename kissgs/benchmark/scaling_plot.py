"""Plot of seconds and memory over the number of Gaussians, by stage and in total."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from kissgs.benchmark.comparison_plots import BLACK, COLOURS, GREY
from kissgs.benchmark.plots import MARKERS, new_figure
from kissgs.benchmark.results import Measurement
from kissgs.core.errors import UnsupportedError

if TYPE_CHECKING:
    from matplotlib.axes import Axes

LEAST_SECONDS = 1e-3
"""Stages that take less time are drawn below the axis, seconds."""

Style = Mapping[str, object]


def scaling_plot(rows: Sequence[Measurement], path: Path) -> None:
    """Plot seconds and peak memory per Gaussian over the number of Gaussians, all logarithmic.

    A row of panels for each preset shows its stages, and the last row compares all codecs with each other, and their
    memory with the scene's own size.

    Args:
        rows: measurements of codecs on one scene at several sizes.
        path: file to write, ``.svg``, ``.png`` or ``.pdf``; overwritten.

    Raises:
        OutputError: the file cannot be written.
        UnsupportedError: matplotlib is not installed, the format is unknown, or a scene has no Gaussians.
    """
    if not all(row.gaussians for row in rows):
        raise UnsupportedError(f"{path}: a scene without Gaussians cannot be plotted; leave out --plot")
    presets = list(dict.fromkeys(row.name for row in rows if not row.is_external))
    styles = _styles(rows)
    with new_figure(path, 10, 1.4 + 3.4 * (len(presets) + 1)) as figure:
        panels = figure.subplots(len(presets) + 1, 2, squeeze=False, sharex=True, sharey="col")
        for (seconds, memory), preset in zip(panels, presets, strict=False):
            curve = _curve(rows, preset)
            _stages(seconds, curve, styles, _stage_seconds, _seconds)
            _stages(memory, curve, styles, _stage_memory, _memory)
            seconds.set(title=f"{preset}: seconds", ylabel="seconds")
            memory.set(title=f"{preset}: peak memory", ylabel="bytes per Gaussian")
        _codecs(panels[-1, 0], panels[-1, 1], rows)
        counts = sorted({row.gaussians for row in rows})
        for axes in panels.ravel():
            axes.set(xscale="log", yscale="log")
            axes.set_xticks(counts, [_count(count) for count in counts])
            axes.tick_params(labelbottom=True)
            axes.grid(alpha=0.3)
        _set_limits(
            panels[0, 0], [value for row in rows for value in (*_stage_seconds(row).values(), _cpu(row), _seconds(row))]
        )
        _set_limits(panels[0, 1], [value for row in rows for value in (*_stage_memory(row).values(), _own_size(row))])
        for axes in panels.ravel():
            axes.minorticks_off()
        handles = {
            name: handle
            for axes in panels[:-1].ravel()
            for handle, name in zip(*axes.get_legend_handles_labels(), strict=True)
        }
        figure.legend(handles.values(), handles.keys(), loc="outside lower center", ncols=6, fontsize="small")


def _styles(rows: Sequence[Measurement]) -> dict[str, Style]:
    """Return the style of each stage of the presets, the same in all panels."""
    runs = [row.median_run for row in rows if not row.is_external]
    stages = dict.fromkeys(
        stage for run in runs for part in (run.stage_seconds, run.stage_peak_memory) for stage in part
    )
    return {
        stage: {
            "color": COLOURS[n % len(COLOURS)],
            "marker": MARKERS[n % len(MARKERS)],
            "markersize": 4,
            "linewidth": 1.2,
        }
        for n, stage in enumerate(stages)
    }


def _curve(rows: Sequence[Measurement], name: str) -> list[Measurement]:
    return sorted((row for row in rows if row.name == name), key=lambda row: row.gaussians)


def _stages(
    axes: Axes,
    curve: Sequence[Measurement],
    styles: Mapping[str, Style],
    by_stage: Callable[[Measurement], Mapping[str, float]],
    total: Callable[[Measurement], float],
) -> None:
    """Draw a line for each stage, in the same style in all panels, and a thick line for the total."""
    counts = [row.gaussians for row in curve]
    for stage, style in styles.items():
        values = [by_stage(row).get(stage, 0.0) or math.nan for row in curve]
        if not all(map(math.isnan, values)):
            axes.plot(counts, values, label=stage, **style)  # type: ignore[arg-type]
    axes.plot(counts, list(map(total, curve)), label="total", marker="o", markersize=5, linewidth=2.2, color=BLACK)


def _codecs(seconds: Axes, memory: Axes, rows: Sequence[Measurement]) -> None:
    """Draw a line for each codec, dashed with open squares for external ones, and one for the size of the scene."""
    for number, name in enumerate(dict.fromkeys(row.name for row in rows)):
        curve = _curve(rows, name)
        counts = [row.gaussians for row in curve]
        external = (
            {"linestyle": "--", "marker": "s", "markerfacecolor": "white"} if curve[0].is_external else {"marker": "o"}
        )
        style = {"color": COLOURS[number % len(COLOURS)], "markersize": 5, **external}
        seconds.plot(counts, list(map(_cpu, curve)), label=name, **style)  # type: ignore[arg-type]
        memory.plot(counts, list(map(_memory, curve)), label=name, **style)  # type: ignore[arg-type]
    scene = sorted({(row.gaussians, _own_size(row)) for row in rows})
    memory.plot(*zip(*scene, strict=True), label="the scene as float32", color=GREY, linestyle=":", linewidth=2)
    seconds.set(title="all: CPU seconds", xlabel="Gaussians", ylabel="CPU seconds")
    memory.set(title="all: peak memory", xlabel="Gaussians", ylabel="bytes per Gaussian")
    seconds.legend(fontsize="small")
    memory.legend(fontsize="small")


def _set_limits(axes: Axes, values: Sequence[float]) -> None:
    """Set the limits of a logarithmic y axis around the values, with ticks in decimal notation."""
    shown = [value for value in values if value >= LEAST_SECONDS] or [1.0]
    low, high = min(shown) / 1.5, max(shown) * 1.5
    digits = (1,) if high > 1000 * low else (1, 2, 5)
    ticks = [digit * 10.0**power for power in range(-4, 10) for digit in digits]
    ticks = [tick for tick in ticks if low <= tick <= high]
    axes.set_ylim(low, high)
    axes.set_yticks(ticks, [f"{tick:,g}" for tick in ticks])


def _stage_seconds(row: Measurement) -> Mapping[str, float]:
    return row.median_run.stage_seconds


def _stage_memory(row: Measurement) -> Mapping[str, float]:
    return {stage: peak / row.gaussians for stage, peak in row.median_run.stage_peak_memory.items()}


def _seconds(row: Measurement) -> float:
    return row.median_run.encode_seconds


def _cpu(row: Measurement) -> float:
    return row.median_run.encode_cpu_seconds


def _memory(row: Measurement) -> float:
    return row.peak_memory_per_gaussian


def _own_size(row: Measurement) -> float:
    return row.float32_bytes / row.gaussians


def _count(count: int) -> str:
    return f"{count / 1e6:.3g}M" if count >= 1e6 else f"{count / 1000:.3g}k" if count >= 1000 else str(count)
