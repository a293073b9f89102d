"""Oracle: the error of a cluster in NumPy, in float64, from its definition."""

import numpy as np
from helpers.clusters import clustered, means_of

from kissgs.planning import kmeans_kernels as kernels


def error_of(vectors, weights):
    mean = np.average(vectors, axis=0, weights=weights)
    return (weights * np.square(vectors - mean).sum(axis=1)).sum()


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
