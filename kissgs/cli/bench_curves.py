"""``kissgs bench --compaction`` and ``--finetuning``: curves as tables and plots."""

from __future__ import annotations

from functools import partial
from typing import TYPE_CHECKING, cast

from rich.console import Group
from rich.table import Column, Table
from rich.text import Text

from kissgs.cli.bench_scenes import Asked, Outcome, each_scene
from kissgs.cli.options import choice, chosen
from kissgs.core.errors import UnsupportedError
from kissgs.evaluation.results import spell

if TYPE_CHECKING:
    from pathlib import Path

    from rich.console import RenderableType

    from kissgs.benchmark.compaction_study import Point
    from kissgs.benchmark.finetuning_curves import RatePoint
    from kissgs.cameras.views import TargetSource
    from kissgs.core.progress import Progress


def compaction(asked: Asked) -> Outcome:
    """All ways to have fewer Gaussians on all scenes."""
    from kissgs.benchmark.compaction_study import RATIOS, WAYS, study
    from kissgs.benchmark.plots import compaction_plot
    from kissgs.pipeline.scene_files import load

    known = {way.name: way for way in WAYS}
    for name in asked.ways:
        if name not in known:
            raise UnsupportedError(f"there is no way {name!r}; there are: {'; '.join(known)}")
    source = _teacher(asked)
    settings = chosen(asked.preset, asked.changes, group="compact").compact

    def measure(scene: Path, progress: Progress) -> list[Point]:
        return study(
            *(load(scene, threads=asked.threads, progress=progress), settings, asked.views),
            ratios=asked.ratios or RATIOS,
            ways=[known[name] for name in asked.ways or known],
            learn_from=source,
            threads=asked.threads,
            progress=progress,
        )

    rows, failures = each_scene(asked, measure)
    return Outcome(
        rows=[{"scene": scene, **point.as_dict()} for scene, point in rows],
        table=curves_table(rows),
        draw=partial(compaction_plot, [point for _, point in rows]),
        failures=failures,
    )


def _teacher(asked: Asked) -> TargetSource:
    """What to learn from, once it is known that it can be, and that something will be left to teach."""
    from kissgs.cameras.views import TargetSource

    if 0 in asked.ratios:
        raise UnsupportedError("--ratio 0 keeps nothing; give a share above 0")
    source = cast(TargetSource, choice("--learn-from", asked.learn_from, TargetSource))
    if asked.views is None and source == "cameras":
        raise UnsupportedError("--learn-from cameras: say whose with --views")
    return source


def curves_table(rows: list[tuple[str, Point]]) -> Table:
    """For people."""
    names = ("Gaussians", "PSNR", "SSIM", "bytes", "seconds", "CPU s")
    table = Table("scene", "way", *(Column(name, justify="right") for name in names), box=None, pad_edge=False)
    for scene, point in rows:
        figures = f"{point.count:,}", spell(point.psnr, 2), spell(point.ssim, 4), f"{point.bytes:,}"
        table.add_row(scene, point.way, *figures, f"{point.seconds:.1f}", f"{point.cpu_seconds:.1f}")
    return table


def finetuning(asked: Asked) -> Outcome:
    """With fine-tuning and without, at all fidelities on all scenes."""
    from kissgs.benchmark.finetuning_curves import rate_curves
    from kissgs.benchmark.plots import finetuning_plot
    from kissgs.pipeline.scene_files import load

    source = _teacher(asked)
    settings = chosen(asked.preset, asked.changes, group="finetune")

    def measure(scene: Path, progress: Progress) -> list[RatePoint]:
        return rate_curves(
            *(load(scene, threads=asked.threads, progress=progress), settings, asked.views),
            fidelities=asked.fidelities or None,
            ratios=asked.ratios,
            learn_from=source,
            threads=asked.threads,
            progress=progress,
        )

    rows, failures = each_scene(asked, measure)
    return Outcome(
        rows=[{"scene": scene, **point.as_dict()} for scene, point in rows],
        table=finetuning_table(rows),
        draw=partial(finetuning_plot, [point for _, point in rows]),
        failures=failures,
    )


def finetuning_table(rows: list[tuple[str, RatePoint]]) -> RenderableType:
    """For people."""
    from kissgs.benchmark.finetuning_curves import saved

    names = ("Gaussians", "offset, dB", "bytes", "PSNR", "SSIM", "to the scene", "seconds", "CPU s", "MB")
    table = Table("scene", "way", *(Column(name, justify="right") for name in names), box=None, pad_edge=False)
    lines = []
    for scene in dict.fromkeys(name for name, _ in rows):
        points = [point for name, point in rows if name == scene]
        for point in points:
            quality = spell(point.psnr, 2), spell(point.ssim, 4), spell(point.psnr_to_scene, 2)
            took = f"{point.seconds:.1f}", f"{point.cpu_seconds:.1f}", f"{point.peak_memory / 1e6:.0f}"
            table.add_row(
                scene,
                point.way,
                f"{point.count:,}",
                f"{point.quality_offset_db:g}",
                f"{point.bytes:,}",
                *quality,
                *took,
            )
        kinds = {"PSNR": "psnr", "SSIM": "ssim", "PSNR to the scene's own pictures": "psnr_to_scene"}
        if all(point.psnr == point.psnr_to_scene for point in points):
            kinds.pop("PSNR to the scene's own pictures")
        for figure, name in kinds.items():
            share = saved(points, name)
            if share is not None:
                word = "fewer" if share >= 0 else "more"
                lines.append(f"{scene}: {100 * abs(share):.1f} % {word} bytes at equal {figure}, on average")
    return Group(table, *(Text(line) for line in lines))
