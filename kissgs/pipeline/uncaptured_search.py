"""``search_without_photographs``: fewer Gaussians where no photographs can train them."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from kissgs.evaluation.psnr_loss import psnr_of
from kissgs.pipeline.goal import HALF_ERROR_DB
from kissgs.pipeline.path_containers import RENDERED_POINTS, PathContainers
from kissgs.pipeline.path_points import KEEP
from kissgs.pipeline.pruning import is_prunable

if TYPE_CHECKING:
    from kissgs.pipeline.rate_control import RateControl
    from kissgs.pipeline.trial import Trial

SIZE_BY_COUNT = 0.6
"""Exponent of the number of Gaussians to which the size of a container grows at equal lambda, with fewer by pruning."""


def search_without_photographs(containers: PathContainers, whole: RateControl) -> None:
    """Encode fewer Gaussians, trained or not, after ``whole``, the search for all of them, if they may serve better.

    Raises:
        StopSearch: the search was stopped.
    """
    goal = containers.goal
    if whole.stopped or (goal.by_size and whole.trials[0].bytes <= containers.target_size):
        return
    if containers.trains:
        _search_on_renderings(containers, whole)
    else:
        _search_without_training(containers, whole)


def _search_on_renderings(containers: PathContainers, whole: RateControl) -> None:
    """Train as many Gaussians as pruning alone nearly serves, or for a size that all of them miss, as many as fit.

    A scene whose Gaussians are all needed keeps them.
    """
    goal, pruning = containers.goal, containers.pruning
    best, trains = containers.candidates.best, bool(containers.plan.containers)
    if best is None and goal.by_size and containers.target_size > whole.overhead:
        if trains and not containers.late:
            containers.search_along_path(containers.number_for_size)
        else:
            point = pruning.prune_to(max(containers.number_for_size, 1))
            containers.encode(containers.path.compacted(point, refine=False))
    if best is None or whole.best is None or not trains or containers.late:
        return
    most = min(RENDERED_POINTS, containers.number_for_size if goal.by_size else RENDERED_POINTS)

    def serves(trial: Trial) -> bool:
        return (trial.drop or 0.0) <= best.cost if goal.by_size else goal.margin(trial) >= 0

    pruning.prune_while(lambda trial: serves(trial) and not containers.late, most)
    number, rd_lambda = pruning.last(serves), whole.best.encoded.rd_lambda
    if number and rd_lambda is not None and not containers.late:
        if goal.by_size:
            rd_lambda = _lambda_for_size(whole.trials, containers.target_size, number)
        containers.search_lambda(number, rd_lambda)


def _lambda_for_size(trials: Sequence[Trial], target_size: int, number: int) -> float:
    """Return the lambda at which a point should have the target size, by containers of all Gaussians."""
    wanted = target_size / KEEP ** (SIZE_BY_COUNT * number)
    made = sorted((trial.bytes, trial.rd_lambda) for trial in trials if trial.rd_lambda is not None)
    sizes, lambdas = np.log2([size for size, _ in made]), np.log2([rd_lambda for _, rd_lambda in made])
    return float(2.0 ** np.interp(math.log2(wanted), sizes, lambdas))


def _search_without_training(containers: PathContainers, whole: RateControl) -> None:
    """Encode those that leave half of the error to the encoder, or as many as fit the size."""
    goal, pruning, number = containers.goal, containers.pruning, 0
    if goal.by_size and containers.target_size > whole.overhead:
        pruning.prune_while(is_prunable, containers.count)
        if whole.best is None or containers.number_for_size > len(pruning.losses):
            containers.encode_by_size()
        else:
            psnr = psnr_of(whole.evaluate(whole.best.encoded)) + HALF_ERROR_DB
            number = pruning.last(lambda trial: (trial.psnr or 0.0) >= psnr)
    elif not goal.by_size and whole.best is not None:
        pruning.prune_while(lambda trial: goal.leaves_half(trial) and is_prunable(trial), containers.count)
        number = pruning.last(goal.leaves_half)
    if number:
        containers.encode(containers.path.compacted(containers.path.points[number], refine=False))
