"""Vectors in clusters, as the kernels of k-means take them."""

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


def means_of(table, rows, weights, members, edges, distances):
    centroids = np.full((len(edges) - 1, table.shape[1]), 9, np.float32)
    totals, errors = np.empty(len(centroids)), np.empty(len(centroids))
    kernels.means(table, rows, weights, distances, members, edges, 0, len(centroids), centroids, totals, errors)
    return centroids, totals, errors
