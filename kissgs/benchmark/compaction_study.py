"""Ways to have fewer Gaussians, side by side: what each gives at the same count, after the same number of steps."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from typing import Any, Literal

import numpy as np

from kissgs.cameras.views import TargetSource, Views
from kissgs.compaction.evaluate import evaluate_scene
from kissgs.compaction.popspa import popspa
from kissgs.compaction.scoring import highest
from kissgs.core.array_types import Int
from kissgs.core.errors import InvalidSceneError
from kissgs.core.progress import Progress, silent
from kissgs.core.splats import Splats
from kissgs.settings import CompactSettings
from kissgs.training.supervision import SCORED, SupervisionViews, supervision_views

RATIOS = (0.7, 0.5, 0.3, 0.2, 0.1, 0.05)


@dataclass(frozen=True, slots=True, kw_only=True)
class Point:
    """One way at one count.

    Attributes:
        way: its name in :data:`WAYS`, or "input".
        count: Gaussians left.
        psnr: decibels, mean over held-out views: to photographs, or to the input's renderings where there are none.
        ssim: the same.
        bytes: of its container as the preset ``fast`` makes it.
        seconds: wall time, without that of taking the pictures to learn from, which all ways share.
        cpu_seconds: the same of all threads.
    """

    way: str
    count: int
    psnr: float
    ssim: float
    bytes: int
    seconds: float
    cpu_seconds: float

    def as_dict(self) -> dict[str, Any]:
        """For machines."""
        return asdict(self)


def by_chance(splats: Splats, count: int) -> Int[np.ndarray, " M"]:
    """Any, the same each time."""
    return np.sort(np.random.default_rng(0).permutation(len(splats))[:count])


def by_opacity(splats: Splats, count: int) -> Int[np.ndarray, " M"]:
    """The most opaque ones."""
    return highest(splats.opacities, count)


@dataclass(frozen=True, slots=True)
class Way:
    """One of them.

    Attributes:
        name: for people.
        training: none; after one pruning; or while Gaussians go, and after that.
        start: which Gaussians are left, given the scene and the count; None for those that score best.
        changes: of the settings.
    """

    name: str
    training: Literal["none", "after", "along"]
    start: Callable[[Splats, int], Int[np.ndarray, " M"]] | None = None
    changes: Mapping[str, Any] = field(default_factory=dict)

    def settings(self, chosen: CompactSettings) -> CompactSettings:
        """Of the recipe, with as many steps in all as there were."""
        steps = {"sparsify_steps": 0, "refine_steps": chosen.steps if self.training == "after" else 0}
        return chosen.model_copy(update={**(steps if self.training != "along" else {}), **self.changes})


AT_ONCE, IN_ROUNDS = {"min_keep_per_scoring": 0.0}, {"min_keep_per_scoring": 0.8}
ONE, FIVE = ({**IN_ROUNDS, "prune_rounds": rounds, "admm_rho": 0.0, "erank_weight": 0.0} for rounds in (1, 5))
RHO, NEEDLES = {"admm_rho": 5e-4}, {"erank_weight": 0.01}
"""Of GaussianSpa's and of effective rank's published code."""

WAYS = (
    Way("random", "none", by_chance),
    Way("opacity", "none", by_opacity),
    Way("POP", "none", changes=AT_ONCE),
    Way("POP in rounds", "none", changes=IN_ROUNDS),
    Way("opacity + refine", "after", by_opacity),
    Way("POP + refine", "after", changes=AT_ONCE),
    Way("POP in rounds + refine", "after", changes=IN_ROUNDS),
    Way("POP + train + POP + refine", "along", changes=ONE),
    Way("POP + sparsify + POP + refine", "along", changes={**ONE, **RHO}),
    Way("POPSpa", "along", changes={**ONE, **RHO, **NEEDLES}),
    Way("prunings along the way", "along", changes=FIVE),
    Way("prunings along the way + sparsify", "along", changes={**FIVE, **RHO}),
    Way("prunings along the way + erank", "along", changes={**FIVE, **NEEDLES}),
)
"""All of them, the cheapest first. What a name says does not depend on the settings; all else does."""


def study(
    splats: Splats,
    settings: CompactSettings,
    views: Views | None = None,
    *,
    ratios: Sequence[float] = RATIOS,
    ways: Sequence[Way] = WAYS,
    learn_from: TargetSource = "photos",
    threads: int = 0,
    progress: Progress = silent,
) -> list[Point]:
    """Try every way at every ratio.

    Args:
        splats: clean.
        settings: of the recipe; all ways that train have as many steps in all. Without steps, they are left out.
        views: a capture; by default virtual views, with the scene as the teacher.
        ratios: counts, as shares of the scene's.
        ways: some of :data:`WAYS`.
        learn_from: how much of the capture is learned from; its held-out views judge in any case.
        threads: 0 means one per processor.
        progress: receives the stages of the recipe.

    Raises:
        InvalidSceneError: there are no Gaussians.
    """
    if not len(splats):
        raise InvalidSceneError("the scene has no Gaussians, and cannot have fewer")
    taught = _taught(splats, settings, views, learn_from, threads, progress)
    ways = [way for way in ways if settings.trains or way.training == "none"]
    taken = None
    if any(way.training != "none" for way in ways):
        from kissgs.training.targets import training_targets

        taken = training_targets(splats, taught.train, taught.background, threads=threads, progress=progress)

    def judged(way: str, scene: Splats, seconds: float, cpu_seconds: float) -> Point:
        likeness, size = evaluate_scene(scene, splats, taught, threads, progress)
        return Point(
            way=way,
            count=len(scene),
            psnr=likeness.psnr,
            ssim=likeness.ssim,
            bytes=size,
            seconds=seconds,
            cpu_seconds=cpu_seconds,
        )

    points = [judged("input", splats, 0.0, 0.0)]
    for way in ways:
        for ratio in ratios:
            count = max(1, round(len(splats) * ratio))
            wall, cpu = time.perf_counter(), time.process_time()
            scene = splats if way.start is None else splats.select(way.start(splats, count))
            found = popspa(
                *(scene, count, way.settings(settings), taught),
                reference=splats,
                targets=taken,
                threads=threads,
                progress=progress,
            )
            points.append(judged(way.name, found.splats, time.perf_counter() - wall, time.process_time() - cpu))
    return points


def _taught(
    splats: Splats,
    settings: CompactSettings,
    views: Views | None,
    learn_from: TargetSource,
    threads: int,
    progress: Progress,
) -> SupervisionViews:
    scored = SCORED if settings.trains else 1
    learned = None if views is None else views.for_training(learn_from)
    return supervision_views(splats, learned, settings, scored=scored, threads=threads, progress=progress)
