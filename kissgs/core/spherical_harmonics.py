"""Real spherical harmonics in the order and with the signs of 3DGS."""

from __future__ import annotations

import numpy as np

from kissgs.core.array_types import Float


def sh_basis(directions: Float[np.ndarray, "M 3"], degree: int) -> Float[np.ndarray, "M K"]:
    """Return the (degree + 1)² real spherical harmonics with the signs of 3DGS, at unit vectors.

    A Gaussian's colour from direction d (from the camera to it) is 0.5 + basis(d) · (sh0, shN).

    The associated Legendre functions of each order, divided by sinᵐ, follow from those of the two degrees below; sinᵐ
    cos(m phi) and sinᵐ sin(m phi) are the parts of (x + i y)ᵐ.
    """
    x, y, z = directions.T
    found = [np.empty_like(x)] * (degree + 1) ** 2
    cosine, sine = np.full_like(x, 2**0.5), np.zeros_like(x)
    start = (4 * np.pi) ** -0.5  # of the degree that is the order
    for m in range(degree + 1):
        if m > 0:
            cosine, sine = x * cosine - y * sine, x * sine + y * cosine
            start *= -(((2 * m + 1) / (2 * m)) ** 0.5)
        below, value = np.zeros_like(x), np.full_like(x, start)
        for n in range(m, degree + 1):
            if n > m:
                ratio = ((4 * n * n - 1) / (n * n - m * m)) ** 0.5
                shrink = (((n - 1) ** 2 - m * m) / (4 * (n - 1) ** 2 - 1)) ** 0.5
                below, value = value, ratio * (z * value - shrink * below)
            center = n * n + n
            found[center + m], found[center - m] = value * cosine, value * sine
            if m == 0:
                found[center] = value
    return np.stack(found, axis=1)
