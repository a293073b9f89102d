"""Pruning by the scores of GaussianPOP: the squared image error that the removal of one Gaussian would cause."""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from kissgs.cameras.views import View
from kissgs.core.array_types import Float, Float32, Float64, Int
from kissgs.core.context import DEFAULT_CONTEXT, Context
from kissgs.core.splats import Splats
from kissgs.rendering.camera import Camera
from kissgs.rendering.rasterizer import removal_scores
from kissgs.rendering.sensitivity import Coverage


def highest_indices(scores: Float[np.ndarray, " N"], count: int) -> Int[np.ndarray, " M"]:
    """Return the indices of the ``count`` highest scores, ascending; of equal scores the first are selected."""
    selected = np.argsort(-scores, kind="stable")[:count]
    return np.sort(selected)


def prune_by_score(
    splats: Splats,
    views: Sequence[View],
    background: Float32[np.ndarray, "3"],
    count: int,
    context: Context = DEFAULT_CONTEXT,
    *,
    min_keep_per_scoring: float = 0.0,
    min_score: float = 0.0,
) -> Int[np.ndarray, " M"]:
    """Return the indices of the ``count`` Gaussians to keep: those whose removal would change the images most.
    GaussianPOP, section 3, with mean squared errors, so that every image has the same weight whatever its size. A score
    is the error of a single removal: of two Gaussians, one behind the other, each may be superfluous only while the
    other is there. So deep pruning is done in rounds that remove the same share each, and the remaining Gaussians are
    scored anew after each. No round leaves less than ``min_keep_per_scoring`` of them (0: a single round), and no score
    is below ``min_score`` of what an unobstructed camera nearby would find."""
    kept = np.arange(len(splats))
    close_up = Coverage(splats).close_up
    share = min_keep_per_scoring
    rounds = max(1, math.ceil(math.log(count / max(len(splats), count)) / math.log(share) - 1e-9)) if share > 0 else 1
    shrink = (count / max(len(splats), 1)) ** (1 / rounds)
    for round_ in range(rounds):
        if len(kept) <= count:
            break

        def report(stage: str, fraction: float, note: str = "", done: int = round_) -> None:
            context.progress(stage, (done + fraction) / rounds, note)

        scene = splats.select(kept)
        scores = _mean_scores(scene, views, background, replace(context, progress=report))
        scores = np.maximum(scores, min_score * _nearby_scores(scores, close_up[kept]))
        left = count if round_ == rounds - 1 else max(count, round(len(splats) * shrink ** (round_ + 1)))
        kept = kept[highest_indices(scores, left)]
    context.progress("score", 1.0)
    return kept


def _mean_scores(
    scene: Splats, views: Sequence[View], background: Float32[np.ndarray, "3"], context: Context
) -> Float64[np.ndarray, " N"]:
    """Return the sum over views of the mean squared error that each removal causes, each view on its background."""
    groups = defaultdict[tuple[int, tuple[float, ...]], list[Camera]](list)
    for view in views:
        view_background = background if view.background is None else view.background
        groups[view.camera.width * view.camera.height, tuple(view_background.tolist())].append(view.camera)
    scores, done = np.zeros(len(scene)), 0
    for (pixels, colour), cameras in groups.items():

        def report(stage: str, fraction: float, note: str = "", done: int = done, count: int = len(cameras)) -> None:
            context.progress(stage, (done + fraction * count) / len(views), note)

        found = removal_scores(scene, cameras, replace(context, progress=report), background=colour)
        scores += found / (3 * pixels)
        done += len(cameras)
    return scores


def _nearby_scores(scores: Float[np.ndarray, " N"], close_up: Float[np.ndarray, " N"]) -> Float[np.ndarray, " N"]:
    """Estimate the score that an unobstructed camera near each Gaussian would find. It is taken as proportional to
    ``close_up``, see :attr:`kissgs.rendering.sensitivity.Coverage.close_up`; the factor is the median over the
    Gaussians that were seen, or 1 if none was."""
    seen = (scores > 0) & (close_up > 0)
    if not seen.any():
        return close_up
    return np.asarray(np.median(scores[seen] / close_up[seen]) * close_up)
