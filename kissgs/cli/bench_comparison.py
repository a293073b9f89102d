"""``kissgs bench codecs``, ``scaling``, ``ablation`` and ``rendering``."""

from __future__ import annotations

import shlex
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from kissgs.cli.bench_scenes import BenchOptions, BenchOutput, each_scene
from kissgs.cli.options import chosen
from kissgs.core.errors import UnsupportedError

if TYPE_CHECKING:
    from kissgs.benchmark.comparison import BenchmarkPlan
    from kissgs.benchmark.render_speed import RenderingCost
    from kissgs.benchmark.results import Measurement
    from kissgs.core.progress import Progress


def comparison(options: BenchOptions) -> BenchOutput:
    """Measure presets, points of their quality curves and external codecs, or presets on the scene resampled."""
    from kissgs.benchmark.comparison import compare, compare_at_counts
    from kissgs.benchmark.comparison_plots import comparison_plot, scaling_plot
    from kissgs.benchmark.results import at_equal_psnr
    from kissgs.cli.bench_tables import bench_tables

    plan = _plan(options)
    external_failures = list[str]()

    def measure(scene: Path, progress: Progress) -> list[Measurement]:
        if options.gaussians:
            return compare_at_counts(scene, options.gaussians, plan, progress=progress)
        return compare(scene, plan, on_failure=external_failures.append, progress=progress)

    found, failures = each_scene(options, measure)
    rows = [replace(row, scene=name) for name, row in found]
    equals = at_equal_psnr(rows)
    entries = [row.as_dict() for row in rows]
    for row, entry in zip(rows, entries, strict=True):
        if row.is_external and options.quality_offsets:
            matching = (equal for equal in equals if (equal.scene, equal.external) == (row.scene, row.codec))
            entry["at_equal_psnr"] = [equal.as_dict() for equal in matching]
    draw = partial(scaling_plot if options.gaussians else comparison_plot, rows)
    return BenchOutput(rows=entries, table=bench_tables(rows, equals), draw=draw, failures=external_failures + failures)


def _plan(options: BenchOptions) -> BenchmarkPlan:
    from kissgs.benchmark.comparison import BenchmarkPlan
    from kissgs.settings import Preset

    presets = [chosen(name, options.changes) for name in options.presets or list(Preset)]
    curve_presets = [settings for settings in presets if settings.encode.rate_distortion]
    if not options.presets:
        curve_presets = [settings for settings in curve_presets if settings.preset == Preset.BALANCED]
    if options.quality_offsets and not curve_presets:
        raise UnsupportedError("--quality-offset needs a preset with rate-distortion planning: balanced or small")
    evaluation_implied = (
        options.views is not None
        or bool(options.quality_offsets)
        or (options.plot is not None and not options.gaussians)
    )
    return BenchmarkPlan(
        presets=presets,
        curve_presets=curve_presets,
        quality_offsets=options.quality_offsets,
        external_codecs=options.external_codecs,
        splat_transform=shlex.split(options.splat_transform),
        sog_iterations=options.sog_iterations,
        repeats=options.repeats,
        evaluate=options.evaluate or evaluation_implied,
        views=options.views,
        threads=options.threads,
    )


def ablation(options: BenchOptions) -> BenchOutput:
    """Measure presets with one part of the codec left out at a time."""
    from kissgs.benchmark.ablation import ablate
    from kissgs.cli.bench_tables import ablation_table

    presets = [chosen(name, options.changes) for name in options.presets or ("paper", "balanced")]
    rows, failures = each_scene(
        options,
        lambda scene, progress: ablate(scene, presets, options.views, threads=options.threads, progress=progress),
    )
    entries = [{"scene": scene, **row.as_dict()} for scene, row in rows]
    return BenchOutput(rows=entries, table=ablation_table(rows), failures=failures)


def rendering(options: BenchOptions) -> BenchOutput:
    """Measure the CPU time of the rasteriser."""
    from kissgs.benchmark.render_speed import rendering_cost, resampled
    from kissgs.cameras.virtual.select import virtual_views
    from kissgs.cli.evaluation_tables import rendering_table
    from kissgs.pipeline.scene_files import load

    def measure(scene: Path, progress: Progress) -> list[RenderingCost]:
        splats = load(scene, threads=options.threads, progress=progress)
        views = options.views or virtual_views(splats, threads=options.threads, progress=progress)
        cameras = [view.camera for view in views.test or views.train]
        return [
            rendering_cost(resampled(splats, count), cameras, threads=options.threads, progress=progress)
            for count in options.gaussians or [len(splats)]
        ]

    rows, failures = each_scene(options, measure)
    entries = [{"scene": scene, **cost.as_dict()} for scene, cost in rows]
    return BenchOutput(rows=entries, table=rendering_table(rows), failures=failures)
