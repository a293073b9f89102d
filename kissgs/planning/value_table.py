"""Tables of at most 256 values that all channels of an attribute share, and the nearest levels."""

from __future__ import annotations

import heapq

import numpy as np

from kissgs.core.array_types import Float, Float32, Float64, Integer, UInt8
from kissgs.planning.quantize import Quantized

SIZE = 256
"""Largest number of values of a table."""

WIDEST = 120
"""Joined points span at most this fraction of the whole range, which bounds the error where weights are small."""

DIGITS = 6
"""Significant digits of the values of a table, which its container stores as text."""

MAX_POINTS = 1 << 14
"""Largest number of lattice points before joining; the lattice is coarser for values that occupy more."""


def fit_table(
    values: Float[np.ndarray, " V"], weights: Float64[np.ndarray, " V"], step: float, *, with_zero: bool = False
) -> Float32[np.ndarray, " levels"]:
    """Return ascending values of a table for at least one value: the occupied points of a lattice of this ``step``.

    So outliers cost no step of the others. If more than 256 points are occupied, the neighbours whose union adds the
    least weighted squared error are joined.
    """
    wide = np.asarray(values, np.float64)
    span = float(np.ptp(wide))
    step = max(step, span * 2.0**-40, 1e-30)
    while True:
        points, index = np.unique(np.rint(wide / step), return_inverse=True)
        if len(points) <= MAX_POINTS:
            break
        step *= 2
    centers = points * step
    if len(points) > SIZE - with_zero:
        mass = np.bincount(index, np.maximum(weights, weights.mean() * 1e-3 + 1e-300), minlength=len(points))
        centers = _join(centers, mass, SIZE - with_zero, (centers[-1] - centers[0]) / WIDEST)
    if with_zero and not (centers == 0).any():
        centers = np.append(centers, 0.0)
    return np.unique(centers.astype(np.float32) + np.float32(0))


def _join(
    centers: Float64[np.ndarray, " points"], mass: Float64[np.ndarray, " points"], size: int, widest: float
) -> Float64[np.ndarray, " levels"]:
    """Join neighbours, the cheapest first, until ``size`` groups remain; return the weighted mean of each."""
    count = len(centers)
    mean, total = centers.copy(), mass.copy()
    first, last = centers.copy(), centers.copy()
    before, after = np.arange(count) - 1, np.arange(count) + 1
    version = np.zeros(count, np.int64)
    queue: list[tuple[float, int, int, int]] = []

    def offer(a: int, b: int) -> None:
        if last[b] - first[a] <= widest:
            cost = total[a] * total[b] / (total[a] + total[b]) * (mean[b] - mean[a]) ** 2
            heapq.heappush(queue, (float(cost), a, int(version[a]), int(version[b])))

    for a in range(count - 1):
        offer(a, a + 1)
    alive = count
    while alive > size and queue:
        _, a, made_a, made_b = heapq.heappop(queue)
        b = int(after[a])
        if version[a] != made_a or b >= count or version[b] != made_b:
            continue
        mean[a] = (mean[a] * total[a] + mean[b] * total[b]) / (total[a] + total[b])
        total[a] += total[b]
        last[a], after[a] = last[b], after[b]
        version[a] += 1
        version[b] = -1
        alive -= 1
        if after[a] < count:
            before[after[a]] = a
            offer(a, int(after[a]))
        if before[a] >= 0:
            offer(int(before[a]), a)
    return mean[version >= 0]


def nearest_levels(table: Float[np.ndarray, " levels"], values: Float[np.ndarray, "N C"]) -> UInt8[np.ndarray, "N C"]:
    """Return the index of the nearest value of the ascending ``table``."""
    wide = table.astype(np.float64)
    return np.asarray(np.searchsorted((wide[1:] + wide[:-1]) / 2, values, side="right").astype(np.uint8))


def table_field(table: Float32[np.ndarray, " levels"], levels: UInt8[np.ndarray, "N C"]) -> Quantized:
    """Return levels that stand for the values of a table, which are rounded to the digits that are stored."""
    return Quantized(levels, short_values(table).astype(np.float64)[:, None])


def short_values(table: Float32[np.ndarray, " levels"]) -> Float32[np.ndarray, " levels"]:
    """Return the values with the digits that are stored."""
    return np.array([float(f"{value:.{DIGITS}g}") for value in table.tolist()], np.float32)


def refit_table(
    table: Float32[np.ndarray, " levels"],
    levels: Integer[np.ndarray, "N C"],
    values: Float64[np.ndarray, "N C"],
    weights: Float64[np.ndarray, " N"],
    largest: tuple[Float64[np.ndarray, " N"], Float64[np.ndarray, " N"]],
) -> Float32[np.ndarray, " levels"]:
    """Move each value of a table to the weighted mean of what it stands for, within the largest changes down and up."""
    size, rows = len(table), np.broadcast_to(weights[:, None], levels.shape).ravel()
    index, flat = levels.ravel(), values.ravel()
    mass = np.bincount(index, rows, minlength=size)
    mean = np.bincount(index, rows * flat, minlength=size) / np.where(mass > 0, mass, 1)
    floor, ceiling = np.full(size, -np.inf), np.full(size, np.inf)
    np.maximum.at(floor, index, (values - largest[0][:, None]).ravel())
    np.minimum.at(ceiling, index, (values + largest[1][:, None]).ravel())
    moved = np.where((mass > 0) & (floor <= ceiling), np.clip(mean, floor, np.maximum(floor, ceiling)), table)
    moved = moved.astype(np.float32)
    return moved if (np.diff(moved) > 0).all() else table


def without_unused(
    table: Float32[np.ndarray, " levels"], levels: Integer[np.ndarray, "N C"]
) -> tuple[Float32[np.ndarray, " used"], UInt8[np.ndarray, "N C"]]:
    """Return the table without the values that no level uses, and the levels in it."""
    used, index = np.unique(levels, return_inverse=True)
    return table[used], index.reshape(levels.shape).astype(np.uint8)
