"""The hierarchical start of the k-means: cells, smaller cells, centroids, and the near ones of each centroid."""

from __future__ import annotations

import numpy as np

from kissgs.core.array_types import Float32, Float64, Int, Int32, UInt16
from kissgs.core.threads import Workers
from kissgs.planning.clustering import BLOCK, Clustering, Vectors, sorted_by_label

CELL_ITERATIONS = 4
START_ITERATIONS = 1
SAMPLES_PER_CENTROID = 64

CANDIDATES = 4
"""Centroids of nearby cells among which the nearest ones are found, in multiples of the number to be found."""


def start(
    data: Vectors, spread: float, size: int, *, seed: int, neighbors: int, tolerance: float, pool: Workers
) -> Clustering:
    """Return a hierarchical clustering: about K^(1/3) cells, each of them split likewise, and their centroids.

    Args:
        data: the vectors.
        spread: their root mean square distance from the mean, per dimension.
        size: K, largest number of centroids.
        seed: seed of all random choices.
        neighbors: number of near centroids of each centroid.
        tolerance: root mean square error per dimension below which a cluster is not split further.
        pool: threads.
    """
    rng = np.random.Generator(np.random.PCG64(seed))
    dimensions = data.table.shape[1]
    labels = np.zeros(len(data.rows), dtype=np.int32)
    counts, errors = np.array([len(labels)]), np.array([len(labels) * dimensions * spread**2])
    for number, iterations in (
        (round(size ** (1 / 3)), CELL_ITERATIONS),
        (round(size ** (2 / 3)), CELL_ITERATIONS),
        (size, START_ITERATIONS),
    ):
        shares = allocate(errors, counts, max(number, len(counts)), dimensions * tolerance**2)
        centroids, labels, distances = _split(data, labels, shares, iterations, rng, pool)
        counts = np.bincount(labels, minlength=len(centroids))
        errors = np.bincount(labels, distances * data.weights, minlength=len(centroids))
    near = near_centroids(centroids, np.concatenate([[0], np.cumsum(shares)]), neighbors, pool)
    members, edges = sorted_by_label(labels, len(centroids))
    state = Clustering(data, centroids, labels, distances, near, members, edges, np.zeros(len(centroids)), errors)
    state.update(pool)
    return state


def _split(
    data: Vectors,
    cells: Int32[np.ndarray, " N"],
    shares: Int[np.ndarray, " J"],
    iterations: int,
    rng: np.random.Generator,
    pool: Workers,
) -> tuple[Float32[np.ndarray, "K D"], Int32[np.ndarray, " N"], Float32[np.ndarray, " N"]]:
    """Cluster the vectors of every cell into its share of clusters.

    Returns:
        The centroids, cell by cell; the nearest centroid of its cell to each vector; and the squared distance to it.
    """
    members, edges = sorted_by_label(cells, len(shares))
    firsts = np.concatenate([[0], np.cumsum(shares)])
    seeds = rng.integers(0, 2**63, len(shares))
    centroids = np.empty((int(firsts[-1]), data.table.shape[1]), dtype=np.float32)
    labels, distances = np.empty(len(members), dtype=np.int32), np.empty(len(members), dtype=np.float32)

    def train(j: int) -> None:
        local = np.random.Generator(np.random.PCG64(int(seeds[j])))
        own = members[edges[j] : edges[j + 1]]
        centroids[firsts[j] : firsts[j + 1]] = _train(data, own, int(shares[j]), iterations, local)

    def label(task: tuple[int, int]) -> None:
        j, first = task
        own = members[first : min(first + BLOCK, edges[j + 1])]
        nearest, distances[own] = assign(data.take(own), centroids[firsts[j] : firsts[j + 1]])
        labels[own] = firsts[j] + nearest

    pool.map(train, np.flatnonzero(shares).tolist())
    pool.map(label, [(j, first) for j in range(len(shares)) for first in range(edges[j], edges[j + 1], BLOCK)])
    return centroids, labels, distances


def allocate(
    errors: Float64[np.ndarray, " J"], counts: Int[np.ndarray, " J"], size: int, tolerance: float
) -> Int[np.ndarray, " J"]:
    """Return the number of centroids of each coarse cluster: in proportion to sqrt(error × count), at most its vectors.

    A cluster gets at least one, and only one if its mean squared error is within ``tolerance``. The sum is at most
    ``size``.
    """
    limit = np.where(errors > tolerance * counts, counts, np.minimum(counts, 1))
    demand = np.sqrt(errors * counts)
    shares = np.minimum(counts, 1)
    left = size - int(shares.sum())
    # What clusters at their limit cannot use goes to the others; each pass gives out at least half of the remainder.
    while left > 0 and (open_ := (shares < limit) & (demand > 0)).any():
        portion = np.where(open_, demand, 0)
        extra = np.floor(portion / portion.sum() * left).astype(np.int64)
        if not extra.any():
            extra[np.argsort(-portion, kind="stable")[:left]] = 1
        extra = np.minimum(np.where(open_, extra, 0), limit - shares)
        shares += extra
        left -= int(extra.sum())
    return shares


def _train(
    data: Vectors, members: Int[np.ndarray, " M"], number: int, iterations: int, rng: np.random.Generator
) -> Float32[np.ndarray, "number D"]:
    """Return ``number`` centroids of a sample of some vectors, at least as many, by plain weighted k-means."""
    from kissgs.planning import kmeans_kernels as kernels

    if len(members) > SAMPLES_PER_CENTROID * number:
        members = members[rng.choice(len(members), SAMPLES_PER_CENTROID * number, replace=False)]
    some, weights = data.take(members), data.weights[members]
    probabilities = weights.astype(np.float64) / weights.sum(dtype=np.float64)
    centroids = some[rng.choice(len(some), number, replace=False, p=probabilities)]
    for _ in range(iterations):
        sums, totals = np.zeros(centroids.shape), np.zeros(number)
        kernels.weighted_sums(some, weights, assign(some, centroids)[0].astype(np.int32), sums, totals)
        filled = totals > 0
        centroids[filled] = sums[filled] / totals[filled, None]
    return centroids


def assign(
    vectors: Float32[np.ndarray, "N D"], centroids: Float32[np.ndarray, "K D"]
) -> tuple[Int[np.ndarray, " N"], Float32[np.ndarray, " N"]]:
    """Return the nearest centroid of every vector, by brute force, and the squared distance to it."""
    scores = vectors @ (centroids.T * np.float32(-2))
    scores += np.einsum("kd,kd->k", centroids, centroids)
    labels = scores.argmin(axis=1)
    distances = scores[np.arange(len(vectors)), labels] + np.einsum("nd,nd->n", vectors, vectors)
    return labels, np.maximum(distances, 0)


def near_centroids(
    centroids: Float32[np.ndarray, "K D"], firsts: Int[np.ndarray, " edges"], count: int, pool: Workers
) -> UInt16[np.ndarray, "K k"]:
    """Return for every centroid the nearest ones, itself first, of those in the nearest cells."""
    filled = np.flatnonzero(np.diff(firsts))
    firsts = np.append(firsts[filled], len(centroids))
    counts = np.diff(firsts)
    centres = (np.add.reduceat(centroids, firsts[:-1], axis=0) / counts[:, None]).astype(np.float32)
    near = np.empty((len(centroids), min(count, len(centroids))), dtype=np.uint16)

    def work(j: int) -> None:
        distances = np.square(centres - centres[j]).sum(axis=1)
        distances[j] = -1  # before cells of equal centre: the first names are those of the cell itself
        order = np.argsort(distances, kind="stable")
        order = order[: np.searchsorted(np.cumsum(counts[order]), CANDIDATES * count) + 1]
        names = np.concatenate([np.arange(firsts[c], firsts[c + 1], dtype=np.uint16) for c in order])
        some, own = centroids[names], slice(firsts[j], firsts[j + 1])
        scores = np.einsum("kd,kd->k", some, some) - 2 * (centroids[own] @ some.T)
        np.fill_diagonal(scores, -np.inf)
        near[own] = names[np.argpartition(scores, (0, near.shape[1] - 1), axis=1)[:, : near.shape[1]]]

    pool.map(work, range(len(counts)))
    return near
