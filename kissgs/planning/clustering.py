"""A clustering of vectors, and the steps that improve it: assignment, means, and splitting and merging."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from kissgs.core.array_types import Float32, Float64, Int, Int32, UInt16
from kissgs.core.threads import Workers

BLOCK = 1024
"""Vectors per matrix product: its result, against some hundred centroids, stays in the processor's cache."""

SEARCHED = 4
"""Number of near centroids of a centroid whose own near ones are searched for nearer ones."""

PARTNERS = 24
"""Number of near centroids, the nearest, with whose clusters a cluster may merge."""

TASKS = 64
"""Number of tasks of an iteration: more than threads, since others may use the processor too."""


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

        def moments(first: int) -> Float64[np.ndarray, "2 D"]:
            block = slice(first, first + BLOCK)
            steps, weights = self.table[self.rows[block]].astype(np.float64) - start, self.weights[block]
            return np.stack([weights @ steps, weights @ np.square(steps)])

        first, second = sum(pool.map(moments, range(0, len(self.rows), BLOCK))) / self.weights.sum(dtype=np.float64)
        return (start + first).astype(np.float32), float(np.maximum(second - np.square(first), 0).mean()) ** 0.5


@dataclass(slots=True, eq=False)
class Clustering:
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

    data: Vectors
    centroids: Float32[np.ndarray, "K D"]
    labels: Int32[np.ndarray, " N"]
    distances: Float32[np.ndarray, " N"]
    near: UInt16[np.ndarray, "K k"]
    members: Int32[np.ndarray, " N"]
    edges: Int[np.ndarray, " edges"]
    totals: Float64[np.ndarray, " K"]
    errors: Float64[np.ndarray, " K"]

    def update(self, pool: Workers) -> None:
        """Move every centroid to the weighted mean of its vectors; one without vectors stays."""
        from kissgs.planning import kmeans_kernels as kernels

        data = self.data
        self.sort_members()
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
            self.parts(),
        )

    def sort_members(self) -> None:
        """Sort the vectors by label again, after labels have changed."""
        self.members, self.edges = sorted_by_label(self.labels, len(self.centroids))

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
            self.parts(),
        )

    def refresh_near(self, pool: Workers) -> None:
        """Find the near centroids again, which have moved, among the near ones of the nearest so far."""
        from kissgs.planning import kmeans_kernels as kernels

        found = np.empty_like(self.near)
        pool.map(lambda part: kernels.find_near(self.centroids, self.near, SEARCHED, *part, found), self.parts())
        self.near = found

    def relocate(self, pool: Workers) -> None:
        """Merge pairs of clusters and split others as long as the error shrinks, each cluster once at most.

        Only labels and lists of near centroids change; :meth:`update` then finds the centroids.
        """
        from kissgs.planning import relocation_kernels as kernels

        data, count = self.data, len(self.centroids)
        nearest = np.ascontiguousarray(self.near[:, :PARTNERS])
        partners, costs, gains = np.empty(count, np.int32), np.empty(count), np.zeros(count)
        second = np.zeros(len(self.labels), dtype=np.bool_)

        most = max(count // 2, 1)
        least = np.partition(self.errors, count - most)[count - most]

        def work(part: tuple[int, int]) -> None:
            kernels.merge_costs(self.centroids, self.totals, nearest, *part, partners, costs)
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

        pool.map(work, self.parts())
        merged = np.argsort(costs, kind="stable")[:most].astype(np.int32)
        split = np.argsort(-gains, kind="stable")[:most].astype(np.int32)
        kernels.relocate(
            merged, split, partners, costs, gains, second, self.members, self.edges, self.labels, self.near
        )

    def parts(self) -> list[tuple[int, int]]:
        """Return ranges of clusters with about equal numbers of vectors."""
        wanted = np.linspace(0, self.edges[-1], TASKS + 1)
        cuts = np.unique(np.concatenate([[0], np.searchsorted(self.edges, wanted[1:-1]), [len(self.edges) - 1]]))
        return [(int(a), int(b)) for a, b in pairwise(cuts)]


def sorted_by_label(
    labels: Int32[np.ndarray, " N"], count: int
) -> tuple[Int32[np.ndarray, " N"], Int[np.ndarray, " edges"]]:
    """Return the numbers of the vectors sorted by label, and where those of each label begin."""
    from kissgs.planning import kmeans_kernels as kernels

    edges = np.concatenate([[0], np.cumsum(np.bincount(labels, minlength=count))])
    members = np.empty(len(labels), dtype=np.int32)
    kernels.sort_by_label(labels, edges[:-1].copy(), members)
    return members, edges
