"""Separate parts of a scene: each may be lost as a whole, and randomly drawn cameras may miss it."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from kissgs.core.array_types import Float64, Int
from kissgs.core.splats import Splats
from kissgs.evaluation.prominence import morton_codes

SAMPLE_SIZE = 2048
"""Largest number of Gaussians in the sample that is clustered."""

MIN_SHARE = 0.004
"""Smallest share of the scene's prominence that a part has: 0.5 %, less a margin for errors of sampling."""

MIN_SAMPLES = 8
"""Smallest number of sampled Gaussians in a part."""

MIN_GAP_RATIO = 3.0
"""Smallest ratio of the gap around a part to the gaps inside it: lower ratios are common between any Gaussians."""

RADIUS_QUANTILE = 0.75
"""Share of a part's sampled Gaussians within its radius."""


@dataclass(frozen=True, slots=True, eq=False)
class Part:
    """A group of Gaussians that are near to each other and far from all others.

    Attributes:
        center: ``(3,)`` median position along each axis, world units.
        radius: radius of the sphere around the centre that holds most of them, world units.
    """

    center: Float64[np.ndarray, "3"]
    radius: float


def find_parts(splats: Splats, counts: Float64[np.ndarray, " N"]) -> tuple[list[Part], Int[np.ndarray, " N"]]:
    """Find the smallest separate parts of a scene.

    A sample of the Gaussians is clustered by single linkage; as in HDBSCAN, no two Gaussians are nearer than their own
    size. A cluster that has reached :data:`MIN_SHARE` of the scene is a part if the gap to the next cluster of at least
    that size is :data:`MIN_GAP_RATIO` times the gap at which it reached the share.

    Args:
        splats: the scene, finite.
        counts: ``(N,)`` prominence of each Gaussian (:func:`kissgs.evaluation.prominence.prominence`).

    Returns:
        the parts, and the index of each Gaussian's part, ``(N,)``, -1 for none.
    """
    part_of = np.full(len(splats), -1)
    visible = np.flatnonzero(counts > 0)
    if not len(visible):
        return [], part_of
    order = visible[np.argsort(morton_codes(splats.means[visible].astype(np.float64)), kind="stable")]
    cumulative = np.cumsum(counts[order]) / counts[order].sum()
    picks = np.searchsorted(cumulative, (np.arange(SAMPLE_SIZE) + 0.5) / SAMPLE_SIZE).clip(max=len(order) - 1)
    picks, nearest_pick, shares = np.unique(picks, return_inverse=True, return_counts=True)
    sample = order[picks]
    positions = splats.means[sample].astype(np.float64)
    sizes = np.exp(np.median(splats.scales[sample].astype(np.float64), axis=1))
    label = np.full(len(sample), -1)
    parts = []
    for number, members in enumerate(_separate_parts(_spanning_tree(positions, sizes), shares / SAMPLE_SIZE)):
        label[members] = number
        center = np.median(positions[members], axis=0)
        distances = np.linalg.norm(positions[members] - center, axis=1) + sizes[members]
        parts.append(Part(center, float(np.quantile(distances, RADIUS_QUANTILE))))
    midpoints = cumulative - 0.5 * counts[order] / counts[order].sum()
    part_of[order] = label[nearest_pick[(midpoints * SAMPLE_SIZE).astype(np.int64).clip(0, SAMPLE_SIZE - 1)]]
    return parts, part_of


Edge = tuple[float, int, int]
"""Length and both ends."""


def _spanning_tree(positions: Float64[np.ndarray, "n 3"], sizes: Float64[np.ndarray, " n"]) -> list[Edge]:
    """Return the minimum spanning tree (Prim), shortest edges first; no edge is shorter than the size of its ends."""
    n = len(positions)
    x, y, z = np.ascontiguousarray(positions.T)
    lengths, parents, edges = np.full(n, np.inf), np.zeros(n, np.int64), []
    outside, last = np.ones(n, bool), 0
    for _ in range(n - 1):
        outside[last] = False
        distances = np.sqrt(np.square(x - x[last]) + np.square(y - y[last]) + np.square(z - z[last]))
        np.maximum(distances, np.maximum(sizes, sizes[last]), out=distances)
        nearer = outside & (distances < lengths)
        lengths[nearer], parents[nearer] = distances[nearer], last
        lengths[last] = np.inf
        last = int(np.where(outside, lengths, np.inf).argmin())
        edges.append((float(lengths[last]), last, int(parents[last])))
    return sorted(edges)


@dataclass(slots=True, eq=False)
class _Cluster:
    """Sampled Gaussians joined by edges up to some length.

    Attributes:
        members: indices in the sample.
        share: share of the scene's prominence.
        formed: length of the edge with which it became large enough for a part; infinite before.
        parts: members of each part in it.
    """

    members: list[int]
    share: float
    formed: float = np.inf
    parts: list[list[int]] = field(default_factory=list)

    def mark_if_separate(self, length: float) -> None:
        """Mark the cluster as a part if the next one, at distance ``length``, is far enough away."""
        if not self.parts and length > MIN_GAP_RATIO * self.formed:
            self.parts = [self.members]


def _separate_parts(edges: list[Edge], shares: Float64[np.ndarray, " n"]) -> list[list[int]]:
    """Return the members of each part; ``edges`` are a spanning tree, shortest first."""
    cluster_of = [_Cluster([n], float(share)) for n, share in enumerate(shares)]
    for length, a, b in edges:
        one, other = cluster_of[a], cluster_of[b]
        if np.isfinite(one.formed) and np.isfinite(other.formed):
            one.mark_if_separate(length)
            other.mark_if_separate(length)
        joined = _Cluster(one.members + other.members, one.share + other.share)
        joined.parts, joined.formed = one.parts + other.parts, min(one.formed, other.formed)
        if np.isinf(joined.formed) and joined.share >= MIN_SHARE and len(joined.members) >= MIN_SAMPLES:
            joined.formed = length
        for member in joined.members:
            cluster_of[member] = joined
    return cluster_of[0].parts
