"""Compiled inner loops of :mod:`kissgs.planning.rotation_forms`."""

from __future__ import annotations

import numpy as np
from numba import njit

from kissgs.core.array_types import Float32, Float64, Int64, UInt8
from kissgs.core.numba_kernels import compiled


@compiled("void(float32[:, ::1], float64[:, ::1])")
def normalize(quats: np.ndarray, unit: np.ndarray) -> None:
    """Write the quaternions ``(N, 4)``, divided by their lengths, to ``unit``."""
    for n in range(quats.shape[0]):
        w, x, y, z = np.float64(quats[n, 0]), np.float64(quats[n, 1]), np.float64(quats[n, 2]), np.float64(quats[n, 3])
        length = np.sqrt(w * w + x * x + y * y + z * z)
        unit[n, 0], unit[n, 1], unit[n, 2], unit[n, 3] = w / length, x / length, y / length, z / length


@compiled("void(float64[:, ::1], float64[:, ::1], uint8[::1])")
def largest_w(quats: np.ndarray, rotations: np.ndarray, forms: np.ndarray) -> None:
    """Write the form of largest w of each quaternion ``(N, 4)`` to ``forms``; among equals, the first of the table.

    w is compared in units of 1e-9: without rounding, equal forms would differ. ``rotations`` is ``(24, 4)``.
    """
    for n in range(quats.shape[0]):
        w, x, y, z = quats[n, 0], quats[n, 1], quats[n, 2], quats[n, 3]
        best = least = np.rint(w * 1e9)  # the first form is the identity
        chosen = lowest = 0
        for k in range(1, 24):
            found = w * rotations[k, 0] - x * rotations[k, 1] - y * rotations[k, 2] - z * rotations[k, 3]
            found = np.rint(found * 1e9)
            if found > best:
                best, chosen = found, k
            if found < least:
                least, lowest = found, k
        forms[n] = chosen if best >= -least else lowest + 24


@compiled(
    "void(float64[:, ::1], float32[:, ::1], uint8[::1], float64[:, ::1], int64[:, ::1], float64[:, ::1],"
    " float32[:, ::1])"
)
def apply_forms(
    quats: Float64[np.ndarray, "N 4"],
    scales: Float32[np.ndarray, "N 3"],
    forms: UInt8[np.ndarray, " N"],  # row of the table, plus 24 if the quaternion is negated
    rotations: Float64[np.ndarray, "24 4"],
    permutations: Int64[np.ndarray, "24 3"],  # scale order of each form
    new_quats: Float64[np.ndarray, "N 4"],  # written
    new_scales: Float32[np.ndarray, "N 3"],  # written
) -> None:
    """Write rotations and log-scales in the forms: the Hamilton product with a row of the table, and its order."""
    for n in range(quats.shape[0]):
        row, sign = forms[n] % 24, 1.0 if forms[n] < 24 else -1.0
        w1, x1, y1, z1 = quats[n, 0], quats[n, 1], quats[n, 2], quats[n, 3]
        w2, x2, y2, z2 = rotations[row, 0], rotations[row, 1], rotations[row, 2], rotations[row, 3]
        new_quats[n, 0] = sign * (w1 * w2 - x1 * x2 - y1 * y2 - z1 * z2)
        new_quats[n, 1] = sign * (w1 * x2 + x1 * w2 + y1 * z2 - z1 * y2)
        new_quats[n, 2] = sign * (w1 * y2 - x1 * z2 + y1 * w2 + z1 * x2)
        new_quats[n, 3] = sign * (w1 * z2 + x1 * y2 - y1 * x2 + z1 * w2)
        for i in range(3):
            new_scales[n, i] = scales[n, permutations[row, i]]


@njit(nogil=True, error_model="numpy")
def _covariance(quats: np.ndarray, scales: np.ndarray, largest: float, n: int, out: np.ndarray) -> None:
    """Write the covariance of one Gaussian, divided by the square of exp(``largest``), to ``out``, ``(2, 3, 3)``."""
    w, x, y, z = quats[n, 0], quats[n, 1], quats[n, 2], quats[n, 3]
    axes = out[1]
    axes[0, 0], axes[0, 1], axes[0, 2] = 1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)
    axes[1, 0], axes[1, 1], axes[1, 2] = 2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)
    axes[2, 0], axes[2, 1], axes[2, 2] = 2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)
    for k in range(3):
        deviation = np.exp(np.float64(scales[n, k]) - largest)
        for i in range(3):
            axes[i, k] *= deviation
    for i in range(3):
        for j in range(3):
            out[0, i, j] = axes[i, 0] * axes[j, 0] + axes[i, 1] * axes[j, 1] + axes[i, 2] * axes[j, 2]


@compiled("float64(float64[:, ::1], float32[:, ::1], float64[:, ::1], float32[:, ::1])")
def covariance_error(quats: np.ndarray, scales: np.ndarray, new_quats: np.ndarray, new_scales: np.ndarray) -> float:
    """Return the largest relative difference of the covariances before and after, Frobenius norm; 0 of no rows."""
    before, after = np.empty((2, 3, 3)), np.empty((2, 3, 3))
    worst = 0.0
    for n in range(quats.shape[0]):
        largest = np.float64(max(scales[n, 0], scales[n, 1], scales[n, 2]))  # avoids squares of e^±60
        _covariance(quats, scales, largest, n, before)
        _covariance(new_quats, new_scales, largest, n, after)
        size = difference = 0.0
        for i in range(3):
            for j in range(3):
                size += before[0, i, j] * before[0, i, j]
                difference += (after[0, i, j] - before[0, i, j]) ** 2
        worst = max(worst, difference / size)
    return np.sqrt(worst)
