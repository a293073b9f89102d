"""Compiled inner loop of :mod:`kissgs.planning.rdo_quantize`."""

from __future__ import annotations

import numpy as np
from numba import njit

from kissgs.core.numba_kernels import compiled


@njit(nogil=True, error_model="numpy")
def _form_hessian(packed: np.ndarray, order: np.ndarray, floor: np.ndarray, hessian: np.ndarray) -> None:
    """Unpack a Hessian of :class:`kissgs.Sensitivity` for a form with its axes in ``order``, ``(3,)``.

    ``floor``: ``(3,)`` is added to the diagonal: opacity, scales, rotation.
    """
    hessian[0, 0] = packed[0] + floor[0]
    for i in range(3):
        hessian[0, 1 + i] = hessian[1 + i, 0] = packed[1 + order[i]]
        hessian[1 + i, 1 + i] = packed[4 + order[i]] + floor[1]
        hessian[4 + i, 4 + i] = packed[7 + order[i]] + floor[2]


@njit(nogil=True, error_model="numpy")
def _jacobian(w: float, x: float, y: float, z: float, jacobian: np.ndarray) -> None:
    """Write the derivatives of (opacity, scales, rotation vector) by the eight stored values.

    A change dq of a quaternion q turns by the vector 2 Im(conj(q) dq) / |q|².
    """
    jacobian[:, :] = 0.0
    scale = 2 / (w * w + x * x + y * y + z * z)
    w, x, y, z = scale * w, scale * x, scale * y, scale * z
    for i in range(4):
        jacobian[i, i] = 1.0
    jacobian[4, 4], jacobian[4, 5], jacobian[4, 6] = -x, -y, -z
    jacobian[5, 4], jacobian[5, 5], jacobian[5, 6] = w, -z, y
    jacobian[6, 4], jacobian[6, 5], jacobian[6, 6] = z, w, -x
    jacobian[7, 4], jacobian[7, 5], jacobian[7, 6] = -y, x, w


@compiled(
    "void(float64[:, ::1], float32[:, ::1], uint8[::1], int64[:, ::1], int64[::1],"
    " float64[::1], float64[::1], int64[::1], float64[:, :, ::1], float64[:, :, ::1], float64[::1], int64,"
    " int64[:, ::1])"
)
def choose_levels(
    values: np.ndarray,
    shapes: np.ndarray,
    forms: np.ndarray,
    orders: np.ndarray,
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
        values: ``(N, 8)``, quaternions of any length above 0.
        shapes: ``(N, 10)`` shape Hessians of :class:`kissgs.Sensitivity`.
        forms: ``(N,)`` rotation form of each Gaussian, 0 to 23 (plus 24 for -q).
        orders: ``(24, 3)`` original axis of each axis of the form.
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
    hessian, jacobian, error = np.zeros((7, 7), np.float64), np.empty((8, 7), np.float64), np.empty(7, np.float64)
    for n in range(values.shape[0]):
        _form_hessian(shapes[n], orders[forms[n] % 24], floor, hessian)
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
