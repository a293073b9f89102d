"""Parts of a scene that stand apart: one may be lost as a whole, and cameras drawn over the scene need not see it."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from kissgs.core.array_types import Float64, Int
from kissgs.core.splats import Splats
from kissgs.evaluation.prominence import morton_codes

SAMPLE = 2048
"""Gaussians that stand for all, at most."""

LEAST = 0.004
"""Share of what the scene can show that a part has at least: 0.5 %, and a little less for errors of sampling."""

FEWEST = 8
"""Gaussians of the sample that a part has at least."""

APART = 3.0
"""How many times wider than the gaps inside of a part the gap around it is: less is usual between any Gaussians."""

WITHIN = 0.75
"""Share of a part's sample inside of its radius."""


@dataclass(frozen=True, slots=True, eq=False)
class Part:
    """Gaussians that lie near to each other and far from all others.

    Attributes:
        middle: ``(3,)`` the median along each axis.
        radius: of the sphere around it that holds most of them.
    """

    middle: Float64[np.ndarray, "3"]
    radius: float


def find_parts(splats: Splats, counts: Float64[np.ndarray, " N"]) -> tuple[list[Part], Int[np.ndarray, " N"]]:
    """The smallest parts that stand apart, and for each Gaussian the number of its part, -1 for none.

    A sample of the Gaussians is joined, nearest pairs first (single linkage, as in HDBSCAN, where no two Gaussians are
    nearer than their own size). What has grown to :data:`LEAST` of the scene before it meets something as large is a
    part, if it crossed no gap while it grew to that that is a third as wide as the one between them.

    Args:
        splats: finite.
        counts: what each Gaussian can show (:func:`kissgs.evaluation.prominence.prominence`).
    """
    part_of = np.full(len(splats), -1)
    visible = np.flatnonzero(counts > 0)
    if not len(visible):
        return [], part_of
    order = visible[np.argsort(morton_codes(splats.means[visible].astype(np.float64)), kind="stable")]
    until = np.cumsum(counts[order]) / counts[order].sum()
    picks = np.searchsorted(until, (np.arange(SAMPLE) + 0.5) / SAMPLE).clip(max=len(order) - 1)
    picks, nearest_pick, shares = np.unique(picks, return_inverse=True, return_counts=True)
    sample = order[picks]
    places = splats.means[sample].astype(np.float64)
    sizes = np.exp(np.median(splats.scales[sample].astype(np.float64), axis=1))
    found = _apart(_spanning_tree(places, sizes), shares / SAMPLE)
    label = np.full(len(sample), -1)
    parts = []
    for number, members in enumerate(found):
        label[members] = number
        middle = np.median(places[members], axis=0)
        away = np.linalg.norm(places[members] - middle, axis=1) + sizes[members]
        parts.append(Part(middle, float(np.quantile(away, WITHIN))))
    halfway = until - 0.5 * counts[order] / counts[order].sum()
    part_of[order] = label[nearest_pick[(halfway * SAMPLE).astype(np.int64).clip(0, SAMPLE - 1)]]
    return parts, part_of


Edge = tuple[float, int, int]


def _spanning_tree(places: Float64[np.ndarray, "n 3"], sizes: Float64[np.ndarray, " n"]) -> list[Edge]:
    """The shortest edges that join all (Prim): length and ends, shortest first; no length is below an end's size."""
    n = len(places)
    x, y, z = np.ascontiguousarray(places.T)
    lengths, parents, edges = np.full(n, np.inf), np.zeros(n, np.int64), []
    outside, last = np.ones(n, bool), 0
    for _ in range(n - 1):
        outside[last] = False
        reach = np.sqrt(np.square(x - x[last]) + np.square(y - y[last]) + np.square(z - z[last]))
        np.maximum(reach, np.maximum(sizes, sizes[last]), out=reach)
        nearer = outside & (reach < lengths)
        lengths[nearer], parents[nearer] = reach[nearer], last
        lengths[last] = np.inf
        last = int(np.where(outside, lengths, np.inf).argmin())
        edges.append((float(lengths[last]), last, int(parents[last])))
    return sorted(edges)


@dataclass(slots=True, eq=False)
class _Cluster:
    """Gaussians that edges up to some length join.

    Attributes:
        members: of the sample.
        share: of what the scene can show.
        formed: the longest edge that was needed for it to become large enough for a part; infinite before.
        parts: members of the parts in it.
    """

    members: list[int]
    share: float
    formed: float = np.inf
    parts: list[list[int]] = field(default_factory=list)

    def closed_by(self, length: float) -> None:
        """What comes next is as far as that: note whether this stands apart."""
        if not self.parts and length > APART * self.formed:
            self.parts = [self.members]


def _apart(edges: list[Edge], shares: Float64[np.ndarray, " n"]) -> list[list[int]]:
    """Members of each part."""
    cluster_of = [_Cluster([n], float(share)) for n, share in enumerate(shares)]
    for length, a, b in edges:
        one, other = cluster_of[a], cluster_of[b]
        if np.isfinite(one.formed) and np.isfinite(other.formed):
            one.closed_by(length)
            other.closed_by(length)
        joined = _Cluster(one.members + other.members, one.share + other.share)
        joined.parts, joined.formed = one.parts + other.parts, min(one.formed, other.formed)
        if np.isinf(joined.formed) and joined.share >= LEAST and len(joined.members) >= FEWEST:
            joined.formed = length
        for member in joined.members:
            cluster_of[member] = joined
    return cluster_of[0].parts
