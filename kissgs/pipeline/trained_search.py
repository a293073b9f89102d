"""Search for the number of Gaussians and the lambda of a trained scene: few containers, each with a training."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING

from kissgs.core.splats import Splats
from kissgs.pipeline.encoding import FinetuneFactors
from kissgs.pipeline.goal import HALF_ERROR_DB, Goal
from kissgs.pipeline.rate_control import LOG2_LAMBDA_RANGE, Encoder, RateControl
from kissgs.pipeline.search_time import SearchPlan, SearchTime

if TYPE_CHECKING:
    from kissgs.compaction.budget import Compactor
    from kissgs.compaction.popspa import PathPoint, TrainingPath
    from kissgs.compaction.result import Compacted
    from kissgs.finetuning.tune import Tuner
    from kissgs.pipeline.encoding import Encoding


# Numbers of the points of a training path: how many Gaussians each has, and which one suits a size.

KEEP = 0.8
"""Share of the Gaussians that each point of the path keeps of the point before."""

POINTS_PER_HALVING = math.log(0.5) / math.log(KEEP)
"""Points of the path by which the number of Gaussians is halved."""

BYTES_PER_GAUSSIAN, BYTES_OF_SH = 8.6, 4.0
"""Bytes of a container per Gaussian that are expected at first, and those of view-dependent colour in addition."""

OVERHEAD_BYTES = 4000
"""Bytes of a container that are no images."""


def count_at(number: int, count: int) -> int:
    """Return the number of Gaussians at a point of the path of a scene with ``count``, at least 1."""
    return max(1, round(count * KEEP**number))


def last_number(count: int) -> int:
    """Return the number of the last point of the path of a scene with ``count`` Gaussians, at least 1."""
    return max(1, math.floor(math.log(1 / count) / math.log(KEEP)))


def number_for_size(splats: Splats, size: float) -> int:
    """Return the number of the point whose container is expected to have ``size`` bytes; 0: all Gaussians fit."""
    expected = (BYTES_PER_GAUSSIAN + BYTES_OF_SH * (splats.sh_degree > 0)) * len(splats)
    share = max((size - OVERHEAD_BYTES) / expected, 1 / len(splats))
    return max(0, round(math.log(share) / math.log(KEEP)))


# ``TrainedScenes``: points of a training path, ready to be encoded.

COMPLETING = FinetuneFactors(steps=1.2, lr=2.5, codebook_lr=2.0)
"""Fine-tuning that completes the training of the path too.

A refinement of the scene before its encoding would take more steps for the same quality.
"""


@dataclass(frozen=True, slots=True)
class TrainedScene:
    """A scene of the path, and what makes containers of it.

    Attributes:
        compacted: the scene.
        search: the search for its lambda.
        encoder: encodes it, with fine-tuning if that is wanted.
    """

    compacted: Compacted
    search: RateControl
    encoder: Encoder


@dataclass(slots=True, eq=False)
class TrainedScenes:
    """Trains a scene along its path, and prepares the encoding of the points that are asked for.

    Attributes:
        encoding: encoding of the whole scene.
        compactor: compactor of the same scene.
        path: training path of the compactor.
        pruned_only: number of the last point that is pruned without training along the path.
        offset_db: added to ``quality_offset_db`` for the first container of a scene, decibels.
        time: the time that training shares with encoding; None for no limit.
        containers: number of containers that are still to be made in that time, this one included.
    """

    encoding: Encoding
    compactor: Compactor
    path: TrainingPath
    pruned_only: int
    offset_db: float
    time: SearchTime | None
    containers: int
    _tuner: Tuner | None = field(init=False, default=None)
    _scenes: dict[int, TrainedScene] = field(init=False, default_factory=dict)

    def scene(self, number: int, byte_limit: float) -> TrainedScene:
        """Return the scene at a point of the path, trained and ready for the next container.

        ``byte_limit`` is that of :class:`RateControl`.
        """
        if number not in self._scenes:
            self._scenes[number] = self._prepare(number, byte_limit)
        if self.time is not None and self._tuner is not None:
            self._tuner.deadline = self.time.for_container(self.containers).earlier(self._evaluation_seconds)
        return self._scenes[number]

    def point(self, number: int) -> PathPoint:
        """Prune and train up to a point of the path, and return it."""
        path = self.path
        while len(path.points) <= number:
            trains = len(path.points) > self.pruned_only
            if trains and not path.points[-1].trained:
                self._train(number)
            path.prune(count_at(len(path.points), len(self.compactor.splats)))
            if trains:
                self._train(number)
        return path.points[number]

    def _train(self, number: int) -> None:
        """Train the last point of the path, on the way to point ``number``."""
        deadline = None
        if self.time is not None:
            deadline = self.time.for_point(number + 2 - len(self.path.points), self.containers)
        self.path.train(deadline)

    def _prepare(self, number: int, byte_limit: float) -> TrainedScene:
        tunes = bool(self.encoding.settings.finetune.enabled)
        point, deadline = self.point(number), None
        if self.time is not None:
            deadline = self.time.for_container(self.containers)
            deadline = deadline.earlier(self.time.encode_seconds + self._evaluation_seconds)
        compacted = self.path.compacted(point, refine=not tunes, deadline=deadline)
        encoding = replace(self.encoding, splats=compacted.splats, cache=None)
        if tunes:  # training replaces the refit of colours
            encoding = encoding.with_encode_settings(color_refit_iterations=0)
            self._tuner = self._tuner or self._first_tuner(encoding)
        search = encoding.rate_control(offset_db=self.offset_db, byte_limit=byte_limit, trained=tunes)
        return TrainedScene(compacted, search, encoding.encoder(self._tuner))

    @property
    def _evaluation_seconds(self) -> float:
        """Expected time to evaluate a container, seconds: that of the latest evaluation; 0 where sizes are searched."""
        return 0.0 if Goal.of(self.encoding.settings.encode).by_size else self.compactor.compare.seconds

    def _first_tuner(self, encoding: Encoding) -> Tuner | None:
        prepared = (self.compactor.supervision, self.path.targets) if self.compactor.settings.trains else None
        tuner = encoding.tuner(COMPLETING, prepared)
        if tuner is not None and self.time is not None:
            seconds = self.compactor.compare.seconds if self.compactor.supervision.captured else 0.0
            tuner.ending_seconds = self.time.ending_seconds + seconds  # it evaluates in the same images of a capture
        elif tuner is not None:
            tuner.deadline = None  # several containers cannot share the one of the whole work
        return tuner


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
