"""Numba kernels of fine-tuning: one pass over the levels in place of a dozen operations with arrays in float64."""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeVar

import numpy as np
from numba import njit

from kissgs.core.array_types import Float32, Float64, Int64
from kissgs.core.numba_kernels import compiled
from kissgs.core.resources import Workers

T = TypeVar("T")

PART = 1 << 16
"""Number of rows that a thread processes at a time; sums of parts are added in order."""


def each_part(work: Callable[[int, int], T], rows: int, threads: int) -> list[T]:
    """Call ``work`` with the first row of each part and the end of its rows; return the results in order."""
    with Workers(threads) as pool:
        return pool.map(lambda first: work(first, min(first + PART, rows)), range(0, rows, PART))


@compiled(
    "void(float64[:, ::1], float32[:, ::1], int64[:, ::1], int64[::1], float64[:, ::1], int64, int64, float64[:, ::1])"
)
def level_values(
    base: Float64[np.ndarray, "R C"],
    latents: Float32[np.ndarray, "R C"],
    start: Int64[np.ndarray, "R _"],
    lists: Int64[np.ndarray, " P"],
    table: Float64[np.ndarray, "L _"],
    first: int,
    last: int,
    values: Float64[np.ndarray, "R C"],  # written
) -> None:
    """Write the values of the levels of a plane, rows ``first`` to before ``last``."""
    for n in range(first, last):
        for c in range(base.shape[1]):
            at = start[n, c if start.shape[1] > 1 else 0] + np.int64(np.rint(base[n, c] + latents[n, c]))
            values[n, c] = table[lists[at], c if table.shape[1] > 1 else 0]


@njit(nogil=True, error_model="numpy", inline="always")
def _unit(place: float, start: int, lists: np.ndarray, table: np.ndarray, column: int) -> float:
    """Return the change of a value per unit of its latent, see :meth:`kissgs.finetuning.planes.Plane.units`."""
    near = np.rint(place)
    at = start + np.int64(near)
    here = table[lists[at], column]
    below, above = here - table[lists[at - 1], column], table[lists[at + 1], column] - here
    down, up = below if below > 0 else above, above if above > 0 else below  # outside of either end
    return down if place < near else up if place > near else (down + up) / 2


@compiled(
    "void(float64[:, ::1], float32[:, ::1], int64[:, ::1], int64[::1], float64[:, ::1], float64[:, ::1], int64, int64,"
    " float32[:, ::1])"
)
def level_gradients(
    base: Float64[np.ndarray, "R C"],
    latents: Float32[np.ndarray, "R C"],
    start: Int64[np.ndarray, "R _"],
    lists: Int64[np.ndarray, " P"],
    table: Float64[np.ndarray, "L _"],
    gradient: Float64[np.ndarray, "R C"],  # by the values
    first: int,
    last: int,
    v_latents: Float32[np.ndarray, "R C"],  # written
) -> None:
    """Write the gradients by the latents of rows ``first`` to before ``last``."""
    for n in range(first, last):
        for c in range(base.shape[1]):
            own, column = start[n, c if start.shape[1] > 1 else 0], c if table.shape[1] > 1 else 0
            v_latents[n, c] = gradient[n, c] * _unit(base[n, c] + latents[n, c], own, lists, table, column)


@compiled(
    "void(float64[:, ::1], float32[:, ::1], int64[:, ::1], int64[::1], float64[:, ::1], float64[:, ::1], float64,"
    " int64, int64, float32[:, ::1])"
)
def attract(
    base: Float64[np.ndarray, "R C"],
    latents: Float32[np.ndarray, "R C"],
    start: Int64[np.ndarray, "R _"],
    lists: Int64[np.ndarray, " P"],
    table: Float64[np.ndarray, "L _"],
    weights: Float64[np.ndarray, "R 1"],  # curvature of the loss by the values
    factor: float,
    first: int,
    last: int,
    gradient: Float32[np.ndarray, "R C"],  # changed
) -> None:
    """Add the gradient of the quadratic attraction of latents to their levels, rows ``first`` to before ``last``."""
    for n in range(first, last):
        for c in range(base.shape[1]):
            own, column = start[n, c if start.shape[1] > 1 else 0], c if table.shape[1] > 1 else 0
            unit = _unit(base[n, c] + latents[n, c], own, lists, table, column)
            level = np.float32(np.rint(base[n, c] + latents[n, c]) - base[n, c])
            gradient[n, c] += np.float32(factor * weights[n, 0] * unit * unit) * (latents[n, c] - level)


@compiled(
    "float64(float64[:, ::1], float32[:, ::1], int64[:, ::1], float32[::1], int64, int64, int64, float32[:, ::1])"
)
def level_bits(
    base: Float64[np.ndarray, "R C"],  # symbol of each level of the plan
    latents: Float32[np.ndarray, "R C"],
    rows: Int64[np.ndarray, "R C"],  # index of each level's code in ``table``
    table: Float32[np.ndarray, " _"],  # bits of the symbols of all codes; between two symbols they are interpolated
    symbols: int,  # number of symbols of a code; ``symbols + 1`` entries of ``table`` belong to it
    first: int,
    last: int,  # exclusive
    slopes: Float32[np.ndarray, "R C"],  # written: gradient by the latents
) -> float:
    """Return the bits of the levels of rows ``first`` to ``last`` (exclusive)."""
    total = 0.0
    for n in range(first, last):
        for c in range(base.shape[1]):
            position = base[n, c] + latents[n, c]
            below = min(max(np.floor(position), 0.0), symbols - 1.0)
            index = rows[n, c] + np.int64(below)
            slopes[n, c] = table[index + 1] - table[index]
            total += table[index] + np.float32(position - below) * slopes[n, c]
    return total


@compiled("void(float32[:, ::1], int64[::1], int64[::1], int64[::1], int64, int64, float32[:, ::1])")
def sum_by_label(
    rows: Float32[np.ndarray, "M C"],
    order: Int64[np.ndarray, " M"],  # rows sorted by label
    used: Int64[np.ndarray, " U"],  # labels that occur
    starts: Int64[np.ndarray, " U+1"],  # start of each of these in ``order``, and the end
    first: int,
    last: int,  # exclusive
    totals: Float32[np.ndarray, "E C"],  # sums; rows are added
) -> None:
    """Add up the rows of each label, of the labels ``used[first:last]``."""
    for u in range(first, last):
        for i in range(starts[u], starts[u + 1]):
            for c in range(rows.shape[1]):
                totals[used[u], c] += rows[order[i], c]
