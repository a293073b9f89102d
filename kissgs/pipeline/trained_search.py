"""Search for the number of Gaussians and the lambda of a trained scene: few containers, each with a training."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

from kissgs.pipeline.goal import HALF_ERROR_DB, Goal
from kissgs.pipeline.rate_control import LOG2_LAMBDA_RANGE, RateControl
from kissgs.pipeline.search_time import SearchPlan

DOUBLINGS_PER_HALVING = 2.5
"""Doublings of lambda that typically change size and quality as much as half as many Gaussians."""

LAMBDA_SHARE = 0.4
"""Share of a step that lambda takes; the number of Gaussians takes the rest.

The more may be lost, the fewer Gaussians and the coarser levels the smallest container has (section
"Compaction" of docs/method/research-log.md).
"""

MAX_STEP = 2.0
"""Largest step of the search, in halvings."""

MAX_FIRST_STEP = 2.0
"""Largest step, in halvings, from the first container of the plan to that for the goal."""

SMALL_SCENE = 10_000
"""Number of Gaussians below which there is no such step: with some tens left of them, lambda at equal quality falls."""

NEAR_HALVINGS, NEAR_IN_TIME = 0.1, 0.03
"""Step below which a container that meets the goal ends the search: another one would save some 4 % of its bytes, or
1 %, which is worth a time that the user has given."""

CAUTION_SHARE, CAUTION_HALVINGS = 0.15, 0.1
"""Caution of the last attempt: share of the distance to the nearest container that met the goal, since missing it would
lose that much, and largest caution."""

MIN_STEP = 0.03
"""Smallest step, in halvings, whose effect is measured: that of a smaller one is lost in the noise of training."""

MAX_SLOPE_RATIO = 4.0
"""Inverse of the smallest ratio of the measured effect of a halving to the typical one."""


@dataclass(frozen=True, slots=True)
class Position:
    """A number of Gaussians and a lambda.

    Attributes:
        number: number of the point on the path of falling numbers of Gaussians.
        log2_lambda: log2 of lambda; None for that of the settings.
    """

    number: int
    log2_lambda: float | None


def search_positions(
    goal: Goal,
    encode: Callable[[Position], RateControl],
    first: int,
    bounds: tuple[int, int],
    points_per_halving: float,
    attempts: int,
    near: float = NEAR_HALVINGS,
) -> None:
    """Make containers at positions that come closer to the goal.

    Fewer Gaussians and a larger lambda both lower size and quality. Each step changes both: the number of Gaussians by
    whole points, lambda by :data:`LAMBDA_SHARE` and by what the whole points leave.

    Args:
        goal: the goal; no PSNR.
        encode: makes the container of a position and returns the search that has it as its last trial.
        first: number of the first point.
        bounds: smallest and largest number of a point.
        points_per_halving: points of the path by which the number of Gaussians is halved.
        attempts: largest number of containers.
        near: step, in halvings, below which a container that meets the goal ends the search.
    """
    position = Position(min(max(first, bounds[0]), bounds[1]), None)
    left_at, figures, met_from = dict[float, float](), set[tuple[int, float]](), list[float]()
    for remaining in reversed(range(attempts)):
        search = encode(position)
        trial = search.trials[-1]
        left, met = min(limit.halvings(trial) for limit in goal.limits), goal.margin(trial) >= 0
        if remaining == 0 or search.stopped or trial.rd_lambda is None or not math.isfinite(left):
            return
        may_shrink = left > NEAR_IN_TIME and trial.bytes > (goal.most_bytes or math.inf)
        if (met and abs(left) <= near and not may_shrink) or (trial.bytes, left) in figures:  # near, or without effect
            return
        figures.add((trial.bytes, left))
        if met:
            met_from.append(abs(left))
        log2_lambda = math.log2(trial.rd_lambda)
        halvings = position.number / points_per_halving + log2_lambda / DOUBLINGS_PER_HALVING
        left_at[halvings] = left
        step = _next_place(left_at, halvings) - halvings
        if remaining == 1:
            step += _caution(min(met_from, default=math.inf), by_size=goal.by_size)
        number = min(max(position.number + _points(step, points_per_halving), bounds[0]), bounds[1])
        rest = step - (number - position.number) / points_per_halving
        if remaining == 1 and not met_from:  # lambda must not take back what the number gives
            rest = max(rest, 0.0) if goal.by_size else min(rest, 0.0)
        log2_lambda += DOUBLINGS_PER_HALVING * rest
        position = Position(number, min(max(log2_lambda, LOG2_LAMBDA_RANGE[0]), LOG2_LAMBDA_RANGE[1]))


def first_position(
    goal: Goal, plan: SearchPlan, count: int, number_for_size: int, points_per_halving: float
) -> tuple[int, float]:
    """Return the point of the first container, and the decibels added to ``quality_offset_db`` there.

    The plan states both for a loss of 0.1 dB. A goal that allows more gets fewer Gaussians, unless the scene is small,
    or there is one container only: no second one could correct a miss. With fewer Gaussians, lambda at equal quality is
    larger by about :data:`LAMBDA_SHARE` of the step already, so the decibels only make up for the rounding to whole
    points.

    Args:
        goal: the goal; no PSNR.
        plan: containers and training of the search.
        count: number of Gaussians of the scene.
        number_for_size: point that suits a goal that is a size.
        points_per_halving: points of the path by which the number of Gaussians is halved.
    """
    if goal.by_size:
        return number_for_size, plan.offset_db
    step = min(goal.allowed_halvings, MAX_FIRST_STEP if plan.containers > 1 and count >= SMALL_SCENE else 0.0)
    points = _points(step, points_per_halving)
    rest = (1 - LAMBDA_SHARE) * step - points / points_per_halving
    return plan.number + points, plan.offset_db - HALF_ERROR_DB * DOUBLINGS_PER_HALVING * rest


def _points(step: float, points_per_halving: float) -> int:
    """Return by how many points of the path a step changes the number of Gaussians; lambda takes the rest."""
    return round((1 - LAMBDA_SHARE) * step * points_per_halving)


def _caution(distance: float, *, by_size: bool) -> float:
    """Return the halvings that are added to the last step, so that its container meets the goal in spite of chance.

    Args:
        distance: halvings from the goal to the nearest container that meets it; infinite if none does.
        by_size: whether the goal is a size.
    """
    caution = min(CAUTION_HALVINGS, CAUTION_SHARE * distance)
    return caution if by_size else -caution


def _next_place(left_at: dict[float, float], last: float) -> float:
    """Return the place, in halvings by the number of Gaussians and by lambda, where the goal should just be met.

    A step of the typical effect or of the one between the last two places, kept between places on both sides.

    Args:
        left_at: by place, the halvings that are left until the goal, below 0 beyond it.
        last: the latest place.
    """
    effect, others = 1.0, [place for place in left_at if abs(place - last) > MIN_STEP]
    if others:
        measured = (left_at[others[-1]] - left_at[last]) / (last - others[-1])
        effect = max(measured, 1 / MAX_SLOPE_RATIO)
    place = last + min(max(left_at[last] / effect, -MAX_STEP), MAX_STEP)
    below = max((x for x, left in left_at.items() if left >= 0), default=-math.inf)
    above = min((x for x, left in left_at.items() if left < 0), default=math.inf)
    margin = 0.1 * (above - below)
    return min(max(place, below + margin), above - margin) if 0 < margin < math.inf else place
