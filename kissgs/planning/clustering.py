"""A clustering of vectors, and the steps that improve it: assignment, means, and splitting and merging."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache
from itertools import pairwise

import numpy as np

from kissgs.core.array_types import Float32, Float64, Int, Int32, UInt16
from kissgs.core.resources import Workers
from kissgs.core.sensitivity import Sensitivity

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

        def moments(first: int) -> Float64[np.ndarray, "2 D"]:
            block = slice(first, first + BLOCK)
            steps, weights = self.table[self.rows[block]].astype(np.float64) - start, self.weights[block]
            return np.stack([weights @ steps, weights @ np.square(steps)])

        first, second = sum(pool.map(moments, range(0, len(self.rows), BLOCK))) / self.weights.sum(dtype=np.float64)
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


def sorted_by_label(
    labels: Int32[np.ndarray, " N"], count: int
) -> tuple[Int32[np.ndarray, " N"], Int[np.ndarray, " edges"]]:
    """Return the numbers of the vectors sorted by label, and where those of each label begin."""
    from kissgs.planning import kmeans_kernels as kernels

    edges = np.concatenate([[0], np.cumsum(np.bincount(labels, minlength=count))])
    members = np.empty(len(labels), dtype=np.int32)
    kernels.sort_by_label(labels, edges[:-1].copy(), members)
    return members, edges


# ``ShMetric``: errors of view-dependent colour, measured in the directions from which cameras see each Gaussian.

# Weight of all directions alike, beside those from which cameras see a Gaussian; both add up to 1. It grows with the
# view uncertainty, since that shrinks the measured means, and is 1 for Gaussians that no capture has seen.
UNIFORM_WEIGHT = 0.3
NEIGHBORS = 32  # number of codebook entries, the nearest to a Gaussian's present one, that are compared
SPHERE = 4 * np.pi  # area of the unit sphere: a form is the identity where all directions count alike


@dataclass(frozen=True, slots=True, eq=False)
class ShMetric:
    """Quadratic forms of the errors of shN, one per Gaussian, after base colours have compensated the mean error. The
    colour error in direction d is that of shN times the harmonics at d. Its mean square over the directions from which
    a Gaussian is seen, less the square of its mean, which the base colour takes up, is a form of the covariance of the
    harmonics. Products of harmonics are sums of harmonics of up to twice the degree, so the means of these give all
    covariances. What the base colour's change costs in all other directions is left out: counting it made images worse,
    those of the capture and those from elsewhere."""

    sensitivity: Sensitivity  # with the means of harmonics to twice the scene's degree
    degree: int

    @classmethod
    def of(cls, sensitivity: Sensitivity, degree: int) -> ShMetric | None:
        """Return the metric of a sensitivity that knows directions of view; None for others."""
        return cls(sensitivity, degree) if sensitivity.higher_harmonics.shape[1] > 0 else None

    def quadratic_forms(self, rows: Int[np.ndarray, " n"]) -> Float32[np.ndarray, "n K K"]:
        """Return the forms of some Gaussians: positive definite, the identity where all directions count alike."""
        means, higher = (
            values.take(rows, axis=0) for values in (self.sensitivity.mean_harmonics, self.sensitivity.higher_harmonics)
        )
        number = means.shape[1]
        known = np.float32(SPHERE * (1 - UNIFORM_WEIGHT)) * self.sensitivity.captured.take(rows)[:, None, None]
        form = (np.concatenate([means, higher], axis=1) @ _products(self.degree)).reshape(-1, number, number)
        form -= means[:, :, None] * means[:, None, :]
        form *= known
        diagonal = np.arange(number)
        form[:, diagonal, diagonal] += 1
        return form

    def errors(self, vectors: Float32[np.ndarray, "n D"], rows: Int[np.ndarray, " n"]) -> Float64[np.ndarray, " n"]:
        """Return the squared errors of shN under the forms of these Gaussians; ``vectors`` are the differences."""
        found = np.empty(len(vectors))
        for first in range(0, len(vectors), BLOCK):
            block = slice(first, first + BLOCK)
            some = vectors[block].reshape(-1, self.coefficients, 3)
            found[block] = np.einsum("nkc,nkc->n", some, self.quadratic_forms(rows[block]) @ some, dtype=np.float64)
        return found

    @property
    def coefficients(self) -> int:
        """Number of coefficients of shN per colour channel."""
        return (self.degree + 1) ** 2 - 1

    def move_centroids(self, state: Clustering, pool: Workers) -> None:
        """Move every centroid to where its vectors' error is smallest; one without vectors stays."""
        data, number = state.data, self.coefficients

        def work(part: tuple[int, int]) -> None:
            first, last = part
            counts = np.diff(state.edges[first : last + 1])
            left, right = np.zeros((last - first, number, number)), np.zeros((last - first, number, 3))
            for members, _ in _blocks(state, part):
                vectors = data.take(members).reshape(-1, number, 3)
                forms = self.quadratic_forms(data.rows[members]) * data.weights[members, None, None]
                clusters, starts = np.unique(state.labels[members] - first, return_index=True)
                left[clusters] += np.add.reduceat(forms, starts, axis=0, dtype=np.float64)
                right[clusters] += np.add.reduceat(forms @ vectors, starts, axis=0, dtype=np.float64)
            several, single = np.flatnonzero(counts > 1), np.flatnonzero(counts == 1)
            moved = np.linalg.solve(left[several], right[several])
            state.centroids[first + several] = moved.reshape(-1, 3 * number)
            state.centroids[first + single] = data.take(state.members[state.edges[first + single]])

        pool.map(work, state.parts())

    def reassign(self, state: Clustering, pool: Workers) -> None:
        """Assign every vector to the one of the centroids near its present one at which its error is smallest."""
        from kissgs.planning import kmeans_kernels as kernels

        data, number = state.data, self.coefficients
        near = np.ascontiguousarray(state.near[:, :NEIGHBORS])
        upper = np.triu_indices(number)

        def work(part: tuple[int, int]) -> None:
            for members, edges in _blocks(state, part):
                forms = self.quadratic_forms(data.rows[members])
                products = forms @ data.take(members).reshape(-1, number, 3)
                rows = np.concatenate([forms[:, *upper], products.reshape(len(members), -1)], axis=1)
                kernels.assign_by_form(rows, members, edges, state.centroids, near, part[0], state.labels)

        pool.map(work, state.parts())
        state.sort_members()


def _blocks(
    state: Clustering, part: tuple[int, int]
) -> Iterator[tuple[Int32[np.ndarray, " n"], Int[np.ndarray, " edges"]]]:
    """Yield the vectors of a range of clusters in blocks, sorted by cluster, and where each cluster's begin in a block.
    A form takes a kilobyte, and a single cluster may have most of the vectors."""
    edges = state.edges[part[0] : part[1] + 1]
    for first in range(int(edges[0]), int(edges[-1]), BLOCK):
        last = min(first + BLOCK, int(edges[-1]))
        yield state.members[first:last], np.clip(edges, first, last) - first


@cache
def _products(degree: int) -> Float32[np.ndarray, "J P"]:
    """Return the products of all pairs of harmonics to ``degree`` as sums of the harmonics to twice the degree. Column
    a · K + b has the coefficients of the product of harmonics a + 1 and b + 1, without the constant one: that is 1 /
    SPHERE for a = b, and 0 else."""
    from kissgs.core.harmonics_kernel import write_harmonics_of

    number, count = (degree + 1) ** 2 - 1, (2 * degree + 1) ** 2 - 1
    points = 4 * count
    height = 1 - (2 * np.arange(points) + 1) / points
    turn, radius = np.pi * (3 - 5**0.5) * np.arange(points), np.sqrt(1 - height**2)
    values = np.empty((points, count))
    directions = np.stack([radius * np.cos(turn), radius * np.sin(turn), height], axis=1)
    write_harmonics_of(directions, 2 * degree, values)
    pairs = (values[:, :number, None] * values[:, None, :number]).reshape(points, -1)
    with_constant = np.concatenate([np.ones((points, 1)), values], axis=1)
    return np.linalg.lstsq(with_constant, pairs, rcond=None)[0][1:].astype(np.float32)
