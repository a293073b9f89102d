"""``kissgs bench`` as it is, ``--ablate`` and ``--rendering``: presets, peers, what each choice is worth, pictures."""

from __future__ import annotations

import shlex
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from kissgs.cli.bench_scenes import Asked, Outcome, each_scene
from kissgs.cli.options import chosen
from kissgs.core.errors import UnsupportedError

if TYPE_CHECKING:
    from kissgs.benchmark.render_speed import RenderingCost
    from kissgs.benchmark.results import Measured
    from kissgs.core.progress import Progress


def comparison(asked: Asked) -> Outcome:
    """Presets, points of their curves, and peers; or presets on the scene at other sizes."""
    from kissgs.benchmark.comparison import Plan, compare, growth
    from kissgs.benchmark.comparison_plots import comparison_plot, growth_plot
    from kissgs.benchmark.results import at_equal_psnr
    from kissgs.cli.bench_tables import bench_tables
    from kissgs.settings import Preset

    if asked.gaussians and (asked.peers or asked.fidelities):
        raise UnsupportedError("--gaussians measures how times grow: without --peer and --quality-offset")
    presets = [chosen(name, asked.changes) for name in asked.presets or list(Preset)]
    curved = [settings for settings in presets if settings.encode.rate_distortion]
    if not asked.presets:
        curved = [settings for settings in curved if settings.preset == Preset.BALANCED]
    if asked.fidelities and not curved:
        raise UnsupportedError("--quality-offset is of presets that weigh bits: balanced or small")
    plan = Plan(
        presets=presets,
        curved=curved,
        fidelities=asked.fidelities,
        peers=asked.peers,
        command=shlex.split(asked.splat_transform),
        sog_iterations=asked.sog_iterations,
        repeats=asked.repeats,
        pictures=asked.pictures
        or asked.views is not None
        or bool(asked.fidelities)
        or (asked.plot is not None and not asked.gaussians),
        views=asked.views,
        threads=asked.threads,
    )
    refused = list[str]()

    def measure(scene: Path, progress: Progress) -> list[Measured]:
        if asked.gaussians:
            return growth(scene, asked.gaussians, plan, progress=progress)
        return compare(scene, plan, failed=refused.append, progress=progress)

    named, failures = each_scene(asked, measure)
    rows = [replace(row, scene=name) for name, row in named]
    equals = at_equal_psnr(rows)
    told = [row.as_dict() for row in rows]
    for row, entry in zip(rows, told, strict=True):
        of = (equal for equal in equals if (equal.scene, equal.peer) == (row.scene, row.encoder))
        if row.is_peer and asked.fidelities:
            entry["at_equal_psnr"] = [equal.as_dict() for equal in of]
    draw = partial(growth_plot if asked.gaussians else comparison_plot, rows)
    return Outcome(rows=told, table=bench_tables(rows, equals), draw=draw, failures=refused + failures)


def ablation(asked: Asked) -> Outcome:
    """What each part is worth."""
    from kissgs.benchmark.ablation import ablate
    from kissgs.cli.bench_tables import ablation_table

    presets = [chosen(name, asked.changes) for name in asked.presets or ("paper", "balanced")]
    rows, failures = each_scene(
        asked, lambda scene, progress: ablate(scene, presets, asked.views, threads=asked.threads, progress=progress)
    )
    told = [{"scene": scene, **row.as_dict()} for scene, row in rows]
    return Outcome(rows=told, table=ablation_table(rows), failures=failures)


def rendering(asked: Asked) -> Outcome:
    """What pictures cost."""
    from kissgs.benchmark.render_speed import rendering_cost, resampled
    from kissgs.cameras.virtual.select import virtual_views
    from kissgs.cli.evaluation_tables import rendering_table
    from kissgs.pipeline.scene_files import load

    def measure(scene: Path, progress: Progress) -> list[RenderingCost]:
        splats = load(scene, threads=asked.threads, progress=progress)
        views = asked.views or virtual_views(splats, threads=asked.threads, progress=progress)
        cameras = [view.camera for view in views.test or views.train]
        return [
            rendering_cost(resampled(splats, count), cameras, threads=asked.threads, progress=progress)
            for count in asked.gaussians or [len(splats)]
        ]

    rows, failures = each_scene(asked, measure)
    told = [{"scene": scene, **cost.as_dict()} for scene, cost in rows]
    return Outcome(rows=told, table=rendering_table(rows), failures=failures)
