"""Finds what meets a goal in few attempts, where an attempt is dear and only its outcome tells how near it came."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping

ATTEMPTS = 10
FINEST = 0.2
"""Of :func:`minimize_unimodal`: steps are halved no further."""

REACH = 4.0
"""How far from all that is known an attempt may be, octaves; but for the last one, at a bound."""

LAME = 0.15
"""Of what the slope promises: where no more comes over half of :data:`REACH`, only the bound can tell more."""


def find_root(
    spare: Callable[[float], float],
    start: float,
    slope: float,
    tolerance: float,
    bounds: tuple[float, float],
    grain: float = 0.0,
    attempts: int = ATTEMPTS,
    settled: Callable[[float, float], bool] = lambda inside, outside: False,
    before: Mapping[float, float] | None = None,
) -> float | None:
    """Where a monotone function is hardly above zero.

    False position between attempts that met the goal and ones that did not; before there are both, Newton's steps of at
    most :data:`REACH`, and the bound once these lead nowhere: no goal is given up that is met there.

    Args:
        spare: at least 0 where the goal is met, infinite where it cannot be told by how much; only about monotone and
            smooth, as results of rounding are.
        start: first attempt.
        slope: of ``spare``, about; its sign must be right.
        tolerance: at most so much above 0 is near enough.
        bounds: attempts stay between these.
        grain: attempts are whole multiples of this; 0 for any number.
        attempts: how many at most; where several did not meet the goal, one at the bound on top.
        settled: whether an attempt that met the goal, and the next that did not, leave nothing to find between them.
        before: what is known already; its attempts are not among those that count, nor among those to return.

    Returns:
        The best attempt that met the goal; None if none did.
    """
    known = dict(before or {})
    attempts += len(known)
    x = _whole(start, grain)
    while len(known) < attempts and x not in known:
        known[x] = spare(x)
        inside, outside = _bracket(known, slope)
        if 0 <= known[x] <= tolerance or (inside is not None and outside is not None and settled(inside, outside)):
            break
        if (inside is None or outside is None) and _stuck(known, slope):
            x = bounds[(inside is None) == (slope > 0)]
        else:
            x = min(max(_whole(_next(known, slope, tolerance / 2), grain), bounds[0]), bounds[1])
    bound = bounds[slope > 0]
    if len(known) > 1 and bound not in known and all(found < 0 for found in known.values()):
        known[bound] = spare(bound)
    met = [x for x, found in known.items() if found >= 0 and x not in (before or {})]
    return min(met, key=lambda x: known[x]) if met else None


def minimize_unimodal(
    cost: Callable[[float], float],
    known: dict[float, float],
    start: float,
    step: float,
    bounds: tuple[float, float],
    way_out: float,
    attempts: int,
) -> None:
    """Look for where a function with one valley is lowest, in few attempts: downhill, and then in half as long steps.

    Args:
        cost: infinite where something is not possible at all.
        known: what is known of it; every attempt is added.
        start: first attempt.
        step: to the next; the first goes down from there.
        bounds: attempts stay between these.
        way_out: where something is not possible, it may be further up (1) or further down (-1).
        attempts: how many at most.
    """
    x: float | None = min(max(start, bounds[0]), bounds[1])
    for _ in range(attempts):
        if x is None:
            break
        known[x] = cost(x)
        x, step = _beside(known, step, bounds, way_out)


def _beside(
    known: dict[float, float], step: float, bounds: tuple[float, float], way_out: float
) -> tuple[float | None, float]:
    """Where to look next to the best that is known, and how far that is; None where all that is near is known."""
    best = min(known, key=lambda x: (known[x], -way_out * x))
    ways = (way_out,) if math.isinf(known[best]) else (-1.0, 1.0)
    while step >= FINEST:
        for way in ways:
            x = min(max(best + way * step, bounds[0]), bounds[1])
            if min(abs(x - other) for other in known) > step / 2:
                return x, step
        step /= 2
    return None, step


def _whole(x: float, grain: float) -> float:
    return round(x / grain) * grain if grain else x


def _next(known: dict[float, float], slope: float, aim: float) -> float:
    inside, outside = _bracket(known, slope)
    if inside is not None and outside is not None:
        latest = [found >= 0 for found in known.values()][-3:]
        if math.isinf(known[inside]) or latest in ([True] * 3, [False] * 3):  # it creeps: one end does not move
            return (inside + outside) / 2
        share = (known[inside] - aim) / (known[inside] - known[outside])
        return inside + (outside - inside) * min(max(share, 0.1), 0.9)
    *before, last = known
    if before and math.isfinite(known[last]) and math.isfinite(known[before[-1]]):
        measured = (known[last] - known[before[-1]]) / (last - before[-1])
        slope *= min(max(measured / slope, 0.1), 10.0)
    start = last if inside is None else inside
    return start + min(max((aim - known[start]) / slope, -REACH), REACH)


def _bracket(known: Mapping[float, float], slope: float) -> tuple[float | None, float | None]:
    """The last place where the goal is met, and the first beyond it where it is not."""
    inside = max((x for x, found in known.items() if found >= 0), key=lambda x: -slope * x, default=None)
    beyond = [x for x, found in known.items() if found < 0 and (inside is None or slope * (x - inside) < 0)]
    return inside, min(beyond, key=lambda x: -slope * x, default=None)


def _stuck(known: Mapping[float, float], slope: float) -> bool:
    """Whether a long way to the last attempt was for hardly anything."""
    *before, last = known
    return any(
        abs(last - x) > REACH / 2 and abs(known[last] - known[x]) < LAME * abs(slope * (last - x))
        for x in before  # of two infinite ones nothing is known
    )
