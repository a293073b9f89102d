"""Weighted k-means of many vectors with many centroids, in time proportional to the vectors.

Comparing every vector with every centroid takes too long for a million vectors and 65,536 centroids. Three methods
from the literature replace it:

- The start is hierarchical: vectors are split among cells, cells among smaller cells, and each of these gets centroids
  in proportion to sqrt(its error × its count).
- A vector then moves only to one of the centroids nearest to its present one (k²-means: Agustsson, Timofte and Van
  Gool, CVPR 2017). The lists of near centroids are made once, from the cells, and repaired where centroids move far.
- Between two such iterations, pairs of similar clusters are merged and spread-out clusters are split, as long as that
  lowers the error (iterative splitting and merging: Kaukoranta, Fränti and Nevalainen, Optical Engineering 37, 1998).
  Plain k-means cannot move a centroid from where it is useless to where it is needed; with this step the error ends
  below that of an exhaustive search.

Vectors are read where they are, by their index; beside them the clustering needs some 20 bytes for each and some 800
for each centroid. Sums run in a fixed order in float64, each cluster belongs to one task, and all random numbers come
from one seed: the result does not depend on the number of threads.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from kissgs.core.array_types import Float32, Float64, Int, Int32
from kissgs.core.threads import Workers
from kissgs.planning.quantize import clip_outliers

BLOCK = 1024
"""Vectors per matrix product: its result, against some hundred centroids, stays in the processor's cache."""

CELL_ITERATIONS = 4
START_ITERATIONS = 1
SAMPLES_PER_CENTROID = 64
TASKS = 64
"""Number of tasks of an iteration: more than threads, since others may use the processor too."""

CANDIDATES = 8
"""Centroids of nearby cells among which the nearest ones are found, in multiples of the number to be found."""

OUTLIERS = 1e-3
"""Share of entries, at either end of a dimension, that may be clipped so that the step of the others stays small."""


@dataclass(frozen=True, slots=True, kw_only=True)
class KMeansOptions:
    """Options of :func:`fit`.

    Attributes:
        seed: seed of all random choices.
        iterations: iterations after the hierarchical start.
        neighbors: number of centroids, the nearest to a vector's present one, that are compared in an iteration.
        tolerance: root mean square error per dimension below which a cluster is not split further.
        lattice: step that centroids are rounded to, in units of the codebook's root mean square error; vectors are
            then assigned to the rounded centroids. 0 does not round.
        from_zero: whether the lattice holds 0 in all dimensions, instead of each dimension's smallest value, and any
            number of its points may be used, instead of 255 per dimension.
    """

    seed: int
    iterations: int
    neighbors: int
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
    table: Float32[np.ndarray, "R D"],
    rows: Int[np.ndarray, " N"],
    weights: Float32[np.ndarray, " N"],
    size: int,
    pool: Workers,
    options: KMeansOptions,
    *,
    report: Callable[[float], None] = lambda fraction: None,
) -> Clusters:
    """Find at most ``size`` centroids of small weighted squared error.

    Args:
        table: finite vectors, of which some are clustered.
        rows: their rows in the table, N at least 1.
        weights: positive weight of each vector's squared error.
        size: K, largest number of centroids.
        pool: threads.
        options: options of the clustering.
        report: receives the fraction done, 0 to 1.

    Returns:
        The clusters; fewer than ``size`` if the vectors are few, similar or repeated.
    """
    # The kernels take contiguous, writeable arrays only, although they do not write to these.
    data = _Data(
        np.require(table, requirements=("C", "W")),
        np.require(rows, np.int64, requirements=("C", "W")),
        np.require(weights, requirements=("C", "W")),
    )
    mean, spread = data.mean_and_rms(pool)
    if spread <= options.tolerance:
        return Clusters(mean[None], np.zeros(len(rows), dtype=np.int32), 0.0)
    if len(rows) <= size:
        unique, exact = np.unique(data.table[data.rows], axis=0, return_inverse=True)
        step = _round_to_lattice(unique, 0.0, options) if options.lattice else 0.0
        return Clusters(unique, exact.reshape(-1).astype(np.int32), step)

    state = _start(data, spread, size, options, pool)
    report(0.4)
    for iteration in range(options.iterations):
        state.relocate(pool)
        state.update(pool)
        state.reassign(pool)
        state.update(pool)
        report(0.4 + 0.6 * (iteration + 1) / options.iterations)
    step = 0.0
    if options.lattice:
        error = np.average(state.distances, weights=weights) / table.shape[1]
        step = _round_to_lattice(state.centroids, options.lattice * float(error) ** 0.5, options)
        state.reassign(pool)
    used, compact = np.unique(state.labels, return_inverse=True)
    return Clusters(state.centroids[used], compact.reshape(-1).astype(np.int32), step)


@dataclass(frozen=True, slots=True, eq=False)
class _Data:
    """The vectors to cluster, as rows of a table, and their weights."""

    table: Float32[np.ndarray, "R D"]
    rows: Int[np.ndarray, " N"]
    weights: Float32[np.ndarray, " N"]

    def take(self, members: Int[np.ndarray, " M"]) -> Float32[np.ndarray, "M D"]:
        return self.table[self.rows[members]]

    def mean_and_rms(self, pool: Workers) -> tuple[Float32[np.ndarray, " D"], float]:
        """Return the weighted mean, and the weighted root mean square distance to it per dimension."""
        start = self.table[self.rows[0]]

        def moments(first: int) -> Float64[np.ndarray, "2 D"]:
            block = slice(first, first + BLOCK)
            steps = self.table[self.rows[block]] - start
            return np.stack([self.weights[block] @ steps, self.weights[block] @ np.square(steps)]).astype(np.float64)

        first, second = sum(pool.map(moments, range(0, len(self.rows), BLOCK))) / self.weights.sum(dtype=np.float64)
        return (start + first).astype(np.float32), float(np.maximum(second - np.square(first), 0).mean()) ** 0.5


@dataclass(slots=True, eq=False)
class _State:
    """A clustering that is being improved.

    Attributes:
        data: the vectors.
        centroids: ``(K, D)``.
        labels: ``(N,)`` centroid of each vector.
        distances: ``(N,)`` squared distance of each vector to its centroid when it was last assigned.
        near: ``(K, k)`` near centroids of each centroid, itself first.
        members: ``(N,)`` vectors sorted by label.
        edges: ``(K + 1,)`` where each cluster's members begin.
        totals: ``(K,)`` sum of the weights of each cluster.
        errors: ``(K,)`` weighted error of each cluster when its vectors were last assigned.
    """

    data: _Data
    centroids: Float32[np.ndarray, "K D"]
    labels: Int32[np.ndarray, " N"]
    distances: Float32[np.ndarray, " N"]
    near: Int32[np.ndarray, "K k"]
    members: Int32[np.ndarray, " N"]
    edges: Int[np.ndarray, " edges"]
    totals: Float64[np.ndarray, " K"]
    errors: Float64[np.ndarray, " K"]

    def update(self, pool: Workers) -> None:
        """Move every centroid to the weighted mean of its vectors; one without vectors stays."""
        from kissgs.planning import kmeans_kernels as kernels

        data = self.data
        self.members, self.edges = _sorted_by(self.labels, len(self.centroids))
        pool.map(
            lambda part: kernels.means(
                data.table,
                data.rows,
                data.weights,
                self.distances,
                self.members,
                self.edges,
                *part,
                self.centroids,
                self.totals,
                self.errors,
            ),
            self._parts(),
        )

    def reassign(self, pool: Workers) -> None:
        """Assign every vector to the nearest of the centroids near its present one."""
        from kissgs.planning import kmeans_kernels as kernels

        data = self.data
        pool.map(
            lambda part: kernels.assign_near(
                data.table,
                data.rows,
                self.members,
                self.edges,
                self.centroids,
                self.near,
                *part,
                self.labels,
                self.distances,
            ),
            self._parts(),
        )

    def relocate(self, pool: Workers) -> None:
        """Merge pairs of clusters and split others as long as the error shrinks, each cluster once at most.

        Only labels and lists of near centroids change; :meth:`update` then finds the centroids.
        """
        from kissgs.planning import kmeans_kernels as kernels

        data, count = self.data, len(self.centroids)
        partners, costs, gains = np.empty(count, np.int32), np.empty(count), np.zeros(count)
        second = np.zeros(len(self.labels), dtype=np.bool_)

        most = max(count // 2, 1)
        least = np.partition(self.errors, count - most)[count - most]

        def work(part: tuple[int, int]) -> None:
            kernels.merge_costs(self.centroids, self.totals, self.near, *part, partners, costs)
            kernels.split_gains(
                data.table,
                data.rows,
                data.weights,
                self.distances,
                self.members,
                self.edges,
                self.centroids,
                self.totals,
                self.errors,
                least,
                *part,
                second,
                gains,
            )

        pool.map(work, self._parts())
        merged = np.argsort(costs, kind="stable")[:most].astype(np.int32)
        split = np.argsort(-gains, kind="stable")[:most].astype(np.int32)
        kernels.relocate(
            merged, split, partners, costs, gains, second, self.members, self.edges, self.labels, self.near
        )

    def _parts(self) -> list[tuple[int, int]]:
        """Return ranges of clusters with about equal numbers of vectors."""
        wanted = np.linspace(0, self.edges[-1], TASKS + 1)
        cuts = np.unique(np.concatenate([[0], np.searchsorted(self.edges, wanted[1:-1]), [len(self.edges) - 1]]))
        return [(int(a), int(b)) for a, b in pairwise(cuts)]


def _start(data: _Data, spread: float, size: int, options: KMeansOptions, pool: Workers) -> _State:
    """Return a hierarchical clustering: about K^(1/3) cells, each of them split likewise, and their centroids.

    ``spread`` is the root mean square distance from the mean, per dimension.
    """
    rng = np.random.Generator(np.random.PCG64(options.seed))
    dimensions, tolerance = data.table.shape[1], data.table.shape[1] * options.tolerance**2
    labels = np.zeros(len(data.rows), dtype=np.int32)
    counts, errors = np.array([len(labels)]), np.array([len(labels) * dimensions * spread**2])
    for number, iterations in (
        (round(size ** (1 / 3)), CELL_ITERATIONS),
        (round(size ** (2 / 3)), CELL_ITERATIONS),
        (size, START_ITERATIONS),
    ):
        shares = _allocate(errors, counts, max(number, len(counts)), tolerance)
        centroids, labels, distances = _split(data, labels, shares, iterations, rng, pool)
        counts = np.bincount(labels, minlength=len(centroids))
        errors = np.bincount(labels, distances * data.weights, minlength=len(centroids))
    near = _near(centroids, np.concatenate([[0], np.cumsum(shares)]), options.neighbors, pool)
    members, edges = _sorted_by(labels, len(centroids))
    state = _State(data, centroids, labels, distances, near, members, edges, np.zeros(len(centroids)), errors)
    state.update(pool)
    return state


def _split(
    data: _Data,
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
    members, edges = _sorted_by(cells, len(shares))
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


def _train(
    data: _Data, members: Int[np.ndarray, " M"], number: int, iterations: int, rng: np.random.Generator
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


def _near(
    centroids: Float32[np.ndarray, "K D"], firsts: Int[np.ndarray, " edges"], count: int, pool: Workers
) -> Int32[np.ndarray, "K k"]:
    """Return for every centroid the nearest ones, itself first, of those in the nearest cells."""
    filled = np.flatnonzero(np.diff(firsts))
    firsts = np.append(firsts[filled], len(centroids))
    counts = np.diff(firsts)
    centres = (np.add.reduceat(centroids, firsts[:-1], axis=0) / counts[:, None]).astype(np.float32)
    near = np.empty((len(centroids), min(count, len(centroids))), dtype=np.int32)

    def work(j: int) -> None:
        order = np.argsort(np.square(centres - centres[j]).sum(axis=1), kind="stable")
        order = order[: np.searchsorted(np.cumsum(counts[order]), CANDIDATES * count) + 1]
        names = np.concatenate([np.arange(firsts[c], firsts[c + 1], dtype=np.int32) for c in order])
        some, own = centroids[names], slice(firsts[j], firsts[j + 1])
        scores = np.einsum("kd,kd->k", some, some) - 2 * (centroids[own] @ some.T)
        np.fill_diagonal(scores, -np.inf)
        near[own] = names[np.argpartition(scores, (0, near.shape[1] - 1), axis=1)[:, : near.shape[1]]]

    pool.map(work, range(len(counts)))
    return near


def _sorted_by(
    labels: Int32[np.ndarray, " N"], count: int
) -> tuple[Int32[np.ndarray, " N"], Int[np.ndarray, " edges"]]:
    """Return the numbers of the vectors sorted by label, and where those of each label begin."""
    from kissgs.planning import kmeans_kernels as kernels

    edges = np.concatenate([[0], np.cumsum(np.bincount(labels, minlength=count))])
    members = np.empty(len(labels), dtype=np.int32)
    kernels.sort_by_label(labels, edges[:-1].copy(), members)
    return members, edges


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
