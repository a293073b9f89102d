"""Strategies of compaction compared: quality, bytes and time at equal counts after equal numbers of training steps."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from typing import Any, Literal

import numpy as np

from kissgs.cameras.views import TargetSource, Views
from kissgs.compaction.evaluate import evaluate_scene
from kissgs.compaction.popspa import Popspa
from kissgs.compaction.scoring import highest_indices
from kissgs.core.errors import InvalidSceneError
from kissgs.core.progress import Progress, silent
from kissgs.core.splats import Splats
from kissgs.evaluation.results import ImageMetrics
from kissgs.settings import CompactSettings
from kissgs.training.supervision import SCORING_STRIDE, SupervisionViews, supervision_views

RATIOS = (0.7, 0.5, 0.3, 0.2, 0.1, 0.05)
"""Shares of the Gaussians that are kept, by default."""


@dataclass(frozen=True, slots=True, kw_only=True)
class CompactionPoint:
    """Result of one strategy at one count.

    Attributes:
        strategy: its name in :data:`STRATEGIES`, or "input" for the uncompacted scene.
        count: number of Gaussians left.
        psnr: decibels, mean over held-out views, to photographs or, without those, to renderings of the input.
        ssim: SSIM of the same images, mean over views.
        ms_ssim: MS-SSIM of the same images, mean over views.
        bytes: size of its container with the preset ``fast``.
        seconds: wall time, without the rendering of training targets, which all strategies share.
        cpu_seconds: CPU time of all threads in that time.
    """

    strategy: str
    count: int
    psnr: float
    ssim: float
    ms_ssim: float
    bytes: int
    seconds: float
    cpu_seconds: float

    def as_dict(self) -> dict[str, Any]:
        """Return all attributes by name, for JSON."""
        return asdict(self)


def random_subset(splats: Splats, count: int) -> Splats:
    """Return ``count`` random Gaussians, in their order, with a fixed seed."""
    return splats.select(np.sort(np.random.default_rng(0).permutation(len(splats))[:count]))


def most_opaque(splats: Splats, count: int) -> Splats:
    """Return the ``count`` most opaque Gaussians, in their order."""
    return splats.select(highest_indices(splats.opacities, count))


def merged(splats: Splats, count: int) -> Splats:
    """Return ``count`` Gaussians by merging."""
    from kissgs.compaction.merging import merge_gaussians

    return merge_gaussians(splats, count)[0]


@dataclass(frozen=True, slots=True)
class Strategy:
    """A strategy to reduce the number of Gaussians.

    Attributes:
        name: name in tables and of the option ``--strategy``.
        training: "none", "after" a single pruning, or "along" with prunings and after the last one.
        start: function of the scene and the count that returns fewer Gaussians; None to keep the highest scores.
        changes: changes of the compaction settings.
    """

    name: str
    training: Literal["none", "after", "along"]
    start: Callable[[Splats, int], Splats] | None = None
    changes: Mapping[str, Any] = field(default_factory=dict)

    def apply(self, settings: CompactSettings) -> CompactSettings:
        """Return the settings of this strategy; if it trains, with as many steps in total as ``settings``."""
        steps = {"sparsify_steps": 0, "refine_steps": settings.steps if self.training == "after" else 0}
        return settings.model_copy(update={**(steps if self.training != "along" else {}), **self.changes})


AT_ONCE, IN_ROUNDS = {"min_keep_per_scoring": 0.0}, {"min_keep_per_scoring": 0.8}
ONE_ROUND, FIVE_ROUNDS = (
    {**IN_ROUNDS, "prune_rounds": rounds, "admm_rho": 0.0, "erank_weight": 0.0} for rounds in (1, 5)
)
ADMM, ERANK = {"admm_rho": 5e-4}, {"erank_weight": 0.01}
"""Weights in the published code of GaussianSpa and of the effective-rank loss."""

STRATEGIES = (
    Strategy("random", "none", random_subset),
    Strategy("opacity", "none", most_opaque),
    Strategy("POP", "none", changes=AT_ONCE),
    Strategy("POP in rounds", "none", changes=IN_ROUNDS),
    Strategy("merge", "none", merged),
    Strategy("opacity + refine", "after", most_opaque),
    Strategy("POP + refine", "after", changes=AT_ONCE),
    Strategy("POP in rounds + refine", "after", changes=IN_ROUNDS),
    Strategy("merge + refine", "after", merged),
    Strategy("POP + train + POP + refine", "along", changes=ONE_ROUND),
    Strategy("POP + sparsify + POP + refine", "along", changes={**ONE_ROUND, **ADMM}),
    Strategy("POPSpa", "along", changes={**ONE_ROUND, **ADMM, **ERANK}),
    Strategy("prunings along the way", "along", changes=FIVE_ROUNDS),
    Strategy("prunings along the way + sparsify", "along", changes={**FIVE_ROUNDS, **ADMM}),
    Strategy("prunings along the way + erank", "along", changes={**FIVE_ROUNDS, **ERANK}),
)
"""All strategies, the fastest first. Each fixes the settings that its name mentions and takes the others as given."""


def compare_strategies(
    splats: Splats,
    settings: CompactSettings,
    views: Views | None = None,
    *,
    ratios: Sequence[float] = RATIOS,
    strategies: Sequence[Strategy] = STRATEGIES,
    supervision: TargetSource = "photos",
    threads: int = 0,
    progress: Progress = silent,
) -> list[CompactionPoint]:
    """Return the results of the uncompacted scene, then of each strategy at each ratio.

    Args:
        splats: a clean scene.
        settings: compaction settings; every strategy that trains takes as many steps in total. Strategies that train
            are left out if there are none.
        views: a capture; None for virtual views with the scene's own renderings as targets.
        ratios: shares of the Gaussians to keep, above 0 and up to 1.
        strategies: some of :data:`STRATEGIES`.
        supervision: the part of the capture that training uses; its held-out views evaluate in any case.
        threads: number of threads; 0 means one per processor.
        progress: receives the stages of compaction.

    Raises:
        InvalidSceneError: the scene has no Gaussians.
    """
    if not len(splats):
        raise InvalidSceneError("the scene has no Gaussians to compact; give one that has some")
    supervised = _supervision(splats, settings, views, supervision, threads, progress)
    strategies = [strategy for strategy in strategies if settings.trains or strategy.training == "none"]
    targets = None
    if any(strategy.training != "none" for strategy in strategies):
        from kissgs.training.targets import training_targets

        targets = training_targets(splats, supervised, threads=threads, progress=progress)
    metrics, size = evaluate_scene(splats, splats, supervised, threads, progress)
    points = [_point("input", splats, metrics, size, 0.0, 0.0)]
    for strategy in strategies:
        for ratio in ratios:
            count = max(1, round(len(splats) * ratio))
            wall, cpu = time.perf_counter(), time.process_time()
            scene = splats if strategy.start is None else strategy.start(splats, count)
            task = Popspa(
                scene,
                strategy.apply(settings),
                supervised,
                reference=splats,
                targets=targets,
                threads=threads,
                progress=progress,
            )
            found = task(count)
            wall, cpu = time.perf_counter() - wall, time.process_time() - cpu
            metrics, size = evaluate_scene(found.splats, splats, supervised, threads, progress)
            points.append(_point(strategy.name, found.splats, metrics, size, wall, cpu))
    return points


def _point(
    strategy: str, scene: Splats, metrics: ImageMetrics, size: int, seconds: float, cpu_seconds: float
) -> CompactionPoint:
    return CompactionPoint(
        strategy=strategy,
        count=len(scene),
        psnr=metrics.psnr,
        ssim=metrics.ssim,
        ms_ssim=metrics.ms_ssim,
        bytes=size,
        seconds=seconds,
        cpu_seconds=cpu_seconds,
    )


def _supervision(
    splats: Splats,
    settings: CompactSettings,
    views: Views | None,
    supervision: TargetSource,
    threads: int,
    progress: Progress,
) -> SupervisionViews:
    stride = SCORING_STRIDE if settings.trains else 1
    used = None if views is None else views.for_training(supervision)
    return supervision_views(splats, used, settings, scoring_stride=stride, threads=threads, progress=progress)
