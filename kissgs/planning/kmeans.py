"""Weighted k-means of many vectors with many centroids, in time proportional to the vectors."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise
from typing import Protocol, runtime_checkable

import numpy as np

from kissgs.core.array_types import Float32, Float64, Int, Int32, UInt16
from kissgs.core.context import Workers
from kissgs.core.splats import blocks
from kissgs.planning.quantize import clip_outliers, for_each_block
from kissgs.settings import EncodeSettings

# Comparing every vector with every centroid takes too long for a million vectors and 65,536 centroids. Three methods
# from the literature replace it:
#
# - The start is hierarchical: vectors are split among cells, cells among smaller cells, and each of these gets
#   centroids in proportion to sqrt(its error × its count).
# - A vector then moves only to one of the centroids nearest to its present one (k²-means: Agustsson, Timofte and Van
#   Gool, CVPR 2017). The lists of near centroids are made from the cells, and searched again as the centroids move.
# - Between two such iterations, pairs of similar clusters are merged and spread-out clusters are split, as long as that
#   lowers the error (iterative splitting and merging: Kaukoranta, Fränti and Nevalainen, Optical Engineering 37, 1998).
#   Plain k-means cannot move a centroid from where it is useless to where it is needed; with this step the error ends
#   below that of an exhaustive search.
#
# Vectors are read where they are, by their index; beside them the clustering needs some 20 bytes for each and some 600
# for each centroid. Sums run in a fixed order in float64, each cluster belongs to one task, and all random numbers come
# from one seed: the result does not depend on the number of threads.

BLOCK = 1024  # vectors per matrix product: its result, against some hundred centroids, stays in the processor's cache
SEARCHED = 4  # number of near centroids of a centroid whose own near ones are searched for nearer ones
PARTNERS = 24  # number of near centroids, the nearest, with whose clusters a cluster may merge
TASKS = 64  # number of tasks of an iteration: more than threads, since others may use the processor too


@dataclass(frozen=True, slots=True, eq=False)
class Vectors:
    """The vectors to cluster, as rows of a table, and their weights."""

    table: Float32[np.ndarray, "R D"]
    rows: Int[np.ndarray, " N"]
    weights: Float32[np.ndarray, " N"]

    def take(self, members: Int[np.ndarray, " M"]) -> Float32[np.ndarray, "M D"]:
        """Return a copy of some of the vectors."""
        return self.table[self.rows[members]]

    def mean_and_rms(self, pool: Workers) -> tuple[Float32[np.ndarray, " D"], float]:
        """Return the weighted mean, and the weighted root mean square distance to it per dimension."""
        start = self.table[self.rows[0]]

        def moments(block: slice) -> Float64[np.ndarray, "2 D"]:
            steps, weights = self.table[self.rows[block]].astype(np.float64) - start, self.weights[block]
            return np.stack([weights @ steps, weights @ np.square(steps)])

        first, second = sum(pool.map(moments, blocks(len(self.rows), BLOCK))) / self.weights.sum(dtype=np.float64)
        return (start + first).astype(np.float32), float(np.maximum(second - np.square(first), 0).mean()) ** 0.5


@dataclass(slots=True, eq=False)
class Clustering:
    """A clustering that is being improved."""

    data: Vectors
    centroids: Float32[np.ndarray, "K D"]
    labels: Int32[np.ndarray, " N"]  # centroid of each vector
    distances: Float32[np.ndarray, " N"]  # squared distance of each vector to its centroid when it was last assigned
    near: UInt16[np.ndarray, "K k"]  # near centroids of each centroid, itself first
    members: Int32[np.ndarray, " N"]  # vectors sorted by label
    edges: Int[np.ndarray, " edges"]  # where each cluster's members begin
    totals: Float64[np.ndarray, " K"]  # sum of the weights of each cluster
    errors: Float64[np.ndarray, " K"]  # weighted error of each cluster when its vectors were last assigned

    def update(self, pool: Workers) -> None:
        """Move every centroid to the weighted mean of its vectors; one without vectors stays."""
        from kissgs.planning import kmeans_kernels as kernels

        self.sort_members()
        arrays = self._arrays()
        pool.map(lambda part: kernels.means(*arrays, *part, self.centroids, self.totals, self.errors), self.parts())

    def sort_members(self) -> None:
        """Sort the vectors by label again, after labels have changed."""
        self.members, self.edges = sorted_by_label(self.labels, len(self.centroids))

    def reassign(self, pool: Workers) -> None:
        """Assign every vector to the nearest of the centroids near its present one."""
        from kissgs.planning import kmeans_kernels as kernels

        arrays = self.data.table, self.data.rows, self.members, self.edges, self.centroids, self.near
        pool.map(lambda part: kernels.assign_near(*arrays, *part, self.labels, self.distances), self.parts())

    def refresh_near(self, pool: Workers) -> None:
        """Find the near centroids again, which have moved, among the near ones of the nearest so far."""
        from kissgs.planning import kmeans_kernels as kernels

        found = np.empty_like(self.near)
        pool.map(lambda part: kernels.find_near(self.centroids, self.near, SEARCHED, *part, found), self.parts())
        self.near = found

    def relocate(self, pool: Workers) -> None:
        """Merge pairs of clusters and split others as long as the error shrinks, each cluster once at most. Only labels
        and lists of near centroids change; :meth:`update` then finds the centroids."""
        from kissgs.planning import kmeans_kernels as kernels

        arrays, count = self._arrays(), len(self.centroids)
        nearest = np.ascontiguousarray(self.near[:, :PARTNERS])
        partners, costs, gains = np.empty(count, np.int32), np.empty(count), np.zeros(count)
        second = np.zeros(len(self.labels), dtype=np.bool_)

        most = max(count // 2, 1)
        least = np.partition(self.errors, count - most)[count - most]

        def work(part: tuple[int, int]) -> None:
            kernels.merge_costs(self.centroids, self.totals, nearest, *part, partners, costs)
            kernels.split_gains(*arrays, self.centroids, self.totals, self.errors, least, *part, second, gains)

        pool.map(work, self.parts())
        merged = np.argsort(costs, kind="stable")[:most].astype(np.int32)
        split = np.argsort(-gains, kind="stable")[:most].astype(np.int32)
        kernels.relocate(
            merged, split, partners, costs, gains, second, self.members, self.edges, self.labels, self.near
        )

    def _arrays(self) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Return the vectors, their distances, and the members of each cluster, as kernels take them."""
        data = self.data
        return data.table, data.rows, data.weights, self.distances, self.members, self.edges

    def parts(self) -> list[tuple[int, int]]:
        """Return ranges of clusters with about equal numbers of vectors."""
        wanted = np.linspace(0, self.edges[-1], TASKS + 1)
        cuts = np.unique(np.concatenate([[0], np.searchsorted(self.edges, wanted[1:-1]), [len(self.edges) - 1]]))
        return [(int(a), int(b)) for a, b in pairwise(cuts)]


@runtime_checkable
class Metric(Protocol):
    """Errors by which vectors are compared, instead of squared distances."""

    def reassign(self, state: Clustering, pool: Workers) -> None:
        """Assign every vector to the one of the centroids near its present one at which its error is smallest."""

    def move_centroids(self, state: Clustering, pool: Workers) -> None:
        """Move every centroid to where its vectors' error is smallest; one without vectors stays."""


def sorted_by_label(
    labels: Int32[np.ndarray, " N"], count: int
) -> tuple[Int32[np.ndarray, " N"], Int[np.ndarray, " edges"]]:
    """Return the numbers of the vectors sorted by label, and where those of each label begin."""
    from kissgs.planning import kmeans_kernels as kernels

    edges = np.concatenate([[0], np.cumsum(np.bincount(labels, minlength=count))])
    members = np.empty(len(labels), dtype=np.int32)
    kernels.sort_by_label(labels, edges[:-1].copy(), members)
    return members, edges


# The hierarchical start of the k-means: cells, smaller cells, centroids, and the near ones of each centroid.

CELL_ITERATIONS = 4
START_ITERATIONS = 1
SAMPLES_PER_CENTROID = 64

CANDIDATES = 4  # centroids of nearby cells that are compared, in multiples of those to be found


def start(data: Vectors, spread: float, size: int, settings: EncodeSettings, pool: Workers) -> Clustering:
    """Return a hierarchical clustering: about K^(1/3) cells, each of them split likewise, and their centroids."""
    rng = np.random.Generator(np.random.PCG64(settings.seed))
    dimensions = data.table.shape[1]
    labels = np.zeros(len(data.rows), dtype=np.int32)
    counts, errors = np.array([len(labels)]), np.array([len(labels) * dimensions * spread**2])
    for number, iterations in (
        (round(size ** (1 / 3)), CELL_ITERATIONS),
        (round(size ** (2 / 3)), CELL_ITERATIONS),
        (size, START_ITERATIONS),
    ):
        shares = allocate(errors, counts, max(number, len(counts)), dimensions * settings.sh_tolerance**2)
        centroids, labels, distances = _split(data, labels, shares, iterations, rng, pool)
        counts = np.bincount(labels, minlength=len(centroids))
        errors = np.bincount(labels, distances * data.weights, minlength=len(centroids))
    near = near_centroids(centroids, np.concatenate([[0], np.cumsum(shares)]), settings.sh_neighbors, pool)
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
    """Cluster the vectors of every cell into its share of clusters."""
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
    ``size``."""
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
    rows, totals, errors = np.arange(len(some)), np.empty(number), np.empty(number)
    for _ in range(iterations):
        labels, distances = assign(some, centroids)
        members, edges = sorted_by_label(labels.astype(np.int32), number)
        kernels.means(some, rows, weights, distances, members, edges, 0, number, centroids, totals, errors)
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


METRIC_ITERATIONS = 3  # iterations under a metric, after those of the Euclidean distance
OUTLIERS = 1e-3  # share of entries at either end of a dimension that may be clipped, for a smaller step


@dataclass(frozen=True, slots=True)
class Clusters:
    """Result of a clustering."""

    centroids: Float32[np.ndarray, "K D"]
    labels: Int32[np.ndarray, " N"]  # centroid of each vector
    step: float  # step of the lattice that the centroids lie on; 0 for none


def fit(
    table: Float32[np.ndarray, "R D"],
    rows: Int[np.ndarray, " N"],
    weights: Float32[np.ndarray, " N"],
    size: int,
    settings: EncodeSettings,
    pool: Workers,
    *,
    lattice: float,
    from_zero: bool = False,
    metric: Metric | None = None,
    report: Callable[[float], None] = lambda fraction: None,
) -> Clusters:
    """Find at most ``size`` centroids of small weighted squared error. They are rounded to steps of ``lattice`` times
    their root mean square error, 0 for none; see :func:`_round_to_lattice` for ``from_zero``."""
    # The kernels take contiguous, writeable arrays only, although they do not write to these.
    data = Vectors(
        np.require(table, requirements=("C", "W")),
        np.require(rows, np.int64, requirements=("C", "W")),
        np.require(weights, requirements=("C", "W")),
    )
    mean, spread = data.mean_and_rms(pool)
    if spread <= settings.sh_tolerance:
        return Clusters(mean[None], np.zeros(len(rows), dtype=np.int32), 0.0)
    if len(rows) <= size:
        unique, exact = np.unique(data.table[data.rows], axis=0, return_inverse=True)
        step = _round_to_lattice(unique, 0.0, settings.sh_tolerance, from_zero) if lattice else 0.0
        return Clusters(unique, exact.reshape(-1).astype(np.int32), step)

    state = start(data, spread, size, settings, pool)
    report(0.4)
    iterations = settings.sh_kmeans_iterations
    all_iterations = iterations + (0 if metric is None else METRIC_ITERATIONS)
    for iteration in range(iterations):
        if iteration:  # the start has just made the lists
            state.refresh_near(pool)
        state.relocate(pool)
        state.update(pool)
        state.reassign(pool)
        state.update(pool)
        report(0.4 + 0.6 * (iteration + 1) / all_iterations)
    if metric is not None:
        for iteration in range(iterations, all_iterations):
            state.refresh_near(pool)
            metric.reassign(state, pool)
            metric.move_centroids(state, pool)
            report(0.4 + 0.6 * (iteration + 1) / all_iterations)
    step = 0.0
    if lattice:
        step = lattice * _mean_square_error(state, metric, pool) ** 0.5
        step = _round_to_lattice(state.centroids, step, settings.sh_tolerance, from_zero)
        if metric is None:
            state.reassign(pool)
        else:
            metric.reassign(state, pool)
    used = np.bincount(state.labels, minlength=len(state.centroids)) > 0
    compact = np.cumsum(used, dtype=np.int32) - np.int32(1)
    return Clusters(state.centroids[used], compact[state.labels], step)


def _mean_square_error(state: Clustering, metric: Metric | None, pool: Workers) -> float:
    """Return the weighted mean square distance of the vectors to their centroids, per dimension."""
    data = state.data
    if metric is None:  # as they were last assigned
        return float(np.average(state.distances, weights=data.weights) / data.table.shape[1])

    def squares(rows: slice) -> float:
        lost = data.table[data.rows[rows]] - state.centroids[state.labels[rows]]
        return float(np.square(lost).sum(axis=1, dtype=np.float64) @ data.weights[rows])

    total = sum(for_each_block(len(data.rows), squares, pool))
    return float(total / data.weights.sum(dtype=np.float64) / data.table.shape[1])


def _round_to_lattice(centroids: np.ndarray, step: float, tolerance: float, from_zero: bool) -> float:
    """Round in place to multiples of the step that is returned, counted from 0 or from each dimension's smallest value.
    In the latter case a constant dimension keeps its value, and there are at most 255 steps."""
    low = np.zeros(centroids.shape[1])
    step = max(step, 2 * tolerance)
    if not from_zero:
        # An exact codebook, of few vectors, has no error that outliers could be compared with.
        if step > 2 * tolerance:
            centroids[:] = clip_outliers(centroids, step=step, share=OUTLIERS)
        low = centroids.min(axis=0).astype(np.float64)
        step = max(step, float((centroids.max(axis=0) - low).max()) / 254)

    def round_rows(rows: slice) -> None:
        centroids[rows] = low + np.rint((centroids[rows] - low) / step) * step

    if step > 0:
        for_each_block(len(centroids), round_rows)
    return step
