"""``kissgs bench ablation``."""

from __future__ import annotations

from kissgs.cli.bench_scenes import BenchInputs, BenchOutput, each_scene
from kissgs.cli.options import chosen


def ablation(inputs: BenchInputs, *, presets: list[str] | None = None, changes: list[str] | None = None) -> BenchOutput:
    """Measure presets, by default paper and balanced, with one part of the codec left out at a time."""
    from kissgs.benchmark.ablation import ablate
    from kissgs.cli.bench_tables import ablation_table

    settings = [chosen(name, changes) for name in presets or ("paper", "balanced")]
    rows, failures = each_scene(
        inputs.scenes,
        lambda scene, progress: ablate(scene, settings, inputs.views, threads=inputs.threads, progress=progress),
    )
    entries = [{"scene": scene, **row.as_dict()} for scene, row in rows]
    return BenchOutput(rows=entries, table=ablation_table(rows), failures=failures)
