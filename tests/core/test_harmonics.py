"""Spherical harmonics: the function of arrays and the kernel. Oracle: SciPy's complex ones."""

import numpy as np
from helpers.reference_harmonics import real_harmonics

from kissgs.core.harmonics_kernel import write_harmonics
from kissgs.core.spherical_harmonics import sh_basis


def directions(count=200, seed=0):
    found = np.random.default_rng(seed).normal(size=(count, 3))
    found[:6] = [(1, 0, 0), (-1, 0, 0), (0, 1, 0), (0, -1, 0), (0, 0, 1), (0, 0, -1)]
    return found / np.linalg.norm(found, axis=1, keepdims=True)


def test_arrays_agree_with_scipy_to_degree_3_and_the_kernel_to_degree_6():
    points = directions()
    for degree in range(7):
        wanted = real_harmonics(points, degree)
        if degree <= 3:
            np.testing.assert_allclose(sh_basis(points, degree), wanted, atol=1e-13)
        found = np.zeros((len(points), wanted.shape[1] - 1))
        for (x, y, z), row in zip(points, found, strict=True):
            write_harmonics(x, y, z, degree, row)
        np.testing.assert_allclose(found, wanted[:, 1:], atol=1e-13)
