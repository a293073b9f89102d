"""Measurements of codecs at several sizes as tables for the terminal. This module only formats."""

from __future__ import annotations

from collections.abc import Sequence

from rich.console import Group, RenderableType
from rich.text import Text

from kissgs.benchmark.results import Measurement
from kissgs.benchmark.scaling import FailedMeasurement
from kissgs.cli.bench_tables import columns_table, metrics_table, not_reproducible


def scaling_tables(rows: Sequence[Measurement], failed: Sequence[FailedMeasurement]) -> RenderableType:
    """Return, for each scene, a table of all metrics, and for each preset tables by stage with a column for each size.

    The tables of a preset are wall seconds, CPU seconds, and the peak of memory in bytes per Gaussian.
    """
    blocks: list[RenderableType] = []
    for scene in dict.fromkeys([*(row.scene for row in rows), *(row.scene for row in failed)]):
        here = [row for row in rows if row.scene == scene]
        repeats = max((len(row.runs) for row in here), default=1)
        medians = f"  times are medians of {repeats} runs, memory is the maximum" if repeats > 1 else ""
        blocks.append(Text.assemble((scene, "bold"), medians))
        if here:
            blocks.append(metrics_table(here))
        missing = [row for row in failed if row.scene == scene]
        blocks += [Text(f"{row.codec}, {row.gaussians:,}: {row.failure}", style="red") for row in missing]
        for name in dict.fromkeys(row.name for row in here if not row.is_external):
            curve = [row for row in here if row.name == name]
            sizes, runs = [f"{row.gaussians:,}" for row in curve], [row.median_run for row in curve]
            shares = [
                {stage: peak / max(row.gaussians, 1) for stage, peak in run.stage_peak_memory.items()}
                for row, run in zip(curve, runs, strict=True)
            ]
            blocks += [
                columns_table(f"{name}, seconds", sizes, [run.stage_seconds for run in runs], "{:.2f}"),
                columns_table(f"{name}, CPU seconds", sizes, [run.stage_cpu_seconds for run in runs], "{:.2f}"),
                columns_table(f"{name}, peak bytes per Gaussian", sizes, shares, "{:,.0f}", max),
            ]
        blocks += [Text(not_reproducible(row), style="red") for row in here if not row.reproducible]
    return Group(*blocks)
