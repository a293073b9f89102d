"""Curves through the plane of number of Gaussians and lambda, along which a search finds the root of a goal's margin.
One curve changes lambda alone, the other removes Gaussians and raises lambda together."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field, replace

from kissgs.core.root_finding import StopRule, find_root
from kissgs.pipeline.goal import Attempt, Goal
from kissgs.settings import GOALS, EncodeSettings

LOG2_LAMBDA_RANGE = (-70.0, -6.0)
"""log2 of the smallest and the largest lambda that is tried: the finest and the coarsest container."""

MIN_STEP_LOG2, JUMP_LOG2 = 1 / 32, 0.5
"""Interval of log2(lambda) below which a jump of the size is not searched further, and below which one between two
sides of the codebook is left at the smaller side."""

FAR_BELOW_LOG2 = 1.5
"""Room of the first container for a size, from which the finest container, with the largest codebook, is tried next.

The finest container takes longest to make, and rarely has more than three times the bytes of the first.
"""


class NoFurtherError(Exception):
    """Raised where no other container of a scene can be better, or there is no time for one."""


def at_lambda(settings: EncodeSettings, log2_lambda: float) -> EncodeSettings:
    """Return settings without goals, for a container at this lambda."""
    return settings.model_copy(update={**dict.fromkeys(GOALS), "rd_lambda": 2.0**log2_lambda})


@dataclass(slots=True, eq=False)
class LambdaCurve:
    """Containers of one scene with several values of lambda. The side of the codebook is a multiple of 8, so a goal may
    lie between the containers of two sides, where lambda alone does not meet it."""

    goal: Goal
    encode: Callable[[EncodeSettings], Attempt]
    settings: EncodeSettings  # of the containers, but for lambda
    most: int  # containers
    # Fine-tuned: then a container less near the goal ends the search, the finest or coarsest one is not tried where all
    # others missed the goal, and the codebook stays.
    tuned: bool = False
    found: dict[float, Attempt] = field(default_factory=dict)  # by log2(lambda), those that can be compared
    _made: int = field(init=False, default=0)
    _slope: float = field(init=False, default=0.0)

    def search(self, rd_lambda: float | None = None) -> None:
        """Make containers, the first one at ``rd_lambda`` or as the settings say, until one meets the goal closely."""
        first = self._encode(self.settings if rd_lambda is None else at_lambda(self.settings, math.log2(rd_lambda)))
        if first.rd_lambda is None:  # no Gaussian is visible
            return
        start, sized = math.log2(first.rd_lambda), self.goal.by_size and not self.tuned
        self.found[start], self._slope = first, self.goal.decisive(first).slope
        far_below = sized and self.goal.margin(first) >= FAR_BELOW_LOG2 and self._made < self.most
        if far_below and self._margin(LOG2_LAMBDA_RANGE[0]) >= 0:
            return
        self._find_root(start)
        inside, outside = self._around_a_jump() if sized else (0.0, 0.0)
        if inside != outside:
            side = min(self.found[x].made.encoded.codebook_side for x in (inside, outside))
            self.settings = self.settings.model_copy(update={"sh_codebook_size": side**2})
            self.found = {x: each for x, each in self.found.items() if each.made.encoded.codebook_side <= side}
            self._find_root(min(inside, outside))

    def _find_root(self, start: float) -> None:
        if self._made >= self.most and start not in self.found:
            return

        def near(x: float) -> float:
            return self.goal.decisive(self.found[x]).near_enough(trained=self.tuned)

        left = self.most - self._made + (start in self.found)
        stop = StopRule(left, tries_bound=not self.tuned, settled=self._settled)
        before = {x: self.goal.margin(attempt) for x, attempt in self.found.items() if x != start}
        find_root(self._margin, start, self._slope, near, LOG2_LAMBDA_RANGE, stop=stop, before=before)

    def _encode(self, settings: EncodeSettings) -> Attempt:
        self._made += 1
        return self.encode(settings)

    def _margin(self, x: float) -> float:
        if x not in self.found:
            self.found[x] = self._encode(at_lambda(self.settings, x))
        return self.goal.margin(self.found[x])

    def _settled(self, inside: float, outside: float) -> bool:
        """Whether the size jumps between two values of log2(lambda), the last that fits and the next that does not.
        Only for sizes: for a PSNR or a drop, the codebook that belongs to the finer lambda is the better one."""
        sides = {self.found[x].made.encoded.codebook_side for x in (inside, outside)}
        gap = abs(inside - outside)
        return self.goal.by_size and (gap < MIN_STEP_LOG2 or (gap < JUMP_LOG2 and len(sides) > 1 and not self.tuned))

    def _around_a_jump(self) -> tuple[float, float]:
        """Return the values of log2(lambda) around a jump that the codebook causes; equal ones if there is none."""
        fits = [x for x, attempt in self.found.items() if self.goal.margin(attempt) >= 0]
        inside = min(fits, default=0.0)
        beyond = [x for x in self.found if x < inside] if fits else []
        outside = max(beyond, default=inside)
        near = not fits or self.goal.margin(self.found[inside]) <= self.goal.limits[0].near
        return (inside, inside) if near or not self._settled(inside, outside) else (inside, outside)


KEEP = 0.8
"""Share of the Gaussians that each point of the training path keeps of the point before."""

POINTS_PER_HALVING = math.log(0.5) / math.log(KEEP)
"""Points of the path by which the number of Gaussians is halved."""

DOUBLINGS_PER_HALVING = 2.5
"""Doublings of lambda that typically change size and quality as much as half as many Gaussians."""

LAMBDA_SHARE = 0.4
"""Share of a step that lambda takes; the number of Gaussians takes the rest. The more may be lost, the fewer Gaussians
and the coarser levels the smallest container has (docs/method/research-log.md, "Compaction")."""

HALF_ERROR_DB = 10 * math.log10(2)
"""Increase of PSNR, decibels, by half of the squared error, which is that by half of lambda."""

FLATTEST_LOSS = 0.4
"""Share of the expected slope of a loss that is believed at least: coarser levels lose little at first, then much."""

MAX_STEP, CAUTION = 2.0, (0.15, 0.1)
"""Largest step, as log2 of the number of Gaussians. Share of the distance to a container that met the goal by which the
last one stays nearer to it, and the largest such distance; share of the last step by which it is longer where none met
the goal. Missing it would lose all of the training."""

SMALL_SCENE = 10_000
"""Number of Gaussians below which a search begins as for a loss of 0.1 dB, whatever the goal allows."""


def count_at(number: int, count: int) -> int:
    """Return the number of Gaussians at a point of the path of a scene with ``count``, at least 1."""
    return max(1, round(count * KEEP**number))


def last_number(count: int) -> int:
    """Return the number of the last point of the path of a scene with ``count`` Gaussians, at least 1."""
    return max(1, math.floor(math.log(1 / count) / math.log(KEEP)))


def first_point(goal: Goal, number: int, offset_db: float, *, may_step: bool) -> tuple[int, float]:
    """Return the point of the first container, and the decibels added to ``quality_offset_db`` there. ``number`` and
    ``offset_db`` are those for a loss of 0.1 dB. A goal that allows more gets fewer Gaussians if it ``may_step``. With
    fewer Gaussians, lambda at equal quality is larger by about :data:`LAMBDA_SHARE` of the step already, so the
    decibels only make up for the rounding to whole points."""
    step = min(goal.allowed_log2, MAX_STEP if may_step else 0.0)
    points = round((1 - LAMBDA_SHARE) * step * POINTS_PER_HALVING)
    rest = (1 - LAMBDA_SHARE) * step - points / POINTS_PER_HALVING
    return number + points, offset_db - HALF_ERROR_DB * DOUBLINGS_PER_HALVING * rest


def along_path(
    goal: Goal, encode: Callable[[int, float | None], Attempt], first: int, last: int, most: int, near: float
) -> None:
    """Make up to ``most`` containers at points of the path up to ``last``, the first one at point ``first`` as its
    settings say, for a goal that is no PSNR; ``encode`` makes that of a point at a value of log2(lambda). A margin
    below ``near``, log2 of the number of Gaussians, ends the search."""
    first, begin = min(max(first, 1), last), math.nan

    def margin(step: float) -> float:
        nonlocal begin
        if step == 0:
            attempt = encode(first, None)
            begin = math.nan if attempt.rd_lambda is None else math.log2(attempt.rd_lambda)
        else:
            # Less than a point changes lambda alone: another training changes the loss by some chance.
            points = (1 - LAMBDA_SHARE) * step * POINTS_PER_HALVING
            number = min(max(first + round(points) * (abs(points) >= 1), 1), last)
            rest = step - (number - first) / POINTS_PER_HALVING
            x = begin + DOUBLINGS_PER_HALVING * rest
            attempt = encode(number, min(max(x, LOG2_LAMBDA_RANGE[0]), LOG2_LAMBDA_RANGE[1]))
        margin = goal.log2_margin(attempt)
        if not math.isfinite(begin + margin):
            raise NoFurtherError
        return margin

    stop = StopRule(most, tries_bound=False, most_step=MAX_STEP, caution=CAUTION)
    stop = stop if goal.by_size else replace(stop, flattest=FLATTEST_LOSS)
    find_root(margin, 0.0, 1.0 if goal.by_size else -1.0, near, (-math.inf, math.inf), stop=stop)
