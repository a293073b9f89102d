"""Oracle: sorting by hand, block by block, and the eigenvectors of NumPy's covariance."""

from itertools import pairwise

import numpy as np
import pytest

from kissgs.planning.layout import axes_order, principal_axes


def test_bands_blocks_rows_and_columns_follow_the_axes():
    coordinates = np.random.default_rng(0).normal(size=(24 * 24, 6)).astype(np.float32)
    order = axes_order(coordinates)
    assert sorted(order) == list(range(24 * 24))
    table = coordinates[order].reshape(24, 24, 6)
    bands = table[..., 0].reshape(3, -1)
    assert (bands[:-1].max(axis=1) <= bands[1:].min(axis=1)).all()
    for top in range(0, 24, 8):
        blocks = [table[top : top + 8, left : left + 8] for left in range(0, 24, 8)]
        for left, right in pairwise(blocks):
            assert left[..., 1].max() <= right[..., 1].min()
        for block in blocks:
            assert (block[:-1, :, 2].max(axis=1) <= block[1:, :, 2].min(axis=1)).all()
            assert (np.diff(block[..., 3], axis=1) >= 0).all()


@pytest.mark.parametrize("dimensions", [1, 3])
def test_few_dimensions_still_give_a_permutation(dimensions):
    vectors = np.random.default_rng(2).normal(size=(256, dimensions)).astype(np.float32)
    assert sorted(axes_order(principal_axes(vectors, 4))) == list(range(256))


def test_coordinates_are_those_of_the_largest_variances():
    rng = np.random.default_rng(3)
    vectors = (rng.normal(size=(500, 5)) @ rng.normal(size=(5, 5)) + 100).astype(np.float32)
    values = np.linalg.eigvalsh(np.cov(vectors.T.astype(np.float64), bias=True))[::-1]
    coordinates = principal_axes(vectors, 3)
    assert coordinates.shape == (500, 3)
    np.testing.assert_allclose(coordinates.mean(axis=0), 0, atol=1e-4)
    np.testing.assert_allclose(np.cov(coordinates.T, bias=True), np.diag(values[:3]), atol=1e-3)
