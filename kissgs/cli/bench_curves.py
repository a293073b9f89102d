"""``kissgs bench compaction`` and ``finetuning``."""

from __future__ import annotations

from functools import partial
from typing import TYPE_CHECKING, cast

from rich.console import Group
from rich.table import Column, Table
from rich.text import Text

from kissgs.cli.bench_scenes import BenchInputs, BenchOutput, each_scene
from kissgs.cli.options import choice, chosen
from kissgs.core.errors import UnsupportedError
from kissgs.evaluation.metric_text import format_metric

if TYPE_CHECKING:
    from pathlib import Path

    from rich.console import RenderableType

    from kissgs.benchmark.compaction_study import CompactionPoint
    from kissgs.benchmark.finetuning_curves import RatePoint
    from kissgs.cameras.views import TargetSource
    from kissgs.core.progress import Progress


def compaction(
    inputs: BenchInputs,
    *,
    preset: str = "balanced",
    changes: list[str] | None = None,
    ratios: list[float] | None = None,
    strategies: list[str] | None = None,
    supervision: str = "photos",
) -> BenchOutput:
    """Compare strategies of compaction."""
    from kissgs.benchmark.compaction_study import RATIOS, STRATEGIES, compare_strategies
    from kissgs.benchmark.plots import compaction_plot
    from kissgs.pipeline.scene_files import load

    known = {strategy.name: strategy for strategy in STRATEGIES}
    for name in strategies or []:
        if name not in known:
            raise UnsupportedError(f"--strategy {name!r}: unknown strategy; choose one of: {'; '.join(known)}")
    source = _checked_supervision(inputs, supervision, ratios or [])
    settings = chosen(preset, changes, group="compact").compact

    def measure(scene: Path, progress: Progress) -> list[CompactionPoint]:
        return compare_strategies(
            load(scene, threads=inputs.threads, progress=progress),
            settings,
            inputs.views,
            ratios=ratios or RATIOS,
            strategies=[known[name] for name in strategies or known],
            supervision=source,
            threads=inputs.threads,
            progress=progress,
        )

    rows, failures = each_scene(inputs.scenes, measure)
    return BenchOutput(
        rows=[{"scene": scene, **point.as_dict()} for scene, point in rows],
        table=compaction_table(rows),
        draw=partial(compaction_plot, [point for _, point in rows]),
        failures=failures,
    )


def _checked_supervision(inputs: BenchInputs, supervision: str, ratios: list[float]) -> TargetSource:
    """Return the value of ``--supervision``, after a check of it and of the ratios."""
    from kissgs.cameras.views import TargetSource

    if 0 in ratios:
        raise UnsupportedError("--ratio 0 keeps no Gaussian; give a share above 0")
    source = cast(TargetSource, choice("--supervision", supervision, TargetSource))
    if inputs.views is None and source == "cameras":
        raise UnsupportedError("--supervision cameras needs a capture; give one with --views")
    return source


def compaction_table(rows: list[tuple[str, CompactionPoint]]) -> Table:
    """Return the results of compaction as a table for the terminal."""
    names = ("Gaussians", "PSNR", "SSIM", "bytes", "seconds", "CPU s")
    table = Table("scene", "strategy", *(Column(name, justify="right") for name in names), box=None, pad_edge=False)
    for scene, point in rows:
        metrics = f"{point.count:,}", format_metric(point.psnr, 2), format_metric(point.ssim, 4), f"{point.bytes:,}"
        table.add_row(scene, point.strategy, *metrics, f"{point.seconds:.1f}", f"{point.cpu_seconds:.1f}")
    return table


def finetuning(
    inputs: BenchInputs,
    *,
    preset: str = "balanced",
    changes: list[str] | None = None,
    quality_offsets: list[float] | None = None,
    ratios: list[float] | None = None,
    supervision: str = "photos",
) -> BenchOutput:
    """Measure bytes and quality with and without fine-tuning."""
    from kissgs.benchmark.finetuning_curves import rate_curves
    from kissgs.benchmark.plots import finetuning_plot
    from kissgs.pipeline.scene_files import load

    source = _checked_supervision(inputs, supervision, ratios or [])
    settings = chosen(preset, changes, group="finetune")

    def measure(scene: Path, progress: Progress) -> list[RatePoint]:
        return rate_curves(
            load(scene, threads=inputs.threads, progress=progress),
            settings,
            inputs.views,
            quality_offsets=quality_offsets or None,
            ratios=ratios or [],
            supervision=source,
            threads=inputs.threads,
            progress=progress,
        )

    rows, failures = each_scene(inputs.scenes, measure)
    return BenchOutput(
        rows=[{"scene": scene, **point.as_dict()} for scene, point in rows],
        table=finetuning_table(rows),
        draw=partial(finetuning_plot, [point for _, point in rows]),
        failures=failures,
    )


def finetuning_table(rows: list[tuple[str, RatePoint]]) -> RenderableType:
    """Return the results of fine-tuning as a table for the terminal, with the bytes that it saves on average."""
    from kissgs.benchmark.finetuning_curves import bytes_saved

    names = ("Gaussians", "offset, dB", "bytes", "PSNR", "SSIM", "to the scene", "seconds", "CPU s", "MB")
    table = Table("scene", "variant", *(Column(name, justify="right") for name in names), box=None, pad_edge=False)
    lines = []
    for scene in dict.fromkeys(name for name, _ in rows):
        points = [point for name, point in rows if name == scene]
        for point in points:
            quality = format_metric(point.psnr, 2), format_metric(point.ssim, 4), format_metric(point.psnr_to_scene, 2)
            resources = f"{point.seconds:.1f}", f"{point.cpu_seconds:.1f}", f"{point.peak_memory / 1e6:.0f}"
            table.add_row(
                scene,
                point.variant,
                f"{point.count:,}",
                f"{point.quality_offset_db:g}",
                f"{point.bytes:,}",
                *quality,
                *resources,
            )
        metrics = {
            "PSNR": "psnr",
            "SSIM": "ssim",
            "MS-SSIM": "ms_ssim",
            "PSNR to renderings of the scene": "psnr_to_scene",
        }
        if all(point.psnr == point.psnr_to_scene for point in points):
            metrics.pop("PSNR to renderings of the scene")
        for metric, name in metrics.items():
            share = bytes_saved(points, name)
            if share is not None:
                comparative = "fewer" if share >= 0 else "more"
                lines.append(f"{scene}: {100 * abs(share):.1f} % {comparative} bytes at equal {metric}, on average")
    return Group(table, *(Text(line) for line in lines))
