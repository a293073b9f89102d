"""Numba kernels that convert rotations and scales to covariances, and back."""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from kissgs.core.numba_kernels import compiled


@compiled("void(float32[:, ::1], float32[:, ::1], int64, int64, float64[:, ::1])")
def covariances_of(quats: np.ndarray, scales: np.ndarray, first: int, last: int, out: np.ndarray) -> None:
    """Compute the covariances (xx, xy, xz, yy, yz, zz) of rows ``first`` to ``last`` (exclusive).

    Quaternions are w, x, y, z of unit length; scales are natural logarithms of standard deviations.
    """
    turn = np.empty((3, 3))
    for n in range(first, last):
        w, x, y, z = np.float64(quats[n, 0]), np.float64(quats[n, 1]), np.float64(quats[n, 2]), np.float64(quats[n, 3])
        turn[0, 0], turn[0, 1], turn[0, 2] = 1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)
        turn[1, 0], turn[1, 1], turn[1, 2] = 2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)
        turn[2, 0], turn[2, 1], turn[2, 2] = 2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)
        at = 0
        for a in range(3):
            for b in range(a, 3):
                total = 0.0
                for c in range(3):
                    total += turn[a, c] * turn[b, c] * math.exp(2 * np.float64(scales[n, c]))
                out[n, at] = total
                at += 1


@njit(nogil=True, error_model="numpy")
def _rotate(matrix: np.ndarray, turn: np.ndarray, a: int, b: int) -> None:
    """Make an off-diagonal element of a symmetric matrix zero by a rotation, which ``turn`` takes part in."""
    off = matrix[a, b]
    if abs(off) <= 1e-17 * math.sqrt(abs(matrix[a, a])) * math.sqrt(abs(matrix[b, b])):
        return
    ratio = (matrix[b, b] - matrix[a, a]) / (2 * off)
    tangent = (1.0 if ratio >= 0 else -1.0) / (abs(ratio) + math.sqrt(ratio * ratio + 1))
    cosine = 1 / math.sqrt(tangent * tangent + 1)
    sine = tangent * cosine
    for c in range(3):
        u, v = matrix[c, a], matrix[c, b]
        matrix[c, a], matrix[c, b] = cosine * u - sine * v, sine * u + cosine * v
    for c in range(3):
        u, v = matrix[a, c], matrix[b, c]
        matrix[a, c], matrix[b, c] = cosine * u - sine * v, sine * u + cosine * v
        u, v = turn[c, a], turn[c, b]
        turn[c, a], turn[c, b] = cosine * u - sine * v, sine * u + cosine * v


@njit(nogil=True, error_model="numpy")
def _quaternion(turn: np.ndarray, out: np.ndarray) -> None:
    """Convert a rotation matrix to a unit quaternion, by its largest component."""
    xx, yy, zz = turn[0, 0], turn[1, 1], turn[2, 2]
    squares = (1 + xx + yy + zz, 1 + xx - yy - zz, 1 - xx + yy - zz, 1 - xx - yy + zz)
    largest = 0
    for c in range(1, 4):
        if squares[c] > squares[largest]:
            largest = c
    double = 2 * math.sqrt(squares[largest])
    w = (turn[2, 1] - turn[1, 2], turn[0, 2] - turn[2, 0], turn[1, 0] - turn[0, 1])
    xy, xz, yz = turn[0, 1] + turn[1, 0], turn[0, 2] + turn[2, 0], turn[1, 2] + turn[2, 1]
    if largest == 0:
        parts = (double * double / 4, w[0], w[1], w[2])
    elif largest == 1:
        parts = (w[0], double * double / 4, xy, xz)
    elif largest == 2:
        parts = (w[1], xy, double * double / 4, yz)
    else:
        parts = (w[2], xz, yz, double * double / 4)
    for c in range(4):
        out[c] = parts[c] / double


@compiled("void(float64[:, ::1], int64[::1], int64, int64, float32[:, ::1], float32[:, ::1])")
def decompose(
    covariances: np.ndarray, rows: np.ndarray, first: int, last: int, quats: np.ndarray, scales: np.ndarray
) -> None:
    """Compute rotation and log-scales of covariances by Jacobi's method, ``rows[first:last]``.

    Scales of less than 1e-7 of the largest one are lost in rounding.
    """
    matrix, turn = np.empty((3, 3)), np.empty((3, 3))
    for at in range(first, last):
        n, from_ = rows[at], 0
        for a in range(3):
            for b in range(a, 3):
                matrix[a, b] = matrix[b, a] = covariances[n, from_]
                turn[a, b] = turn[b, a] = 1.0 if a == b else 0.0
                from_ += 1
        for _ in range(12):
            for a in range(2):
                for b in range(a + 1, 3):
                    _rotate(matrix, turn, a, b)
        largest = max(matrix[0, 0], matrix[1, 1], matrix[2, 2])
        for c in range(3):
            scales[n, c] = 0.5 * math.log(max(matrix[c, c], 1e-14 * largest))
        _quaternion(turn, quats[n])
