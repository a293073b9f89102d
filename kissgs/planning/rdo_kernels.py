"""Compiled inner loop of :mod:`kissgs.planning.rdo_quantize`."""

from __future__ import annotations

import numpy as np
from numba import njit

from kissgs.core.numba_kernels import compiled


@njit(nogil=True, error_model="numpy")
def _own_form(packed: np.ndarray, order: np.ndarray, signs: np.ndarray, form: np.ndarray) -> None:
    """The 7x7 form from its upper triangle, for axes that were renamed and turned round."""
    k = 0
    for i in range(7):
        for j in range(i, 7):
            form[i, j] = form[j, i] = packed[k]
            k += 1
    for i in range(3):
        for j in range(7):
            form[7 + i, j] = form[1 + order[i], j]
            form[10 + i, j] = form[4 + order[i], j] * signs[i]
    form[1:7, :7] = form[7:13, :7]
    for j in range(7):
        for i in range(3):
            form[7 + i, j] = form[j, 1 + order[i]]
            form[10 + i, j] = form[j, 4 + order[i]] * signs[i]
        for i in range(6):
            form[j, 1 + i] = form[7 + i, j]


@njit(nogil=True, error_model="numpy")
def _turns(w: float, x: float, y: float, z: float, moves: np.ndarray) -> None:
    """What each stored number does to (opacity, scales, rotation vector): a turn is 2 Im(conj(q) dq)."""
    moves[:, :] = 0.0
    for i in range(4):
        moves[i, i] = 1.0
    moves[4, 4], moves[4, 5], moves[4, 6] = -2 * x, -2 * y, -2 * z
    moves[5, 4], moves[5, 5], moves[5, 6] = 2 * w, -2 * z, 2 * y
    moves[6, 4], moves[6, 5], moves[6, 6] = 2 * z, 2 * w, -2 * x
    moves[7, 4], moves[7, 5], moves[7, 6] = -2 * y, 2 * x, 2 * w


@compiled(
    "void(float64[:, ::1], float32[:, ::1], uint8[::1], int64[:, ::1], float64[:, ::1], int64[::1],"
    " float64[::1], float64[::1], int64[::1], float64[:, :, ::1], float64[:, :, ::1], float64[::1], int64,"
    " int64[:, ::1])"
)
def round_shapes(
    values: np.ndarray,
    shapes: np.ndarray,
    forms: np.ndarray,
    orders: np.ndarray,
    signs: np.ndarray,
    classes: np.ndarray,
    low: np.ndarray,
    step: np.ndarray,
    top: np.ndarray,
    charges: np.ndarray,
    reach: np.ndarray,
    floor: np.ndarray,
    sweeps: int,
    levels: np.ndarray,
) -> None:
    """Choose the eight levels of each Gaussian's opacity, log-scales and quaternion: least error plus charge.

    One after the other, each given the others, some times over: an error of the opacity can make up for one of a scale.

    Args:
        values: ``(N, 8)``, quaternions of length 1.
        shapes: ``(N, 28)``, see :class:`kissgs.Sensitivity`.
        forms: ``(N,)`` which of its 48 equivalents each Gaussian is stored as, 0 to 23 (and 24 more for -q).
        orders: ``(24, 3)`` axes of the form, among those of the original.
        signs: ``(24, 3)`` whether they are turned round.
        classes: ``(N,)``.
        low: ``(8,)`` value of level 0.
        step: ``(8,)``.
        top: ``(8,)`` last level.
        charges: ``(classes, 8, 256)`` of each level: its bits times their price.
        reach: ``(N, 2, 8)`` how far below and above the value a level may be.
        floor: ``(3,)`` added to the diagonal of the form: opacity, scales, rotation.
        sweeps: how often to go through the eight.
        levels: ``(N, 8)``; changed.
    """
    form, moves = np.empty((13, 13), np.float64), np.empty((8, 7), np.float64)
    error, pull = np.empty(7, np.float64), np.empty(7, np.float64)
    for n in range(values.shape[0]):
        _own_form(shapes[n], orders[forms[n] % 24], signs[forms[n] % 24], form)
        form[0, 0] += floor[0]
        for i in range(3):
            form[1 + i, 1 + i] += floor[1]
            form[4 + i, 4 + i] += floor[2]
        _turns(values[n, 4], values[n, 5], values[n, 6], values[n, 7], moves)
        error[:] = 0.0
        for j in range(8):
            off = low[j] + levels[n, j] * step[j] - values[n, j]
            for k in range(7):
                error[k] += off * moves[j, k]
        for _ in range(sweeps):
            for j in range(8):
                slope = bend = 0.0
                for k in range(7):
                    if moves[j, k] != 0.0:
                        pull[k] = 0.0
                        across = 0.0
                        for i in range(7):
                            pull[k] += form[k, i] * error[i]
                            across += form[k, i] * moves[j, i]
                        slope += moves[j, k] * pull[k]
                        bend += moves[j, k] * across
                bend = max(bend, 0.0)
                here = (values[n, j] - low[j]) / step[j]
                first = max(int(np.ceil(here - reach[n, 0, j] / step[j])), 0)
                last = min(int(np.floor(here + reach[n, 1, j] / step[j])), top[j])
                current = levels[n, j]
                if first > last:
                    continue
                best, chosen = np.inf, current
                for level in range(first, last + 1):
                    move = (level - current) * step[j]
                    cost = (2 * slope + move * bend) * move + charges[classes[n], j, level]
                    if cost < best:
                        best, chosen = cost, level
                if chosen != current:
                    move = (chosen - current) * step[j]
                    for k in range(7):
                        error[k] += move * moves[j, k]
                    levels[n, j] = chosen
