"""Which Gaussians show least: the score of GaussianPOP, and pruning by it."""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Sequence

import numpy as np

from kissgs.cameras.views import View
from kissgs.core.array_types import Float, Float32, Float64, Int
from kissgs.core.progress import Progress, silent
from kissgs.core.splats import Splats
from kissgs.rendering.camera import Camera
from kissgs.rendering.coverage import Coverage
from kissgs.rendering.rasterizer import removal_scores


def highest(scores: Float[np.ndarray, " N"], count: int) -> Int[np.ndarray, " M"]:
    """Where the ``count`` highest scores stand, exactly so many, in their order; of equal ones, the first."""
    chosen = np.argsort(-scores, kind="stable")[:count]
    return np.sort(chosen)


def show_most(
    splats: Splats,
    views: Sequence[View],
    background: Float32[np.ndarray, "3"],
    count: int,
    *,
    share: float = 0.0,
    least: float = 0.0,
    threads: int = 0,
    progress: Progress = silent,
) -> Int[np.ndarray, " M"]:
    """Which ``count`` Gaussians to keep: those whose removal would change the pictures most.

    GaussianPOP, section 3, every picture counting the same whatever its size, in as many rounds as ``share`` asks for.
    A score is the error of one removal alone: of two Gaussians, one behind the other, each may be superfluous only as
    long as the other is there. So a part is removed, by the same factor in each round, and the rest is scored anew.

    Args:
        splats: finite.
        views: pictures to take.
        background: of those that have none of their own.
        count: at least 1.
        share: the smallest that one scoring may leave, from 0 (one scoring will do) to less than 1.
        least: lowest score of any Gaussian, seen or not, in units of what a camera nearby would probably find.
        threads: 0 means one per processor; the choice does not depend on it.
        progress: receives the stage ``"score"``.

    Returns:
        Their numbers, rising.
    """
    kept = np.arange(len(splats))
    nearby = Coverage(splats).close_up
    rounds = max(1, math.ceil(math.log(count / max(len(splats), count)) / math.log(share) - 1e-9)) if share > 0 else 1
    shrink = (count / max(len(splats), 1)) ** (1 / rounds)
    for round_ in range(rounds):
        if len(kept) <= count:
            break

        def part(stage: str, fraction: float, note: str = "", done: int = round_) -> None:
            progress(stage, (done + fraction) / rounds, note)

        scene = splats.select(kept)
        scores = _scores(scene, views, background, threads, part)
        scores = np.maximum(scores, least * _prior(scores, nearby[kept]))
        left = count if round_ == rounds - 1 else max(count, round(len(splats) * shrink ** (round_ + 1)))
        kept = kept[highest(scores, left)]
    progress("score", 1.0)
    return kept


def _scores(
    scene: Splats, views: Sequence[View], background: Float32[np.ndarray, "3"], threads: int, progress: Progress
) -> Float64[np.ndarray, " N"]:
    """Sum of mean squared errors over all views, each before its own background."""
    groups = defaultdict[tuple[int, tuple[float, ...]], list[Camera]](list)
    for view in views:
        behind = background if view.background is None else view.background
        groups[view.camera.width * view.camera.height, tuple(behind.tolist())].append(view.camera)
    scores, done = np.zeros(len(scene)), 0
    for (pixels, colour), cameras in groups.items():

        def part(stage: str, fraction: float, note: str = "", done: int = done, count: int = len(cameras)) -> None:
            progress(stage, (done + fraction * count) / len(views), note)

        scores += removal_scores(scene, cameras, background=colour, threads=threads, progress=part) / (3 * pixels)
        done += len(cameras)
    return scores


def _prior(scores: Float[np.ndarray, " N"], nearby: Float[np.ndarray, " N"]) -> Float[np.ndarray, " N"]:
    """Scores that cameras near each Gaussian would find, with nothing in front of it."""
    known = (scores > 0) & (nearby > 0)
    if not known.any():
        return nearby
    return np.asarray(np.median(scores[known] / nearby[known]) * nearby)
