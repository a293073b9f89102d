"""Parts of a scene that may be lost as a whole, prominence of Gaussians, and what some views show."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from kissgs.core.array_types import Float64, Int
from kissgs.core.context import Workers
from kissgs.core.splats import Splats
from kissgs.io.conventions import spread_bits
from kissgs.rendering.camera import Camera
from kissgs.rendering.cpu.frame import color_gradients, draw, drawn_opacities, sums_of_slots
from kissgs.rendering.cpu.records import Frame

MORTON_BITS = 21  # bits per axis of a Morton code: as many as 64 bits hold
NEIGHBOURS = 64  # number of Gaussians, consecutive in Morton order, that form a neighbourhood
FAIRNESS = 0.25  # exponent of prominence where octree cells share a probability: 0 gives all the same


def prominence(splats: Splats) -> Float64[np.ndarray, " N"]:
    """Return the prominence of each Gaussian, 0 to 1: opacity times a / (a + median of its neighbourhood's areas). So
    the details of a small object count as much as a background, and an immense Gaussian at most twice as much."""
    weights = np.zeros(len(splats))
    opacities = drawn_opacities(splats)
    visible = np.flatnonzero(opacities > 0)
    if len(visible):
        visible = visible[np.argsort(morton_codes(splats.means[visible].astype(np.float64)), kind="stable")]
        axes = np.sort(splats.scales[visible].astype(np.float64), axis=1)
        areas = np.exp(axes[:, 1] + axes[:, 2])
        blocks = np.pad(areas, (0, -len(areas) % NEIGHBOURS), mode="edge").reshape(-1, NEIGHBOURS)
        medians = np.repeat(np.median(blocks, axis=1), NEIGHBOURS)[: len(areas)]
        weights[visible] = opacities[visible] * areas / (areas + medians)
    return weights


def mahalanobis_distances(splats: Splats, point: Float64[np.ndarray, "3"]) -> Float64[np.ndarray, " N"]:
    """Return the distance of a point to each Gaussian in its standard deviations."""
    offsets = point - splats.means.astype(np.float64)
    w, axis = splats.quats[:, :1].astype(np.float64), -splats.quats[:, 1:].astype(np.float64)
    rotated = offsets + 2 * np.cross(axis, np.cross(axis, offsets) + w * offsets)
    return np.asarray(np.linalg.norm(rotated * np.exp(-splats.scales.astype(np.float64)), axis=1))


@dataclass(frozen=True, slots=True, eq=False)
class GaussianSampler:
    """Maps numbers from 0 to 1 to Gaussians; near numbers give Gaussians near to each other."""

    order: Int[np.ndarray, " N"]
    cumulative: Float64[np.ndarray, " N"]

    @classmethod
    def of(cls, means: Float64[np.ndarray, "N 3"], weights: Float64[np.ndarray, " N"]) -> GaussianSampler:
        """Return a sampler whose probabilities are half proportional to the weights and half shared in an octree.
        There, the children of a cell share its probability by the fourth roots of their weights: a small cluster is not
        missed beside a large one, nor a large one beside a few outliers."""
        codes = morton_codes(means)
        order = np.argsort(codes, kind="stable")
        sorted_weights = weights[order] / weights.sum()
        fair = _fair_probabilities(codes[order], sorted_weights)
        cumulative = np.cumsum(0.5 * sorted_weights + 0.5 * fair)
        return cls(order, cumulative / cumulative[-1])

    def at(self, number: float) -> int:
        """Return the index of the Gaussian at this quantile, a number from 0 to 1."""
        rank = int(np.searchsorted(self.cumulative, number, side="right"))
        return int(self.order[min(rank, len(self.order) - 1)])


def _fair_probabilities(codes: Int[np.ndarray, " N"], weights: Float64[np.ndarray, " N"]) -> Float64[np.ndarray, " N"]:
    """Return the probabilities of the fair half; Gaussians are in the order of their Morton codes."""
    cells, leaf = np.unique(codes, return_inverse=True)
    levels = [np.bincount(leaf, weights)]
    parents = [leaf]
    while len(cells) > 1:
        cells, parent = np.unique(cells >> 3, return_inverse=True)
        levels.append(np.bincount(parent, levels[-1]))
        parents.append(parent)
    probabilities = np.ones(1)
    for parent, cell_weights in zip(parents[:0:-1], levels[-2::-1], strict=True):
        shares = cell_weights**FAIRNESS
        probabilities = probabilities[parent] * shares / np.maximum(np.bincount(parent, shares), 1e-300)[parent]
    return np.asarray(probabilities[leaf] * weights / np.maximum(levels[0], 1e-300)[leaf])


def morton_codes(means: Float64[np.ndarray, "N 3"]) -> Int[np.ndarray, " N"]:
    """Return positions along a space-filling curve: the interleaved bits of the coordinates."""
    low = means.min(axis=0)
    extent = max(float((means.max(axis=0) - low).max()), 1e-300)
    steps = np.minimum((means - low) / extent * 2**MORTON_BITS, 2**MORTON_BITS - 1).astype(np.uint64)
    x, y, z = (spread_bits(axis) << np.uint64(n) for n, axis in enumerate(steps.T))
    return (x | y | z).astype(np.int64)


# Separate parts of a scene: each may be lost as a whole, and randomly drawn cameras may miss it.

SAMPLE_SIZE = 2048  # largest number of Gaussians in the sample that is clustered
MIN_SHARE = 0.004  # of the scene's prominence that a part has: 0.5 %, less a margin for errors of sampling
MIN_SAMPLES = 8  # smallest number of sampled Gaussians in a part
MIN_GAP_RATIO = 3.0  # of the gap around a part to gaps inside it: lower ones are common between any Gaussians
RADIUS_QUANTILE = 0.75  # share of a part's sampled Gaussians within its radius


@dataclass(frozen=True, slots=True, eq=False)
class Part:
    """A group of Gaussians that are near to each other and far from all others."""

    center: Float64[np.ndarray, "3"]  # median position along each axis, world units
    radius: float  # of the sphere around the centre that holds most of them


def find_parts(splats: Splats, counts: Float64[np.ndarray, " N"]) -> tuple[list[Part], Int[np.ndarray, " N"]]:
    """Return the smallest separate parts of a scene, and each Gaussian's part, -1 for none; ``counts`` are prominences.
    A sample is clustered by single linkage; as in HDBSCAN, no two Gaussians are nearer than their own size. A cluster
    that has reached :data:`MIN_SHARE` of the scene is a part if the gap to the next one of at least that size is
    :data:`MIN_GAP_RATIO` times the gap at which it reached the share."""
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


Edge = tuple[float, int, int]  # length and both ends


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
    """Sampled Gaussians joined by edges up to some length."""

    members: list[int]
    share: float  # of the scene's prominence
    formed: float = np.inf  # length of the edge with which it became large enough for a part
    parts: list[list[int]] = field(default_factory=list)  # members of each part in it


def _separate_parts(edges: list[Edge], shares: Float64[np.ndarray, " n"]) -> list[list[int]]:
    """Return the members of each part; ``edges`` are a spanning tree, shortest first."""
    cluster_of = [_Cluster([n], float(share)) for n, share in enumerate(shares)]
    for length, a, b in edges:
        one, other = cluster_of[a], cluster_of[b]
        if np.isfinite(one.formed) and np.isfinite(other.formed):
            for cluster in (one, other):
                if not cluster.parts and length > MIN_GAP_RATIO * cluster.formed:  # the next one is far away
                    cluster.parts = [cluster.members]
        joined = _Cluster(one.members + other.members, one.share + other.share)
        joined.parts, joined.formed = one.parts + other.parts, min(one.formed, other.formed)
        if np.isinf(joined.formed) and joined.share >= MIN_SHARE and len(joined.members) >= MIN_SAMPLES:
            joined.formed = length
        for member in joined.members:
            cluster_of[member] = joined
    return cluster_of[0].parts


# Share of a scene that some views show, from the blending weights of its Gaussians.

SHOWN_SHARE = 1e-6  # share of an image that a Gaussian must exceed to count as shown by it
MAX_SIDE = 160  # longer side of the images, pixels; larger ones are rendered at this size


def blending_weights(frame: Frame, pool: Workers) -> Float64[np.ndarray, " N"]:
    """Return the blending weight of each Gaussian, alpha times the transmittance in front of it, summed over pixels."""
    # The gradient of the sum of all values by a red one is the sum of the weights.
    v_slots, slots = color_gradients(frame, np.ones_like(frame.image), pool)
    return sums_of_slots(frame, slots, np.ascontiguousarray(v_slots[:, 0]))


def share_shown(splats: Splats, cameras: Sequence[Camera], *, threads: int = 0) -> float:
    """Return the share of a scene by prominence, 0 to 1, that cameras show; 1 without visible Gaussians."""
    counts, plain = prominence(splats), base_colors_only(splats)
    if not counts.any():
        return 1.0
    shown = np.zeros(len(splats), bool)
    with Workers(threads) as pool:
        for camera in cameras:
            small = camera.at_most(MAX_SIDE)
            frame = draw(plain, small, np.zeros(3, np.float32), pool)
            shown |= blending_weights(frame, pool) > SHOWN_SHARE * small.width * small.height
    return float(counts[shown].sum() / counts.sum())


def base_colors_only(splats: Splats) -> Splats:
    """Return the scene without shN, for renderings whose colours do not matter: shN costs as much as all else."""
    return replace(splats, shN=np.empty((len(splats), 0, 3), np.float32))
