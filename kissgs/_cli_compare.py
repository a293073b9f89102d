"""``kissgs bench`` as it is, ``--ablate`` and ``--rendering``: presets, peers, what each choice is worth, pictures."""

from __future__ import annotations

import shlex
from functools import partial
from pathlib import Path

from kissgs._cli_settings import chosen
from kissgs._cli_study import Asked, Outcome
from kissgs._console import progress_bar
from kissgs.errors import UnsupportedError


def comparison(asked: Asked) -> Outcome:
    """Presets, points of their curves, and peers; or presets on the scene at other sizes."""
    from kissgs._bench_plots import comparison_plot, growth_plot
    from kissgs._bench_tables import bench_tables
    from kissgs.comparison import Plan, compare, growth
    from kissgs.measured import Measured, at_equal_psnr
    from kissgs.settings import Preset

    if asked.gaussians and (asked.peers or asked.fidelities):
        raise UnsupportedError("--gaussians measures how times grow: without --peer and --fidelity")
    presets = [chosen(name, asked.changes) for name in asked.presets or list(Preset)]
    curved = [settings for settings in presets if settings.encode.weigh]
    if not asked.presets:
        curved = [settings for settings in curved if settings.preset == Preset.BALANCED]
    if asked.fidelities and not curved:
        raise UnsupportedError("--fidelity is of presets that weigh bits: balanced or small")
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
    rows, failures = list[Measured](), list[str]()
    with progress_bar(False) as progress:
        for scene in map(Path, asked.scenes):
            if asked.gaussians:
                rows += growth(scene, asked.gaussians, plan, progress=progress)
            else:
                rows += compare(scene, plan, failed=failures.append, progress=progress)
    equals = at_equal_psnr(rows)
    told = [row.as_dict() for row in rows]
    for row, entry in zip(rows, told, strict=True):
        of = (equal for equal in equals if (equal.scene, equal.peer) == (row.scene, row.encoder))
        if row.is_peer and asked.fidelities:
            entry["at_equal_psnr"] = [equal.as_dict() for equal in of]
    draw = partial(growth_plot if asked.gaussians else comparison_plot, rows)
    return Outcome(rows=told, table=bench_tables(rows, equals), draw=draw, failures=failures)


def ablation(asked: Asked) -> Outcome:
    """What each part is worth."""
    from kissgs._bench_tables import ablation_table
    from kissgs.ablation import ablate

    presets = [chosen(name, asked.changes) for name in asked.presets or ("paper", "balanced")]
    rows = []
    with progress_bar(False) as progress:
        for scene in map(Path, asked.scenes):
            found = ablate(scene, presets, asked.views, threads=asked.threads, progress=progress)
            rows += [(scene.name, row) for row in found]
    return Outcome(rows=[{"scene": scene, **row.as_dict()} for scene, row in rows], table=ablation_table(rows))


def rendering(asked: Asked) -> Outcome:
    """What pictures cost."""
    from kissgs._picture_tables import rendering_table
    from kissgs.evaluation.speed import rendering_cost, resampled
    from kissgs.scenes import load
    from kissgs.views.virtual import virtual_views

    rows = []
    with progress_bar(False) as progress:
        for scene in asked.scenes:
            splats = load(scene, threads=asked.threads, progress=progress)
            views = asked.views or virtual_views(splats, threads=asked.threads, progress=progress)
            cameras = [view.camera for view in views.test or views.train]
            for count in asked.gaussians or [len(splats)]:
                sized = resampled(splats, count)
                cost = rendering_cost(sized, cameras, threads=asked.threads, progress=progress)
                rows.append((Path(scene).name, cost))
    return Outcome(rows=[{"scene": scene, **cost.as_dict()} for scene, cost in rows], table=rendering_table(rows))
