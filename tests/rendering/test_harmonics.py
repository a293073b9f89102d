"""Spherical harmonics: the function of arrays and the kernel, against SciPy's complex ones."""

import numpy as np
from scipy.special import sph_harm_y

from kissgs.core.spherical_harmonics import sh_basis
from kissgs.rendering.cpu.harmonics import write_harmonics


def directions(count=200, seed=0):
    found = np.random.default_rng(seed).normal(size=(count, 3))
    found[:6] = [(1, 0, 0), (-1, 0, 0), (0, 1, 0), (0, -1, 0), (0, 0, 1), (0, 0, -1)]
    return found / np.linalg.norm(found, axis=1, keepdims=True)


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


def test_arrays_and_kernel_agree_with_scipy_to_degree_6():
    points = directions()
    for degree in range(7):
        wanted = real_harmonics(points, degree)
        np.testing.assert_allclose(sh_basis(points, degree), wanted, atol=1e-13)
        found = np.zeros((len(points), wanted.shape[1] - 1))
        for (x, y, z), row in zip(points, found, strict=True):
            write_harmonics(x, y, z, degree, row)
        np.testing.assert_allclose(found, wanted[:, 1:], atol=1e-13)
