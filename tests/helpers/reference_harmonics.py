"""Real spherical harmonics from SciPy's complex ones."""

import numpy as np
from scipy.special import sph_harm_y


def real_harmonics(points, degree):
    """Return real harmonics: with the phase of Condon and Shortley, as those of 3DGS."""
    polar, azimuth = np.arccos(points[:, 2]), np.arctan2(points[:, 1], points[:, 0])
    columns = []
    for n in range(degree + 1):
        for m in range(-n, n + 1):
            value = sph_harm_y(n, abs(m), polar, azimuth)
            part = value.imag if m < 0 else value.real
            columns.append(part if m == 0 else np.sqrt(2) * part)
    return np.stack(columns, axis=1)
