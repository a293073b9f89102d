"""Root finding in few evaluations, for expensive functions without derivatives."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass

ATTEMPTS = 10  # default number of evaluations
MAX_EXTRAPOLATION = 4.0  # largest distance of an evaluation from known points, except for one at a bound
MIN_SLOPE_SHARE = 0.15  # of the expected slope; below, over half of MAX_EXTRAPOLATION, the bound is next


@dataclass(frozen=True, slots=True)
class StopRule:
    """How far :func:`find_root` goes, and when it ends without a margin within the tolerance."""

    attempts: int = ATTEMPTS  # largest number of evaluations
    tries_bound: bool = True  # where long steps make no progress, and if no point met the goal
    # Whether the search between a point that meets the goal and the next one that does not can end.
    settled: Callable[[float, float], bool] = lambda inside, outside: False
    most_step: float = MAX_EXTRAPOLATION  # largest distance of an evaluation from known points, except for a bound
    flattest: float = 0.1  # share of the expected slope below which none is believed: a loss grows ever faster
    # Share of the distance to the nearest point that meets the goal by which the last point is nearer, and the largest
    # such step; share by which the last step is longer where no point meets the goal.
    caution: tuple[float, float] = (0.0, 0.0)


def find_root(
    margin: Callable[[float], float],
    start: float,
    slope: float,
    tolerance: float | Callable[[float], float],
    bounds: tuple[float, float],
    grain: float = 0.0,
    stop: StopRule = StopRule(),
    before: Mapping[float, float] | None = None,
) -> float | None:
    """Find where a monotone function is slightly above zero.

    False position between points that meet the goal and points that do not; before both exist, Newton steps of at most
    ``most_step``, and the bound once these make no progress, so that a goal that is met at the bound is found. Returned
    is the point of smallest margin that meets the goal; None if none does.

    ``margin`` is at least 0 where the goal is met, infinite where the distance to it is unknown, and may be slightly
    non-monotone, as results of rounding are; ``slope`` is its approximate slope, whose sign must be right. A margin
    from 0 to ``tolerance`` ends the search. Points are whole multiples of ``grain``, if that is not 0. Those of
    ``before`` are known, and neither count nor are returned.
    """
    known = dict(before or {})
    attempts = stop.attempts + len(known)
    tolerance_at = tolerance if callable(tolerance) else lambda x: tolerance
    x = _rounded(start, grain)
    while len(known) < attempts and x not in known:
        known[x] = margin(x)
        inside, outside = _bracket(known, slope)
        settled = inside is not None and outside is not None and stop.settled(inside, outside)
        if 0 <= known[x] <= tolerance_at(x) or settled:
            break
        if stop.tries_bound and (inside is None or outside is None) and _no_progress(known, slope):
            x = bounds[(inside is None) == (slope > 0)]
        else:
            x = _next(known, slope, tolerance_at(x) / 2, stop)
            if len(known) == attempts - 1:
                share, most = stop.caution
                x += share * (x - list(known)[-1]) if inside is None else min(max(share * (inside - x), -most), most)
            x = min(max(_rounded(x, grain), bounds[0]), bounds[1])
    bound = bounds[slope > 0]
    if stop.tries_bound and len(known) > 1 and bound not in known and all(found < 0 for found in known.values()):
        known[bound] = margin(bound)
    met = [x for x, found in known.items() if found >= 0 and x not in (before or {})]
    return min(met, key=lambda x: known[x]) if met else None


def _rounded(x: float, grain: float) -> float:
    return round(x / grain) * grain if grain else x


def _next(known: dict[float, float], slope: float, aim: float, stop: StopRule) -> float:
    inside, outside = _bracket(known, slope)
    if inside is not None and outside is not None:
        latest = [found >= 0 for found in known.values()][-3:]
        if math.isinf(known[inside]) or latest in ([True] * 3, [False] * 3):  # slow convergence: one end does not move
            return (inside + outside) / 2
        share = (known[inside] - aim) / (known[inside] - known[outside])
        return inside + (outside - inside) * min(max(share, 0.1), 0.9)
    *before, last = known
    if before and math.isfinite(known[last]) and math.isfinite(known[before[-1]]):
        measured = (known[last] - known[before[-1]]) / (last - before[-1])
        slope *= min(max(measured / slope, stop.flattest), 10.0)
    start = last if inside is None else inside
    return start + min(max((aim - known[start]) / slope, -stop.most_step), stop.most_step)


def _bracket(known: Mapping[float, float], slope: float) -> tuple[float | None, float | None]:
    """Return the last point that meets the goal, and the first one beyond it that does not."""
    inside = max((x for x, found in known.items() if found >= 0), key=lambda x: -slope * x, default=None)
    beyond = [x for x, found in known.items() if found < 0 and (inside is None or slope * (x - inside) < 0)]
    return inside, min(beyond, key=lambda x: -slope * x, default=None)


def _no_progress(known: Mapping[float, float], slope: float) -> bool:
    """Whether a long step to the last point changed the margin by much less than the slope predicts."""
    *before, last = known
    return any(
        abs(last - x) > MAX_EXTRAPOLATION / 2
        and abs(known[last] - known[x]) < MIN_SLOPE_SHARE * abs(slope * (last - x))
        for x in before  # false for two infinite margins, whose difference is NaN
    )
