"""Ways to have fewer Gaussians, side by side: what each gives at the same count, after the same number of steps."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, field, replace
from typing import Any, Literal

import numpy as np

from kissgs._typing import Int
from kissgs.compaction.judging import judge
from kissgs.compaction.popspa import popspa
from kissgs.compaction.school import School, held_out, school
from kissgs.compaction.scoring import highest
from kissgs.progress import Progress, silent
from kissgs.settings import CompactSettings
from kissgs.splats import Splats
from kissgs.views.view import Views

RATIOS = (0.7, 0.5, 0.3, 0.2, 0.1, 0.05)

Source = Literal["photos", "cameras", "scene"]
"""What to learn from: a capture's photographs; its cameras alone, with pictures of the scene as it was; or the scene
alone, from virtual cameras."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Point:
    """One way at one count.

    Attributes:
        way: its name in :data:`WAYS`, or "input".
        count: Gaussians left.
        psnr: decibels, mean over held-out views: to photographs, or to the input's renderings where there are none.
        ssim: the same.
        bytes: of its container as the preset ``fast`` makes it.
        seconds: wall time.
        cpu_seconds: of all threads.
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


@dataclass(frozen=True, slots=True)
class Way:
    """One of them: whom it begins from, and what the recipe's settings are then.

    Attributes:
        name: for people.
        start: which Gaussians, given the scene and the count; None for those that score best.
        changes: of the settings, given the number of steps that all ways have.
    """

    name: str
    start: Callable[[Splats, int], Int[np.ndarray, " M"]] | None = None
    changes: Callable[[int], dict[str, Any]] = field(default=lambda steps: {})


def by_chance(splats: Splats, count: int) -> Int[np.ndarray, " M"]:
    """Any, the same each time."""
    return np.sort(np.random.default_rng(0).permutation(len(splats))[:count])


def by_opacity(splats: Splats, count: int) -> Int[np.ndarray, " M"]:
    """The most opaque ones."""
    return highest(splats.opacities, count)


def _no_steps(steps: int) -> dict[str, Any]:
    return {"sparsify_steps": 0, "refine_steps": 0}


def _refined(steps: int) -> dict[str, Any]:
    return {"sparsify_steps": 0, "refine_steps": steps}


RHO, NEEDLES = 5e-4, 0.01
"""Of GaussianSpa's and of effective rank's published code."""

WAYS = (
    Way("random", by_chance, _no_steps),
    Way("opacity", by_opacity, _no_steps),
    Way("POP", changes=lambda steps: {**_no_steps(steps), "score_share": 0.0}),
    Way("POP in rounds", changes=_no_steps),
    Way("opacity + refine", by_opacity, _refined),
    Way("POP + refine", changes=lambda steps: {**_refined(steps), "score_share": 0.0}),
    Way("POP in rounds + refine", changes=_refined),
    Way("POP, train, POP, refine", changes=lambda steps: {"rounds": 1, "rho": 0.0}),
    Way("POP, sparsify, POP, refine", changes=lambda steps: {"rounds": 1, "rho": RHO}),
    Way("POPSpa", changes=lambda steps: {"rounds": 1, "rho": RHO, "needle_weight": NEEDLES}),
    Way("prunings along the way", changes=lambda steps: {"rho": 0.0, "needle_weight": 0.0}),
    Way("the same, sparsified", changes=lambda steps: {"rho": RHO, "needle_weight": 0.0}),
    Way("the same, with erank", changes=lambda steps: {"rho": 0.0, "needle_weight": NEEDLES}),
)
"""All of them, the cheapest first."""


def study(
    splats: Splats,
    settings: CompactSettings,
    views: Views | None = None,
    *,
    ratios: Sequence[float] = RATIOS,
    ways: Sequence[Way] = WAYS,
    learn_from: Source = "photos",
    threads: int = 0,
    progress: Progress = silent,
) -> list[Point]:
    """Try every way at every ratio.

    Args:
        splats: clean.
        settings: of the recipe; ways that differ from it have as many steps in all.
        views: a capture; by default virtual views, with the scene as the teacher.
        ratios: counts, as shares of the scene's.
        ways: some of :data:`WAYS`.
        learn_from: how much of the capture is learned from; its held-out views judge in any case.
        threads: 0 means one per processor.
        progress: receives the stages of the recipe.
    """
    taught = _taught(splats, settings, views, learn_from, threads, progress)
    steps = settings.sparsify_steps + settings.refine_steps

    def judged(way: str, scene: Splats, seconds: float, cpu_seconds: float) -> Point:
        likeness, size = judge(scene, splats, taught, threads, progress)
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
            chosen = CompactSettings(**{**settings.model_dump(), **way.changes(steps)})
            wall, cpu = time.perf_counter(), time.process_time()
            scene = splats if way.start is None else splats.select(way.start(splats, count))
            found = popspa(scene, count, chosen, taught, teacher=splats, threads=threads, progress=progress)
            points.append(judged(way.name, found.splats, time.perf_counter() - wall, time.process_time() - cpu))
    return points


def _taught(
    splats: Splats, settings: CompactSettings, views: Views | None, learn_from: Source, threads: int, progress: Progress
) -> School:
    if views is None or learn_from == "photos":
        return school(splats, views, settings, threads=threads, progress=progress)
    if learn_from == "cameras":
        bare = tuple(replace(view, photo=None) for view in views.train)
        return school(splats, replace(views, train=bare), settings, threads=threads, progress=progress)
    alone = school(splats, None, settings, threads=threads, progress=progress)
    return replace(alone, test=held_out(views, settings.view_size), background=views.background)
