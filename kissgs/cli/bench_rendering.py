"""``kissgs bench rendering``."""

from __future__ import annotations

from typing import TYPE_CHECKING

from kissgs.cli.bench_scenes import BenchInputs, BenchOutput, each_scene

if TYPE_CHECKING:
    from pathlib import Path

    from kissgs.benchmark.render_speed import RenderingCost
    from kissgs.core.progress import Progress


def rendering(inputs: BenchInputs, counts: list[int]) -> BenchOutput:
    """Measure the CPU time of the rasteriser on scenes resampled to each count, or as they are if there is none."""
    from kissgs.benchmark.render_speed import rendering_cost, resampled
    from kissgs.cameras.virtual.select import virtual_views
    from kissgs.cli.evaluation_tables import rendering_table
    from kissgs.pipeline.scene_files import load

    def measure(scene: Path, progress: Progress) -> list[RenderingCost]:
        splats = load(scene, threads=inputs.threads, progress=progress)
        views = inputs.views or virtual_views(splats, threads=inputs.threads, progress=progress)
        cameras = [view.camera for view in views.test or views.train]
        return [
            rendering_cost(resampled(splats, count), cameras, threads=inputs.threads, progress=progress)
            for count in counts or [len(splats)]
        ]

    rows, failures = each_scene(inputs.scenes, measure)
    entries = [{"scene": scene, **cost.as_dict()} for scene, cost in rows]
    return BenchOutput(rows=entries, table=rendering_table(rows), failures=failures)
