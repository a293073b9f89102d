"""Compiled inner loop of :mod:`kissgs.planning.rdo_quantize`."""

from __future__ import annotations

import numpy as np
from numba import njit

from kissgs.core.numba_kernels import compiled


@njit(nogil=True, error_model="numpy")
def _form_tables(orders: np.ndarray, signs: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return, for each of the forms, the place in the packed Hessian and the sign of the 7x7 entries, ``(24, 7, 7)``.

    The axes of a form are permuted by ``orders`` and reversed where ``signs`` is -1, ``(24, 3)``.
    """
    places, factors = np.empty((24, 7, 7), np.int64), np.empty((24, 7, 7), np.float64)
    start = np.array([0, 7, 13, 18, 22, 25, 27])  # place of each row's diagonal entry
    row, sign = np.empty(7, np.int64), np.empty(7, np.float64)
    for form in range(24):
        row[0], sign[0] = 0, 1.0
        for i in range(3):
            row[1 + i], sign[1 + i] = 1 + orders[form, i], 1.0
            row[4 + i], sign[4 + i] = 4 + orders[form, i], signs[form, i]
        for i in range(7):
            for j in range(7):
                first, last = min(row[i], row[j]), max(row[i], row[j])
                places[form, i, j] = start[first] + last - first
                factors[form, i, j] = sign[i] * sign[j]
    return places, factors


@njit(nogil=True, error_model="numpy")
def _form_hessian(packed: np.ndarray, places: np.ndarray, factors: np.ndarray, hessian: np.ndarray) -> None:
    """Unpack the 7x7 Hessian from its upper triangle, for the axes of one form."""
    for i in range(7):
        for j in range(i, 7):
            hessian[i, j] = hessian[j, i] = packed[places[i, j]] * factors[i, j]


@njit(nogil=True, error_model="numpy")
def _jacobian(w: float, x: float, y: float, z: float, jacobian: np.ndarray) -> None:
    """Write the derivatives of (opacity, scales, rotation vector 2 Im(conj(q) dq)) by the eight stored values."""
    jacobian[:, :] = 0.0
    for i in range(4):
        jacobian[i, i] = 1.0
    jacobian[4, 4], jacobian[4, 5], jacobian[4, 6] = -2 * x, -2 * y, -2 * z
    jacobian[5, 4], jacobian[5, 5], jacobian[5, 6] = 2 * w, -2 * z, 2 * y
    jacobian[6, 4], jacobian[6, 5], jacobian[6, 6] = 2 * z, 2 * w, -2 * x
    jacobian[7, 4], jacobian[7, 5], jacobian[7, 6] = -2 * y, 2 * x, 2 * w


@compiled(
    "void(float64[:, ::1], float32[:, ::1], uint8[::1], int64[:, ::1], float64[:, ::1], int64[::1],"
    " float64[::1], float64[::1], int64[::1], float64[:, :, ::1], float64[:, :, ::1], float64[::1], int64,"
    " int64[:, ::1])"
)
def choose_levels(
    values: np.ndarray,
    shapes: np.ndarray,
    forms: np.ndarray,
    orders: np.ndarray,
    signs: np.ndarray,
    classes: np.ndarray,
    low: np.ndarray,
    step: np.ndarray,
    top: np.ndarray,
    rate_table: np.ndarray,
    search_range: np.ndarray,
    floor: np.ndarray,
    sweeps: int,
    levels: np.ndarray,
) -> None:
    """Choose the levels of each Gaussian's opacity, log-scales and quaternion by squared error plus lambda · bits.

    The eight levels are chosen one after the other, each given the other seven, because an error of the opacity can
    compensate one of a scale.

    Args:
        values: ``(N, 8)``, quaternions of length 1.
        shapes: ``(N, 28)`` shape Hessians of :class:`kissgs.Sensitivity`.
        forms: ``(N,)`` rotation form of each Gaussian, 0 to 23 (plus 24 for -q).
        orders: ``(24, 3)`` original axis of each axis of the form.
        signs: ``(24, 3)`` 1, or -1 if the axis is reversed.
        classes: ``(N,)`` sensitivity class.
        low: ``(8,)`` value of level 0.
        step: ``(8,)`` quantisation step.
        top: ``(8,)`` largest level.
        rate_table: ``(classes, 8, 256)`` lambda times the bits of each level.
        search_range: ``(N, 2, 8)`` largest distance of a level below and above the value.
        floor: ``(3,)`` added to the Hessian's diagonal: opacity, scales, rotation.
        sweeps: number of passes over the eight levels.
        levels: ``(N, 8)``; modified.
    """
    places, factors = _form_tables(orders, signs)
    hessian, jacobian, error = np.empty((7, 7), np.float64), np.empty((8, 7), np.float64), np.empty(7, np.float64)
    for n in range(values.shape[0]):
        _form_hessian(shapes[n], places[forms[n] % 24], factors[forms[n] % 24], hessian)
        hessian[0, 0] += floor[0]
        for i in range(3):
            hessian[1 + i, 1 + i] += floor[1]
            hessian[4 + i, 4 + i] += floor[2]
        _jacobian(values[n, 4], values[n, 5], values[n, 6], values[n, 7], jacobian)
        error[:] = 0.0
        for j in range(8):
            off = low[j] + levels[n, j] * step[j] - values[n, j]
            for k in range(7):
                error[k] += off * jacobian[j, k]
        for _ in range(sweeps):
            for j in range(8):
                start, end = (j, j + 1) if j < 4 else (4, 7)  # the other derivatives are 0
                slope = curvature = 0.0
                for k in range(start, end):
                    gradient = across = 0.0
                    for i in range(7):
                        gradient += hessian[k, i] * error[i]
                    for i in range(start, end):
                        across += hessian[k, i] * jacobian[j, i]
                    slope += jacobian[j, k] * gradient
                    curvature += jacobian[j, k] * across
                curvature = max(curvature, 0.0)
                here = (values[n, j] - low[j]) / step[j]
                first = max(int(np.ceil(here - search_range[n, 0, j] / step[j])), 0)
                last = min(int(np.floor(here + search_range[n, 1, j] / step[j])), top[j])
                current = levels[n, j]
                if first > last:
                    continue
                best, chosen = np.inf, current
                for level in range(first, last + 1):
                    move = (level - current) * step[j]
                    cost = (2 * slope + move * curvature) * move + rate_table[classes[n], j, level]
                    if cost < best:
                        best, chosen = cost, level
                if chosen != current:
                    move = (chosen - current) * step[j]
                    for k in range(start, end):
                        error[k] += move * jacobian[j, k]
                    levels[n, j] = chosen
