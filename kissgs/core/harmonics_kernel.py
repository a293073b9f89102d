"""Numba kernel of spherical harmonics of any degree."""

from __future__ import annotations

import numpy as np
from numba import njit

from kissgs.core.numba_kernels import compiled


@njit(nogil=True, error_model="numpy")
def write_harmonics(x: float, y: float, z: float, degree: int, basis: np.ndarray) -> None:
    """Write the real spherical harmonics of degrees 1 to ``degree`` at a unit vector into ``basis``. Order and signs
    are those of 3DGS. The associated Legendre functions, divided by sinᵐ, follow from those of the two degrees below;
    sinᵐ cos(m phi) and sinᵐ sin(m phi) are powers of x + i y."""
    cosine, sine = np.sqrt(2.0), 0.0
    start = 0.28209479177387814  # of degree m and order m
    for m in range(degree + 1):
        if m > 0:
            cosine, sine = x * cosine - y * sine, x * sine + y * cosine
            start *= -np.sqrt((2.0 * m + 1) / (2 * m))
        below, value = 0.0, start
        for n in range(m, degree + 1):
            if n > m:
                ratio = np.sqrt((4.0 * n * n - 1) / (n * n - m * m))
                shrink = np.sqrt(((n - 1.0) ** 2 - m * m) / (4 * (n - 1.0) ** 2 - 1))
                below, value = value, ratio * (z * value - shrink * below)
            if n == 0:
                continue
            center = n * n + n - 1
            if m == 0:
                basis[center] = value
            else:
                basis[center + m] = value * cosine
                basis[center - m] = value * sine


@compiled("void(float64[:, ::1], int64, float64[:, ::1])")
def write_harmonics_of(directions: np.ndarray, degree: int, basis: np.ndarray) -> None:
    """Write :func:`write_harmonics` of each row of ``directions``, ``(P, 3)`` unit vectors, into a row of ``basis``."""
    for row in range(len(directions)):
        write_harmonics(directions[row, 0], directions[row, 1], directions[row, 2], degree, basis[row])
