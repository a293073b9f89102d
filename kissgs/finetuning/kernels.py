"""Numba kernels of fine-tuning: one pass over the levels in place of a dozen operations with arrays in float64.

Values and gradients are those of :class:`kissgs.finetuning.planes.EvenPlane` and
:class:`kissgs.finetuning.losses.RateLoss`.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeVar

import numpy as np

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
    "void(float64[:, ::1], float32[:, ::1], float64[:, ::1], float64[:, ::1], float64[::1], float64[::1], int64, int64,"
    " float64[:, ::1])"
)
def even_values(
    base: np.ndarray,
    latents: np.ndarray,
    stride: np.ndarray,
    shift: np.ndarray,
    low: np.ndarray,
    step: np.ndarray,
    first: int,
    last: int,
    values: np.ndarray,
) -> None:
    """Write the decoded values of rows ``first`` to ``last`` (exclusive).

    Args:
        base, stride, shift, low, step: attributes of an :class:`kissgs.finetuning.planes.EvenPlane`.
        latents: ``(R, C)``.
        first: first row.
        last: end of the rows, exclusive.
        values: out, ``(R, C)``.
    """
    per_channel = stride.shape[1] > 1
    for n in range(first, last):
        for c in range(base.shape[1]):
            level = np.rint(base[n, c] + latents[n, c]) * stride[n, c if per_channel else 0] + shift[n, c]
            values[n, c] = low[c] + step[c] * level


@compiled("void(float64[:, ::1], float64[:, ::1], float64[::1], int64, int64, float32[:, ::1])")
def even_values_backward(
    gradient: np.ndarray, stride: np.ndarray, step: np.ndarray, first: int, last: int, v_latents: np.ndarray
) -> None:
    """Write the gradients by the latents of rows ``first`` to ``last`` (exclusive), given those by the values."""
    per_channel = stride.shape[1] > 1
    for n in range(first, last):
        for c in range(gradient.shape[1]):
            v_latents[n, c] = gradient[n, c] * step[c] * stride[n, c if per_channel else 0]


@compiled(
    "void(float64[:, ::1], float32[:, ::1], float64[:, ::1], float64[::1], float64[:, ::1], float64, int64, int64,"
    " float32[:, ::1])"
)
def attract(
    base: np.ndarray,
    latents: np.ndarray,
    stride: np.ndarray,
    step: np.ndarray,
    weights: np.ndarray,
    factor: float,
    first: int,
    last: int,
    gradient: np.ndarray,
) -> None:
    """Add the gradient of the quadratic attraction of each latent to its level, rows ``first`` to ``last`` (exclusive).

    Args:
        base, stride, step: attributes of an :class:`kissgs.finetuning.planes.EvenPlane`.
        latents: ``(R, C)``.
        weights: ``(R, 1)`` curvature of the loss by the values.
        factor: factor of the attraction.
        first: first row.
        last: end of the rows, exclusive.
        gradient: ``(R, C)`` gradient by the latents; changed.
    """
    per_channel = stride.shape[1] > 1
    for n in range(first, last):
        for c in range(base.shape[1]):
            unit = step[c] * stride[n, c if per_channel else 0]
            level = np.float32(np.rint(base[n, c] + latents[n, c]) - base[n, c])
            gradient[n, c] += np.float32(factor * weights[n, 0] * unit * unit) * (latents[n, c] - level)


@compiled(
    "float64(float64[:, ::1], float32[:, ::1], int64[:, ::1], float32[::1], int64, int64, int64, float32[:, ::1])"
)
def level_bits(
    base: np.ndarray,
    latents: np.ndarray,
    rows: np.ndarray,
    table: np.ndarray,
    symbols: int,
    first: int,
    last: int,
    slopes: np.ndarray,
) -> float:
    """Return the bits of the levels of rows ``first`` to ``last`` (exclusive).

    Args:
        base: ``(R, C)`` symbol of each level of the plan.
        latents: ``(R, C)``.
        rows: ``(R, C)`` index of each level's code in ``table``.
        table: bits of the symbols of all codes; between two symbols they are interpolated.
        symbols: number of symbols of a code; ``symbols + 1`` entries of ``table`` belong to it.
        first: first row.
        last: end of the rows, exclusive.
        slopes: out, ``(R, C)``, gradient by the latents.
    """
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
    rows: np.ndarray,
    order: np.ndarray,
    used: np.ndarray,
    starts: np.ndarray,
    first: int,
    last: int,
    totals: np.ndarray,
) -> None:
    """Add up the rows of each label, of the labels ``used[first:last]``.

    Args:
        rows: ``(M, C)``.
        order: ``(M,)`` rows sorted by label.
        used: ``(U,)`` labels that occur.
        starts: ``(U + 1,)`` start of each of these in ``order``, and the end.
        first: first index into ``used``.
        last: end of the indices, exclusive.
        totals: ``(E, C)`` sums; rows are added.
    """
    for u in range(first, last):
        for i in range(starts[u], starts[u + 1]):
            for c in range(rows.shape[1]):
                totals[used[u], c] += rows[order[i], c]
