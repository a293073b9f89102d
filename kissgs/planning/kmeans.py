"""Weighted two-level k-means, refined across the borders of the coarse clusters.

Full k-means compares every vector with every centroid. Here vectors are first split among about sqrt(K) coarse
clusters; each gets centroids in proportion to sqrt(its error × its count) and is clustered separately; then vectors
may move to any centroid of the nearest coarse clusters, and centroids are updated, for several iterations. On real
scenes the error is within 2 % of full k-means at a fraction of the time.

Distances are matrix products on one BLAS thread per task, sums run in a fixed order in float64, and all random numbers
come from one seed: the result does not depend on the number of threads.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from kissgs.core.array_types import Float32, Float64, Int, Int32
from kissgs.core.threads import Workers
from kissgs.planning.quantize import clip_outliers

BLOCK = 1024
"""Vectors per matrix product: its result, against a few thousand centroids, stays in the processor's cache."""

COARSE_ITERATIONS = 6
SPLIT_ITERATIONS = 4
SAMPLES_PER_COARSE = 64
MAX_COARSE = 512

OUTLIERS = 1e-3
"""Share of entries, at either end of a dimension, that may be clipped so that the step of the others stays small."""


@dataclass(frozen=True, slots=True, kw_only=True)
class KMeansOptions:
    """Options of :func:`fit`.

    Attributes:
        seed: seed of all random choices.
        iterations: iterations of refinement across the borders of coarse clusters.
        nprobe: number of coarse clusters that are searched for a vector's centroid during refinement.
        tolerance: root mean square error per dimension below which a cluster is not split further.
        lattice: step that centroids are rounded to, in units of the codebook's root mean square error; vectors are
            then assigned to the rounded centroids. 0 does not round.
        from_zero: whether the lattice holds 0 in all dimensions, instead of each dimension's smallest value, and any
            number of its points may be used, instead of 255 per dimension.
    """

    seed: int
    iterations: int
    nprobe: int
    tolerance: float
    lattice: float
    from_zero: bool = False


@dataclass(frozen=True, slots=True)
class Clusters:
    """Result of a clustering.

    Attributes:
        centroids: ``(K, D)``.
        labels: ``(N,)`` centroid of each vector.
        step: step of the lattice that the centroids lie on; 0 for none.
    """

    centroids: Float32[np.ndarray, "K D"]
    labels: Int32[np.ndarray, " N"]
    step: float


def fit(
    vectors: Float32[np.ndarray, "N D"],
    weights: Float32[np.ndarray, " N"],
    size: int,
    pool: Workers,
    options: KMeansOptions,
    *,
    report: Callable[[float], None] = lambda fraction: None,
) -> Clusters:
    """Find at most ``size`` centroids of small weighted squared error.

    Args:
        vectors: finite, N at least 1.
        weights: positive weight of each vector's squared error.
        size: K, largest number of centroids.
        pool: threads.
        options: options of the clustering.
        report: receives the fraction done, 0 to 1.

    Returns:
        The clusters; fewer than ``size`` if the vectors are few, similar or repeated.
    """
    rng = np.random.Generator(np.random.PCG64(options.seed))
    tolerance, lattice = options.tolerance, options.lattice
    mean = np.average(vectors, axis=0, weights=weights).astype(np.float32)
    if _rms(vectors, mean) <= tolerance:
        return Clusters(mean[None], np.zeros(len(vectors), dtype=np.int32), 0.0)
    if len(vectors) <= size:
        unique, labels = np.unique(vectors, axis=0, return_inverse=True)
        step = _round_to_lattice(unique, 0.0, options) if lattice else 0.0
        return Clusters(unique, labels.reshape(-1).astype(np.int32), step)

    coarse, owners, errors = _coarse(vectors, weights, size, rng, pool)
    report(0.2)
    order = np.argsort(owners, kind="stable")
    counts = np.bincount(owners, minlength=len(coarse))
    vectors, weights = vectors[order], weights[order]
    shares = _allocate(errors, counts, size, len(vectors[0]) * tolerance**2)
    tree = _Tree(coarse, _edges(counts), _edges(shares))
    centroids, labels = _split(vectors, weights, tree, rng, pool)
    report(0.4)
    near = tree.neighbours(options.nprobe)
    for step in range(options.iterations):
        _update(centroids, vectors, weights, labels)
        distances = _reassign(vectors, centroids, labels, tree, near, pool)
        _reseed_empty(centroids, vectors, weights * distances, labels)
        report(0.4 + 0.6 * (step + 1) / options.iterations)
    _update(centroids, vectors, weights, labels)
    step = 0.0
    if lattice:
        error = np.average(distances, weights=weights) / vectors.shape[1]
        step = _round_to_lattice(centroids, lattice * float(error) ** 0.5, options)
        _reassign(vectors, centroids, labels, tree, near, pool)

    used, compact = np.unique(labels, return_inverse=True)
    unsorted = np.empty(len(labels), dtype=np.int32)
    unsorted[order] = compact.reshape(-1)
    return Clusters(centroids[used], unsorted, step)


def assign(
    vectors: Float32[np.ndarray, "N D"], centroids: Float32[np.ndarray, "K D"]
) -> tuple[Int[np.ndarray, " N"], Float32[np.ndarray, " N"]]:
    """Return the nearest centroid of every vector, by brute force, and the squared distance to it."""
    labels = np.empty(len(vectors), dtype=np.int64)
    distances = np.empty(len(vectors), dtype=np.float32)
    norms = np.einsum("kd,kd->k", centroids, centroids)
    minus_two = np.ascontiguousarray(centroids.T) * np.float32(-2)
    for first in range(0, len(vectors), BLOCK):
        block = vectors[first : first + BLOCK]
        partial = block @ minus_two
        partial += norms
        best = partial.argmin(axis=1)
        labels[first : first + BLOCK] = best
        distances[first : first + BLOCK] = partial[np.arange(len(block)), best]
    distances += np.einsum("nd,nd->n", vectors, vectors)
    return labels, np.maximum(distances, 0, out=distances)


@dataclass(frozen=True, slots=True)
class _Tree:
    """Coarse clusters, and the ranges of the sorted vectors and of the centroids in each."""

    coarse: Float32[np.ndarray, "J D"]
    vector_edges: Int[np.ndarray, " edges"]
    centroid_edges: Int[np.ndarray, " edges"]

    def vectors_of(self, j: int) -> slice:
        return slice(int(self.vector_edges[j]), int(self.vector_edges[j + 1]))

    def centroids_of(self, j: int) -> slice:
        return slice(int(self.centroid_edges[j]), int(self.centroid_edges[j + 1]))

    def neighbours(self, nprobe: int) -> list[Int[np.ndarray, " _"]]:
        """Return for every coarse cluster the centroids of the ``nprobe`` nearest coarse clusters, itself first."""
        norms = np.einsum("jd,jd->j", self.coarse, self.coarse)
        distances = norms - 2 * (self.coarse @ self.coarse.T)
        nearest = np.argsort(distances, axis=1, kind="stable")[:, :nprobe]
        every = np.arange(self.centroid_edges[-1])
        return [np.concatenate([every[self.centroids_of(int(j))] for j in row]) for row in nearest]


def _coarse(
    vectors: np.ndarray, weights: np.ndarray, size: int, rng: np.random.Generator, pool: Workers
) -> tuple[Float32[np.ndarray, "J D"], Int[np.ndarray, " N"], Float64[np.ndarray, " J"]]:
    """Return about sqrt(K) clusters of a sample, the cluster of every vector, and each cluster's weighted error."""
    number = min(round(1.2 * size**0.5), MAX_COARSE)
    sample = rng.choice(len(vectors), min(len(vectors), SAMPLES_PER_COARSE * number), replace=False)
    some, some_weights = vectors[sample], weights[sample]
    probabilities = some_weights.astype(np.float64) / some_weights.sum(dtype=np.float64)
    coarse = some[rng.choice(len(some), number, replace=False, p=probabilities)]
    for _ in range(COARSE_ITERATIONS):
        labels, _ = assign(some, coarse)
        _update(coarse, some, some_weights, labels.astype(np.int32))
    step = 16 * BLOCK
    parts = pool.map(lambda first: assign(vectors[first : first + step], coarse), range(0, len(vectors), step))
    owners = np.concatenate([labels for labels, _ in parts])
    distances = np.concatenate([distances for _, distances in parts])
    return coarse, owners, np.bincount(owners, weights=distances * weights, minlength=number)


def _allocate(
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


def _split(
    vectors: np.ndarray, weights: np.ndarray, tree: _Tree, rng: np.random.Generator, pool: Workers
) -> tuple[Float32[np.ndarray, "K D"], Int32[np.ndarray, " N"]]:
    """Cluster the vectors of every coarse cluster separately."""
    centroids = np.empty((int(tree.centroid_edges[-1]), vectors.shape[1]), dtype=np.float32)
    labels = np.empty(len(vectors), dtype=np.int32)
    seeds = rng.integers(0, 2**63, len(tree.coarse))

    def work(j: int) -> None:
        rows, own = tree.vectors_of(j), tree.centroids_of(j)
        some, some_weights, number = vectors[rows], weights[rows], own.stop - own.start
        if number == 0:
            return
        probabilities = some_weights.astype(np.float64) / some_weights.sum(dtype=np.float64)
        start = np.random.Generator(np.random.PCG64(int(seeds[j]))).choice(
            len(some), number, replace=False, p=probabilities
        )
        local = some[start]
        for _ in range(SPLIT_ITERATIONS):
            _update(local, some, some_weights, assign(some, local)[0].astype(np.int32))
        centroids[own] = local
        labels[rows] = assign(some, local)[0] + own.start

    pool.map(work, range(len(tree.coarse)))
    return centroids, labels


def _reassign(
    vectors: np.ndarray,
    centroids: np.ndarray,
    labels: np.ndarray,
    tree: _Tree,
    near: list[Int[np.ndarray, " _"]],
    pool: Workers,
) -> Float32[np.ndarray, " N"]:
    """Assign every vector to the nearest centroid around its coarse cluster; modify ``labels``, return distances."""
    distances = np.zeros(len(vectors), dtype=np.float32)

    def work(j: int) -> None:
        rows = tree.vectors_of(j)
        if rows.start < rows.stop:
            best, distances[rows] = assign(vectors[rows], centroids[near[j]])
            labels[rows] = near[j][best]

    pool.map(work, range(len(tree.coarse)))
    return distances


def _update(centroids: np.ndarray, vectors: np.ndarray, weights: np.ndarray, labels: np.ndarray) -> None:
    """Move every centroid to the weighted mean of its vectors; one without vectors stays."""
    from kissgs.planning import kernels

    sums = np.zeros(centroids.shape)
    totals = np.zeros(len(centroids))
    kernels.weighted_sums(vectors, weights, labels, sums, totals)
    filled = totals > 0
    centroids[filled] = sums[filled] / totals[filled, None]


def _reseed_empty(centroids: np.ndarray, vectors: np.ndarray, errors: np.ndarray, labels: np.ndarray) -> None:
    """Move centroids without vectors to the vectors of largest weighted error."""
    empty = np.flatnonzero(np.bincount(labels, minlength=len(centroids)) == 0)
    worst = np.argsort(-errors, kind="stable")[: len(empty)]
    centroids[empty] = vectors[worst]
    labels[worst] = empty


def _round_to_lattice(centroids: np.ndarray, step: float, options: KMeansOptions) -> float:
    """Round in place to whole steps from each dimension's smallest value; a constant dimension keeps its value.

    Returns:
        The step: ``step``, or the one that 256 levels or the tolerance need if that is larger.
    """
    tolerance = options.tolerance
    step = max(step, 2 * tolerance)
    if options.from_zero:
        if step > 0:
            centroids[:] = np.rint(centroids.astype(np.float64) / step) * step
        return step
    # An exact codebook, of few vectors, has no error that outliers could be compared with.
    wide = (clip_outliers(centroids, step=step, share=OUTLIERS) if step > 2 * tolerance else centroids).astype(
        np.float64
    )
    low = wide.min(axis=0)
    step = max(step, float((wide - low).max()) / 254)
    if step > 0:
        centroids[:] = low + np.rint((wide - low) / step) * step
    return step


def _edges(counts: Int[np.ndarray, " J"]) -> Int[np.ndarray, " edges"]:
    return np.concatenate([[0], np.cumsum(counts)])


def _rms(vectors: np.ndarray, mean: np.ndarray) -> float:
    total = sum(
        float(np.square(vectors[first : first + BLOCK] - mean, dtype=np.float64).sum())
        for first in range(0, len(vectors), BLOCK)
    )
    return float(np.sqrt(total / vectors.size))
