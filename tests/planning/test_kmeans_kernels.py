"""Oracle: the same sums and distances in NumPy, in float64, from the definitions."""

import numpy as np

from kissgs.planning import kmeans_kernels as kernels


def clustered(count=400, dimensions=7, clusters=12, seed=0):
    """Vectors of a table that holds others too, with weights, labels, members by label and their means."""
    rng = np.random.default_rng(seed)
    table = rng.normal(size=(2 * count, dimensions)).astype(np.float32)
    rows = rng.permutation(2 * count)[:count]
    weights = rng.uniform(0.1, 10, count).astype(np.float32)
    labels = rng.integers(0, clusters, count).astype(np.int32)
    labels[labels == 5] = 6  # a cluster without vectors
    edges = np.concatenate([[0], np.cumsum(np.bincount(labels, minlength=clusters))])
    members = np.empty(count, np.int32)
    kernels.sort_by_label(labels, edges[:-1].copy(), members)
    return table, rows, weights, labels, members, edges


def error_of(vectors, weights):
    mean = np.average(vectors, axis=0, weights=weights)
    return (weights * np.square(vectors - mean).sum(axis=1)).sum()


def means_of(table, rows, weights, members, edges, distances):
    centroids = np.full((len(edges) - 1, table.shape[1]), 9, np.float32)
    totals, errors = np.empty(len(centroids)), np.empty(len(centroids))
    kernels.means(table, rows, weights, distances, members, edges, 0, len(centroids), centroids, totals, errors)
    return centroids, totals, errors


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


def test_costs_of_merging_and_gains_of_splitting_are_differences_of_the_error():
    table, rows, weights, labels, members, edges = clustered()
    distances = np.random.default_rng(1).random(len(rows), np.float32)
    centroids, totals, errors = means_of(table, rows, weights, members, edges, distances)
    vectors, weights64 = table[rows].astype(np.float64), weights.astype(np.float64)

    def error(own):
        return error_of(vectors[own], weights64[own]) if own.any() else 0.0

    near = np.stack([np.append(k, np.delete(np.arange(12), k)) for k in range(12)]).astype(np.uint16)
    partners, costs = np.empty(12, np.int32), np.empty(12)
    kernels.merge_costs(centroids, totals, near, 0, 12, partners, costs)
    for k in range(12):
        joint = [error((labels == k) | (labels == j)) - error(labels == j) for j in range(12) if j not in (k, 5)]
        wanted = min(joint) - error(labels == k) if k != 5 else 0
        np.testing.assert_allclose(costs[k], wanted, rtol=1e-3, atol=1e-3)
    second, gains = np.zeros(len(rows), np.bool_), np.empty(12)
    kernels.split_gains(
        table, rows, weights, distances, members, edges, centroids, totals, errors, 0.0, 0, 12, second, gains
    )
    for k in range(12):
        own = labels == k
        wanted = error(own) - error(own & second) - error(own & ~second)
        np.testing.assert_allclose(gains[k], wanted, rtol=1e-3, atol=1e-3)
    assert (gains[np.arange(12) != 5] > 0).all()


def test_relocation_pays_and_keeps_the_lists_in_order():
    """The error after every merge and split must be what costs and gains promise; a list holds a centroid once."""
    table, rows, weights, labels, members, edges = clustered()
    distances = np.ones(len(rows), np.float32)
    centroids, totals, errors = means_of(table, rows, weights, members, edges, distances)
    near = np.stack([np.append(k, np.delete(np.arange(12), k)) for k in range(12)]).astype(np.uint16)
    partners, costs = np.empty(12, np.int32), np.empty(12)
    kernels.merge_costs(centroids, totals, near, 0, 12, partners, costs)
    second, gains = np.zeros(len(rows), np.bool_), np.empty(12)
    kernels.split_gains(
        table, rows, weights, distances, members, edges, centroids, totals, errors, 0.0, 0, 12, second, gains
    )
    order = [np.argsort(a, kind="stable").astype(np.int32) for a in (costs, -gains)]
    changed = labels.copy()
    kernels.relocate(*order, partners, costs, gains, second, members, edges, changed, near)

    def total(clusters):
        return sum(
            error_of(table[rows[clusters == k]].astype(np.float64), weights[clusters == k]) for k in set(clusters)
        )

    assert set(changed) == set(range(12)), "the number of the empty cluster is used for a half of another"
    assert total(changed) < total(labels)
    assert (np.sort(near, axis=1) == np.arange(12)).all()
    assert (near[:, 0] == np.arange(12)).all()
