"""Compiled inner loop of :mod:`kissgs.planning.rd_fields`."""

from __future__ import annotations

import numpy as np
from numba import njit

from kissgs.core.array_types import Float32, Float64, Int64, UInt8
from kissgs.core.numba_kernels import compiled


@njit(nogil=True, error_model="numpy")
def _form_hessian(packed: np.ndarray, order: np.ndarray, floor: np.ndarray, hessian: np.ndarray) -> None:
    """Unpack a Hessian of :class:`kissgs.Sensitivity` for a form with its axes in ``order``, ``(3,)``. ``floor``:
    ``(3,)`` is added to the diagonal: opacity, scales, rotation."""
    hessian[0, 0] = packed[0] + floor[0]
    for i in range(3):
        hessian[0, 1 + i] = hessian[1 + i, 0] = packed[1 + order[i]]
        hessian[1 + i, 1 + i] = packed[4 + order[i]] + floor[1]
        hessian[4 + i, 4 + i] = packed[7 + order[i]] + floor[2]


@njit(nogil=True, error_model="numpy")
def _rotation_vectors(quat: np.ndarray, vectors: np.ndarray) -> None:
    """Write the derivative of the rotation vector by each component of a quaternion, ``(4, 3)``. A change dq of a
    quaternion q turns by the vector 2 Im(conj(q) dq) / |q|²."""
    w, x, y, z = quat[0], quat[1], quat[2], quat[3]
    scale = 2 / (w * w + x * x + y * y + z * z)
    w, x, y, z = scale * w, scale * x, scale * y, scale * z
    vectors[0, 0], vectors[0, 1], vectors[0, 2] = -x, -y, -z
    vectors[1, 0], vectors[1, 1], vectors[1, 2] = w, -z, y
    vectors[2, 0], vectors[2, 1], vectors[2, 2] = z, w, -x
    vectors[3, 0], vectors[3, 1], vectors[3, 2] = -y, x, w


@njit(nogil=True, error_model="numpy")
def _start(
    values: np.ndarray,
    stored: np.ndarray,
    omitted: int,
    tables: np.ndarray,
    levels: np.ndarray,
    vectors: np.ndarray,
    jacobian: np.ndarray,
    error: np.ndarray,
) -> float:
    """Write the error (opacity, scales, rotation vector) of the levels, and its derivatives by the stored components.
    Return the sum of the squares of the components. Where one is left out, the others move it."""
    for j in range(4):
        error[j] = tables[j, levels[j]] - values[j]
    error[4:] = 0.0
    squares = 0.0
    for i in range(len(stored)):
        component, found = stored[i], tables[4 + i, levels[4 + i]]
        squares += found * found
        ratio = values[4 + component] / max(values[4 + omitted], 0.2) if omitted >= 0 else 0.0
        for k in range(3):
            error[4 + k] += (found - values[4 + component]) * vectors[component, k]
            jacobian[4 + i, 4 + k] = vectors[component, k]
            if omitted >= 0:
                jacobian[4 + i, 4 + k] -= ratio * vectors[omitted, k]
    if omitted >= 0:
        missing = np.sqrt(max(1.0 - squares, 0.0)) - values[4 + omitted]
        for k in range(3):
            error[4 + k] += missing * vectors[omitted, k]
    return squares


@compiled(
    "void(float64[:, ::1], int64[:, ::1], int64[::1], float32[:, ::1], uint8[::1], int64[:, ::1], int64[::1],"
    " float64[:, ::1], int64[:, ::1], float64[:, :, ::1], float64[:, :, ::1], float64[::1], int64[:, ::1])"
)
def choose_levels(
    values: Float64[np.ndarray, "N 8"],  # opacity logit, log-scales, quaternion of any length above 0
    stored: Int64[np.ndarray, "N parts"],  # components of the quaternion that have levels
    omitted: Int64[np.ndarray, " N"],  # the one that follows from the length 1, and is not negative; -1 for none
    hessians: Float32[np.ndarray, "N 10"],  # shape Hessians of Sensitivity
    forms: UInt8[np.ndarray, " N"],  # 0 to 23, plus 24 for -q
    orders: Int64[np.ndarray, "24 3"],  # original axis of each axis of a form
    classes: Int64[np.ndarray, " N"],
    tables: Float64[np.ndarray, "C 256"],  # ascending values of the levels
    ends: Int64[np.ndarray, "C 2"],  # smallest and largest level to use
    rate_table: Float64[np.ndarray, "classes C 256"],  # lambda times the bits of each level
    search_range: Float64[np.ndarray, "N 2 C"],  # largest distance of a level below and above the value
    floor: Float64[np.ndarray, " 3"],  # added to the Hessians' diagonals: opacity, scales, rotation
    levels: Int64[np.ndarray, "N C"],  # modified
) -> None:
    """Choose the levels of each Gaussian's opacity, log-scales and quaternion by squared error plus lambda · bits. They
    are chosen one after the other, each given the others, because an error of the opacity can compensate one of a
    scale."""
    columns = levels.shape[1]
    hessian, jacobian, error = np.zeros((7, 7), np.float64), np.zeros((8, 7), np.float64), np.empty(7, np.float64)
    vectors = np.empty((4, 3), np.float64)
    for j in range(4):
        jacobian[j, j] = 1.0
    for n in range(values.shape[0]):
        _form_hessian(hessians[n], orders[forms[n] % 24], floor, hessian)
        _rotation_vectors(values[n, 4:], vectors)
        squares = _start(values[n], stored[n], omitted[n], tables, levels[n], vectors, jacobian, error)
        for j in range(columns):
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
            value = values[n, j] if j < 4 else values[n, 4 + stored[n, j - 4]]
            least, most = value - search_range[n, 0, j], value + search_range[n, 1, j]
            chosen, now = levels[n, j], tables[j, levels[n, j]]
            others = squares - now * now
            level = min(max(levels[n, j], ends[j, 0]), ends[j, 1])
            while level > ends[j, 0] and tables[j, level - 1] >= least:
                level -= 1
            best = np.inf
            while level <= ends[j, 1] and tables[j, level] <= most:
                found = tables[j, level]
                move = found - now
                cost = (2 * slope + move * curvature) * move + rate_table[classes[n], j, level]
                exists = omitted[n] < 0 or j < 4 or others + found * found <= 0.9999
                if cost < best and found >= least and exists:
                    best, chosen = cost, level
                level += 1
            if chosen != levels[n, j]:
                move = tables[j, chosen] - now
                for k in range(start, end):
                    error[k] += move * jacobian[j, k]
                if j >= 4:
                    squares = others + tables[j, chosen] * tables[j, chosen]
                levels[n, j] = chosen
