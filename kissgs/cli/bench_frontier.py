"""``kissgs bench frontier``: bytes, quality and seconds of presets and of time limits."""

from __future__ import annotations

from functools import partial
from typing import TYPE_CHECKING

from rich.console import Group
from rich.table import Column, Table
from rich.text import Text

from kissgs.cli.bench_codecs import ExternalCodecs, command_words, measured
from kissgs.cli.bench_scenes import BenchInputs, BenchOutput
from kissgs.cli.options import chosen
from kissgs.evaluation.metric_text import format_metric

if TYPE_CHECKING:
    from rich.console import RenderableType

    from kissgs.benchmark.results import Measurement
    from kissgs.evaluation.results import Evaluation

TIMES = ("5s", "30s", "2min", "10min")
"""Default time limits."""


def frontier(
    inputs: BenchInputs,
    *,
    times: list[str],
    presets: list[str] | None,
    changes: list[str] | None,
    external: ExternalCodecs,
) -> BenchOutput:
    """Measure presets, time limits and external codecs, and mark the Pareto front of bytes and quality."""
    external.check()
    from kissgs.benchmark.comparison import BenchmarkPlan
    from kissgs.benchmark.frontier_plot import frontier_plot
    from kissgs.cli.bench_codecs import all_settings

    timed = [chosen("balanced", changes, time=time) for time in times or TIMES]
    plan = BenchmarkPlan(
        presets=[*all_settings(presets, changes), *timed],
        external_codecs=external.formats,
        splat_transform=command_words(external.splat_transform),
        sog_iterations=external.sog_iterations,
        errors=False,
        evaluate=True,
        views=inputs.views,
        threads=inputs.threads,
    )
    rows, failures = measured(inputs, plan)
    return BenchOutput(
        rows=[row.as_dict() for row in rows],
        table=frontier_table(rows),
        draw=partial(frontier_plot, rows),
        failures=failures,
    )


def frontier_table(rows: list[Measurement]) -> RenderableType:
    """Return, for each scene, a table for the terminal; a star marks the Pareto front of bytes and PSNR."""
    blocks: list[RenderableType] = []
    for scene in dict.fromkeys(row.scene for row in rows):
        here = [row for row in rows if row.scene == scene]
        blocks += [Text.assemble((scene, "bold"), f"  {here[0].gaussians:,} Gaussians"), _table(here)]
    return Group(*blocks)


def _worst(evaluation: Evaluation) -> float:
    """Return the largest change of PSNR to a photograph, decibels; without photographs, the lowest PSNR of a view."""
    views = [view.comparison for view in evaluation.views]
    changes = [view.candidate.psnr - view.reference.psnr for view in views if view.reference is not None]
    return min(changes) if changes else evaluation.worst.comparison.candidate_vs_reference.psnr


def _table(rows: list[Measurement]) -> Table:
    from kissgs.benchmark.bd_rate import pareto_front
    from kissgs.benchmark.results import PsnrTarget

    photographed = any(row.psnr("photographs") is not None for row in rows)
    target: PsnrTarget = "photographs" if photographed else "original"
    against = "photographs" if photographed else "the original"
    names = ("wall s", "CPU s", "bytes", f"PSNR to {against}", *(("change, dB",) * photographed), "SSIM", "MS-SSIM")
    heads = [Column(name, justify="right") for name in names]
    table = Table("", *heads, Column("worst view, dB", justify="right"), "front", box=None, pad_edge=False)
    psnrs = [row.psnr(target) for row in rows]
    known = [n for n, psnr in enumerate(psnrs) if psnr is not None]
    front = {known[n] for n in pareto_front([(float(rows[n].bytes), psnrs[n] or 0.0) for n in known])}
    for n, row in enumerate(rows):
        assert row.evaluation is not None  # noqa: S101  all rows are evaluated
        mean, run = row.evaluation.mean, row.median_run
        images = mean.candidate if photographed else mean.candidate_vs_reference
        change = [] if mean.reference is None else [format_metric(images.psnr - mean.reference.psnr, 2, signed=True)]
        table.add_row(
            row.name,
            f"{run.encode_seconds:.1f}",
            f"{run.encode_cpu_seconds:.1f}",
            f"{row.bytes:,}",
            format_metric(images.psnr, 2),
            *change,
            format_metric(images.ssim, 4),
            format_metric(images.ms_ssim, 4),
            format_metric(_worst(row.evaluation), 2, signed=photographed),
            "*" * (n in front),
        )
    return table
