"""``ShMetric``: errors of view-dependent colour, measured where cameras see each Gaussian."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache

import numpy as np

from kissgs.core.array_types import Float32, Float64, Int
from kissgs.core.sensitivity import Sensitivity
from kissgs.core.spherical_harmonics import sh_basis
from kissgs.core.threads import Workers
from kissgs.planning.clustering import Clustering

ELSEWHERE = 0.3
"""Weight of all directions alike beside those from which the capture sees a Gaussian; both add up to 1."""

NEIGHBORS = 32
"""Number of codebook entries, the nearest to a Gaussian's present one, that are compared."""

SPHERE = 4 * np.pi
"""Area of the unit sphere: a form is the identity where all directions count alike."""


@dataclass(frozen=True, slots=True, eq=False)
class ShMetric:
    """Quadratic forms of the errors of shN, one per Gaussian, after base colours have compensated the mean error.

    The colour error in direction d is that of shN times the harmonics at d. Its mean square over the directions from
    which a Gaussian is seen, less the square of its mean, which the base colour takes up, is a form of the covariance
    of the harmonics. Products of harmonics are sums of harmonics of up to twice the degree, so the means of these give
    all covariances.

    Attributes:
        sensitivity: sensitivity of the scene, with the means of harmonics to twice the scene's degree. A Gaussian that
            no capture has seen has the identity.
        degree: SH degree of the scene, at least 1.
    """

    sensitivity: Sensitivity
    degree: int

    @classmethod
    def of(cls, sensitivity: Sensitivity, degree: int) -> ShMetric | None:
        """Return the metric of a sensitivity that knows directions of view; None for others."""
        return cls(sensitivity, degree) if sensitivity.higher_harmonics.shape[1] > 0 else None

    def forms(self, rows: Int[np.ndarray, " n"]) -> Float32[np.ndarray, "n K K"]:
        """Return the forms of some Gaussians: positive definite, the identity where all directions count alike."""
        means, higher = (
            values.take(rows, axis=0) for values in (self.sensitivity.mean_harmonics, self.sensitivity.higher_harmonics)
        )
        number = means.shape[1]
        known = np.float32(SPHERE * (1 - ELSEWHERE)) * self.sensitivity.captured.take(rows)[:, None, None]
        form = (np.concatenate([means, higher], axis=1) @ _products(self.degree)).reshape(-1, number, number)
        form -= means[:, :, None] * means[:, None, :]
        form *= known
        diagonal = np.arange(number)
        form[:, diagonal, diagonal] += 1
        return form

    def errors(self, vectors: Float32[np.ndarray, "n D"], rows: Int[np.ndarray, " n"]) -> Float64[np.ndarray, " n"]:
        """Return the squared errors of shN under the forms of these Gaussians; ``vectors`` are the differences."""
        some = vectors.reshape(len(vectors), -1, 3)
        return np.einsum("nkc,nkc->n", some, self.forms(rows) @ some, dtype=np.float64)

    def move_centroids(self, state: Clustering, pool: Workers) -> None:
        """Move every centroid to where its vectors' error is smallest; one without vectors stays."""
        data = state.data

        def work(part: tuple[int, int]) -> None:
            first, last = part
            filled = first + np.flatnonzero(np.diff(state.edges[first : last + 1]))
            if len(filled) == 0:
                return
            members = state.members[state.edges[first] : state.edges[last]]
            vectors = data.take(members).reshape(len(members), -1, 3)
            forms = self.forms(data.rows[members]) * data.weights[members, None, None]
            starts = state.edges[filled] - state.edges[first]
            left = np.add.reduceat(forms, starts, axis=0, dtype=np.float64)
            right = np.add.reduceat(forms @ vectors, starts, axis=0, dtype=np.float64)
            state.centroids[filled] = np.linalg.solve(left, right).reshape(len(filled), -1)

        pool.map(work, state.parts())

    def reassign(self, state: Clustering, pool: Workers) -> None:
        """Assign every vector to the one of the centroids near its present one at which its error is smallest."""
        from kissgs.planning import kmeans_kernels as kernels

        data = state.data
        near = np.ascontiguousarray(state.near[:, :NEIGHBORS])
        upper = np.triu_indices((self.degree + 1) ** 2 - 1)

        def work(part: tuple[int, int]) -> None:
            first, last = part
            members = state.members[state.edges[first] : state.edges[last]]
            if len(members) == 0:
                return
            forms = self.forms(data.rows[members])
            products = forms @ data.take(members).reshape(len(members), -1, 3)
            rows = np.concatenate([forms[:, *upper], products.reshape(len(members), -1)], axis=1)
            edges = state.edges[first : last + 1] - state.edges[first]
            kernels.assign_by_form(rows, members, edges, state.centroids, near, first, state.labels)

        pool.map(work, state.parts())
        state.sort_members()


@cache
def _products(degree: int) -> Float32[np.ndarray, "J P"]:
    """Return the products of all pairs of harmonics to ``degree`` as sums of the harmonics to twice the degree.

    Column a · K + b has the coefficients of the product of harmonics a + 1 and b + 1, without the constant one: that is
    1 / SPHERE for a = b, and 0 else.
    """
    number, points = (degree + 1) ** 2 - 1, 4 * (2 * degree + 1) ** 2
    height = 1 - (2 * np.arange(points) + 1) / points
    turn, radius = np.pi * (3 - 5**0.5) * np.arange(points), np.sqrt(1 - height**2)
    spiral = np.stack([radius * np.cos(turn), radius * np.sin(turn), height], axis=1)
    values = sh_basis(spiral, 2 * degree)
    some = values[:, 1 : number + 1]
    pairs = (some[:, :, None] * some[:, None, :]).reshape(points, -1)
    return np.linalg.lstsq(values, pairs, rcond=None)[0][1:].astype(np.float32)
