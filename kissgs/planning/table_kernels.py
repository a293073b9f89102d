"""Compiled inner loop of :mod:`kissgs.planning.rdo_tables`."""

from __future__ import annotations

import numpy as np
from numba import njit

from kissgs.core.numba_kernels import compiled
from kissgs.planning.rdo_kernels import _form_hessian, _jacobian


@njit(nogil=True, error_model="numpy")
def _stored_jacobian(quat: np.ndarray, kept: np.ndarray, omitted: int, jacobian: np.ndarray) -> None:
    """Replace the rows of the four components by those of the three stored ones, which also move the missing one."""
    for j in range(3):
        ratio = quat[kept[j]] / max(quat[omitted], 0.2)
        for k in range(7):
            jacobian[8 + j, k] = jacobian[4 + kept[j], k] - ratio * jacobian[4 + omitted, k]
    jacobian[4:7, :] = jacobian[8:11, :]


@njit(nogil=True, error_model="numpy")
def _current_error(
    values: np.ndarray,
    quat: np.ndarray,
    kept: np.ndarray,
    omitted: int,
    tables: np.ndarray,
    levels: np.ndarray,
    jacobian: np.ndarray,
    error: np.ndarray,
) -> float:
    """Write the error (opacity, scales, rotation vector) of the levels; return the sum of squares of the rotation."""
    error[:] = 0.0
    for j in range(4):
        error[j] = tables[j, levels[j]] - values[j]
    squares = 0.0
    for j in range(3):
        stored = tables[4 + j, levels[4 + j]]
        squares += stored * stored
        for k in range(4, 7):
            error[k] += (stored - quat[kept[j]]) * jacobian[4 + kept[j], k]
    missing = np.sqrt(max(1.0 - squares, 0.0)) - quat[omitted]
    for k in range(4, 7):
        error[k] += missing * jacobian[4 + omitted, k]
    return squares


@compiled(
    "void(float64[:, ::1], float64[:, ::1], uint8[::1], float32[:, ::1], uint8[::1], int64[:, ::1],"
    " int64[:, ::1], int64[::1], float64[:, ::1], int64[:, ::1], float64[:, :, ::1], float64[:, :, ::1],"
    " float64[::1], int64[:, ::1])"
)
def choose_levels(
    values: np.ndarray,
    quats: np.ndarray,
    omitted: np.ndarray,
    shapes: np.ndarray,
    forms: np.ndarray,
    orders: np.ndarray,
    kept: np.ndarray,
    classes: np.ndarray,
    tables: np.ndarray,
    ends: np.ndarray,
    rate_table: np.ndarray,
    search_range: np.ndarray,
    floor: np.ndarray,
    levels: np.ndarray,
) -> None:
    """Choose the levels of opacity, log-scales and three components of the rotation: squared error plus lambda · bits.

    Args:
        values: ``(N, 7)`` opacity logit, log-scales, stored components of the rotation.
        quats: ``(N, 4)`` the whole quaternion, of length 1, whose missing component is not negative.
        omitted: ``(N,)`` index of the missing component.
        shapes: ``(N, 10)`` shape Hessians of :class:`kissgs.Sensitivity`.
        forms: ``(N,)`` rotation form of each Gaussian, 0 to 23 (plus 24 for -q).
        orders: ``(24, 3)`` original axis of each axis of the form.
        kept: ``(4, 3)`` stored components by the missing one.
        classes: ``(N,)`` sensitivity class.
        tables: ``(7, 256)`` ascending values of the levels.
        ends: ``(7, 2)`` smallest and largest level to use.
        rate_table: ``(classes, 7, 256)`` lambda times the bits of each level.
        search_range: ``(N, 2, 7)`` largest distance of a level below and above the value.
        floor: ``(3,)`` added to the Hessian's diagonal: opacity, scales, rotation.
        levels: ``(N, 7)``; modified.
    """
    hessian, jacobian = np.zeros((7, 7), np.float64), np.empty((11, 7), np.float64)
    whole = np.empty((8, 7), np.float64)
    error, gradient = np.empty(7, np.float64), np.empty(7, np.float64)
    for n in range(values.shape[0]):
        _form_hessian(shapes[n], orders[forms[n] % 24], floor, hessian)
        _jacobian(quats[n, 0], quats[n, 1], quats[n, 2], quats[n, 3], whole)
        jacobian[:8, :] = whole
        squares = _current_error(values[n], quats[n], kept[omitted[n]], omitted[n], tables, levels[n], jacobian, error)
        _stored_jacobian(quats[n], kept[omitted[n]], omitted[n], jacobian)
        for j in range(7):
            slope = curvature = 0.0
            for k in range(7):
                if jacobian[j, k] != 0.0:
                    gradient[k] = 0.0
                    across = 0.0
                    for i in range(7):
                        gradient[k] += hessian[k, i] * error[i]
                        across += hessian[k, i] * jacobian[j, i]
                    slope += jacobian[j, k] * gradient[k]
                    curvature += jacobian[j, k] * across
            curvature = max(curvature, 0.0)
            current = levels[n, j]
            now = tables[j, current]
            others = squares - now * now if j >= 4 else 0.0
            best, chosen = np.inf, current
            level = max(ends[j, 0], np.searchsorted(tables[j, : ends[j, 1] + 1], values[n, j] - search_range[n, 0, j]))
            while level <= ends[j, 1] and tables[j, level] <= values[n, j] + search_range[n, 1, j]:
                move = tables[j, level] - now
                cost = (2 * slope + move * curvature) * move + rate_table[classes[n], j, level]
                if cost < best and (j < 4 or others + tables[j, level] * tables[j, level] <= 0.9999):
                    best, chosen = cost, level
                level += 1
            if chosen != current:
                move = tables[j, chosen] - now
                for k in range(7):
                    error[k] += move * jacobian[j, k]
                if j >= 4:
                    squares = others + tables[j, chosen] * tables[j, chosen]
                levels[n, j] = chosen
