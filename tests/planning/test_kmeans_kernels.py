"""Oracle: the same sums and distances in NumPy, in float64, from the definitions."""

import numpy as np
from helpers.clusters import clustered, means_of

from kissgs.planning import kmeans_kernels as kernels


def test_members_are_in_stable_order():
    *_, labels, members, _ = clustered()
    assert (members == np.argsort(labels, kind="stable")).all()


def test_means_totals_and_errors():
    table, rows, weights, labels, members, edges = clustered()
    distances = np.random.default_rng(1).random(len(rows), np.float32)
    centroids, totals, errors = means_of(table, rows, weights, members, edges, distances)
    for k in range(12):
        own = labels == k
        np.testing.assert_allclose(totals[k], weights[own].sum(dtype=np.float64), rtol=1e-6)
        np.testing.assert_allclose(errors[k], (weights * distances.astype(np.float64))[own].sum(), rtol=1e-6)
        wanted = np.average(table[rows[own]], axis=0, weights=weights[own]) if own.any() else 9
        np.testing.assert_allclose(centroids[k], wanted, atol=1e-6)


def test_near_centroids_are_the_nearest_of_the_lists_searched():
    rng = np.random.default_rng(3)
    centroids = rng.normal(size=(60, 7)).astype(np.float32)
    near = np.stack([np.append(k, rng.permutation(np.delete(np.arange(60), k))[:7]) for k in range(60)])
    near = near.astype(np.uint16)
    squared = np.square(centroids.astype(np.float64)[:, None] - centroids).sum(axis=2)
    found = np.empty_like(near)
    kernels.find_near(centroids, near, 3, 0, 60, found)
    for k in range(60):
        candidates = np.unique(near[near[k, :4]])
        wanted = candidates[np.argsort(np.where(candidates == k, -1, squared[k, candidates]))][:8]
        assert found[k].tolist() == wanted.tolist()


def test_near_centroids_that_all_others_are():
    centroids = np.arange(4, dtype=np.float32)[:, None] ** 2
    near = np.array([[0, 3, 1, 2], [1, 0, 2, 3], [2, 1, 3, 0], [3, 2, 1, 0]], np.uint16)
    found = np.empty_like(near)
    kernels.find_near(centroids, near, 9, 0, 4, found)
    assert found.tolist() == [[0, 1, 2, 3], [1, 0, 2, 3], [2, 1, 0, 3], [3, 2, 1, 0]]


def test_vectors_go_to_the_nearest_of_their_near_centroids():
    table, rows, _, labels, members, edges = clustered()
    rng = np.random.default_rng(2)
    centroids = rng.normal(size=(12, 7)).astype(np.float32)
    near = np.stack([np.append(k, rng.permutation(np.delete(np.arange(12), k))[:5]) for k in range(12)]).astype(
        np.uint16
    )
    found, distances = labels.copy(), np.empty(len(rows), np.float32)
    kernels.assign_near(table, rows, members, edges, centroids, near, 0, 12, found, distances)
    squared = np.square(table[rows].astype(np.float64)[:, None] - centroids).sum(axis=2)
    allowed = np.take_along_axis(squared, near[labels], axis=1)
    np.testing.assert_allclose(distances, allowed.min(axis=1), atol=1e-5)
    np.testing.assert_allclose(squared[np.arange(len(rows)), found], distances, atol=1e-5)
    assert all(label in near[k] for label, k in zip(found, labels, strict=True))
