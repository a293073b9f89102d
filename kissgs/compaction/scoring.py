"""Which Gaussians show least: the score of GaussianPOP, and pruning by it."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from kissgs._typing import Float, Float32, Int
from kissgs.progress import Progress, silent
from kissgs.rendering.camera import Camera
from kissgs.rendering.coverage import Coverage
from kissgs.rendering.rasterizer import removal_scores
from kissgs.splats import Splats


def highest(scores: Float[np.ndarray, " N"], count: int) -> Int[np.ndarray, " M"]:
    """Where the ``count`` highest scores stand, exactly so many, in their order; of equal ones, the first."""
    chosen = np.argsort(-scores, kind="stable")[:count]
    return np.sort(chosen)


def show_most(
    splats: Splats,
    cameras: Sequence[Camera],
    background: Float32[np.ndarray, "3"],
    count: int,
    *,
    share: float = 0.0,
    least: float = 0.0,
    threads: int = 0,
    progress: Progress = silent,
) -> Int[np.ndarray, " M"]:
    """Which ``count`` Gaussians to keep: those whose removal would change the pictures most.

    GaussianPOP, section 3, in as many rounds as ``share`` asks for. A score is the error of one removal alone: of two
    Gaussians, one behind the other, each may be superfluous only as long as the other is there. So a part is removed,
    by the same factor in each round, and the rest is scored anew.

    Args:
        splats: finite.
        cameras: pictures to take.
        background: of all of them.
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
        scores = removal_scores(scene, cameras, background=background.tolist(), threads=threads, progress=part)
        scores = np.maximum(scores, least * _prior(scores, nearby[kept]))
        left = count if round_ == rounds - 1 else max(count, round(len(splats) * shrink ** (round_ + 1)))
        kept = kept[highest(scores, left)]
    progress("score", 1.0)
    return kept


def _prior(scores: Float[np.ndarray, " N"], nearby: Float[np.ndarray, " N"]) -> Float[np.ndarray, " N"]:
    """Scores that cameras near each Gaussian would find, with nothing in front of it."""
    known = (scores > 0) & (nearby > 0)
    if not known.any():
        return nearby
    return np.asarray(np.median(scores[known] / nearby[known]) * nearby)
