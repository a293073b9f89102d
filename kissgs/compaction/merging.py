"""Merging: two neighbouring Gaussians become one with their mean, covariance, colour and opacity, again and again.

No image is rendered. What a merge costs is the squared error of its image, in closed form
(:mod:`kissgs.compaction.merge_kernels`); the cheapest pairs merge first.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field

import numpy as np

from kissgs.compaction import covariance_kernels, merge_kernels, nearest_kernels
from kissgs.core.array_types import Bool, Float32, Float64, Int32, Int64
from kissgs.core.progress import Progress, silent
from kissgs.core.splats import LOG_SCALE_LIMIT, OPACITY_LOGIT_MAX, OPACITY_LOGIT_MIN, Splats
from kissgs.core.threads import Workers
from kissgs.rendering.cpu.lists import each_part, even
from kissgs.rendering.cpu.neighbours import split_into_leaves

NEIGHBOURS = 8
"""Number of nearest neighbours that a Gaussian may merge with."""

LEAF = 16
"""Largest number of Gaussians in a leaf of the search tree."""

SPACING_RANK = 3
"""Neighbour, from 0, whose distance is the spacing of the Gaussians."""

BLUR = 0.01
"""Variance of the blur of the compared images, in squared spacings: viewers stand where they cannot tell neighbours
much smaller than their distance apart."""

CONTRAST = 0.09
"""Squared contrast of Gaussians to what is behind them, a sum over RGB in [0, 1]."""

BLOCK = 65536
"""Number of Gaussians whose colours are moved at a time."""

LARGEST_STEP = 0.3
"""Largest share of the Gaussians that disappears before neighbours and errors are computed anew."""


def merge_gaussians(
    splats: Splats, count: int, *, threads: int = 0, progress: Progress = silent
) -> tuple[Splats, Int64[np.ndarray, " M"]]:
    """Reduce a scene to ``count`` Gaussians by merging.

    Merged Gaussians keep mean, covariance and mean colour of the mixture, weighted by opacity times area, and get the
    opacity that is nearest to the alpha of both together. Gaussians that are not merged stay exactly as they are.

    Args:
        splats: the scene, clean.
        count: number of Gaussians, at least 1; a scene with no more is returned unchanged.
        threads: number of threads; 0 means one per processor. The result does not depend on it.
        progress: receives the stage "merge".

    Returns:
        The scene, clean; and for each of its Gaussians the index of the one with the largest weight among those it
        stands for, ``(M,)``, ascending.
    """
    with Workers(threads) as pool:
        clusters = _Clusters(splats, pool)
        for left in clusters.reduce(count):
            progress("merge", 1 - np.log(left / count) / np.log(len(splats) / count))
        progress("merge", 1.0)
        return clusters.splats()


def merged_levels(splats: Splats, counts: Sequence[int], *, threads: int = 0) -> list[Splats]:
    """Reduce a scene to each of ``counts``, which descend, each result by merging the one before further.

    Arguments and results are those of :func:`merge_gaussians`.
    """
    with Workers(threads) as pool:
        clusters, levels = _Clusters(splats, pool), []
        for count in counts:
            for _ in clusters.reduce(count):
                pass
            levels.append(clusters.splats()[0])
        return levels


@dataclass(slots=True, eq=False)
class _Clusters:
    """The Gaussians that are left, each of which stands for one or more of the input.

    Neighbours have rows near each other, which processors read faster.

    Attributes:
        source: the input.
        pool: threads.
        means: ``(M, 3)``.
        covariances: ``(M, 6)`` xx, xy, xz, yy, yz, zz.
        alphas: ``(M,)`` opacities.
        colors: ``(M, F)`` SH coefficients, those of ``sh0`` first.
        errors: ``(M,)`` errors that merges have caused, see :func:`kissgs.compaction.merge_kernels.pair_errors`.
        origin: ``(M,)`` index of the member with the largest weight.
        heaviest: ``(M,)`` its weight.
        merged: ``(M,)`` whether it stands for several.
    """

    source: Splats
    pool: Workers
    means: Float64[np.ndarray, "M 3"] = field(init=False)
    covariances: Float64[np.ndarray, "M 6"] = field(init=False)
    alphas: Float64[np.ndarray, " M"] = field(init=False)
    colors: Float32[np.ndarray, "M F"] = field(init=False)
    errors: Float64[np.ndarray, " M"] = field(init=False)
    origin: Int32[np.ndarray, " M"] = field(init=False)
    heaviest: Float64[np.ndarray, " M"] = field(init=False)
    merged: Bool[np.ndarray, " M"] = field(init=False)

    def __post_init__(self) -> None:
        splats, count = self.source, len(self.source)
        self.origin, _, _ = self._leaves(splats.means)
        self.means = splats.means[self.origin].astype(np.float64)
        self.covariances = np.empty((count, 6))
        quats, scales = splats.quats[self.origin], splats.scales[self.origin]
        self._each(count, lambda a, b: covariance_kernels.covariances_of(quats, scales, a, b, self.covariances))
        self.alphas = 1 / (1 + np.exp(-splats.opacities[self.origin].astype(np.float64)))
        self.colors = np.empty((count, 3 + 3 * splats.shN.shape[1]), np.float32)
        self.colors[:, :3] = splats.sh0[self.origin]
        for a in range(0, count, BLOCK):
            rows = self.origin[a : a + BLOCK]
            self.colors[a : a + BLOCK, 3:] = splats.shN[rows].reshape(len(rows), -1)
        self.errors, self.heaviest, self.merged = np.zeros(count), np.zeros(count), np.zeros(count, bool)

    def reduce(self, count: int) -> Iterator[int]:
        """Merge until ``count`` Gaussians are left; before each round, yield how many there are."""
        while len(self.means) > count:
            left = len(self.means)
            yield left
            self._merge(min(left - count, max(1, int(left * LARGEST_STEP))))

    def _merge(self, disappearing: int) -> None:
        """Merge the pairs that add the least error until this many Gaussians disappear, or fewer if pairs run out."""
        near, spacing = self._neighbours()
        count, weights = len(self.means), np.empty(len(self.means))
        self._each(
            count, lambda a, b: merge_kernels.opacity_areas(self.covariances, self.alphas, spacing, BLUR, a, b, weights)
        )
        self.heaviest = np.where(self.merged, self.heaviest, weights)
        joined, added = self._cheapest_pairs(near, weights, spacing, disappearing)
        del near
        self._each(
            len(joined),
            lambda a, b: merge_kernels.merge(
                self.means, self.covariances, self.alphas, self.colors, weights, spacing, BLUR, joined, a, b
            ),
        )
        self._drop(joined, added)

    def _cheapest_pairs(
        self,
        near: Int32[np.ndarray, "M K"],
        weights: Float64[np.ndarray, " M"],
        spacing: Float64[np.ndarray, " M"],
        count: int,
    ) -> tuple[Int32[np.ndarray, "P 2"], Float64[np.ndarray, " P"]]:
        """Return at most ``count`` pairs of which no two share a Gaussian, and the error that each adds."""
        pairs = np.empty((near.size, 2), np.int32)
        pairs = pairs[: nearest_kernels.unique_pairs(near, pairs)]
        added = np.empty(len(pairs))
        gaussians = self.means, self.covariances, self.alphas, self.colors, weights, spacing
        self._each(
            len(pairs),
            lambda a, b: merge_kernels.pair_errors(*gaussians, self.errors, BLUR, CONTRAST, pairs, a, b, added),
        )
        chosen = np.empty(count, np.int64)
        order = np.argsort(added, kind="stable")
        chosen = chosen[: merge_kernels.choose(order, pairs, len(self.means), chosen)]
        return np.ascontiguousarray(pairs[chosen]), added[chosen]

    def _drop(self, joined: Int32[np.ndarray, "P 2"], added: Float64[np.ndarray, " P"]) -> None:
        """Remove the second of each pair; the first stands for both."""
        kept, dropped = joined.T
        second = self.heaviest[dropped] > self.heaviest[kept]
        self.origin[kept] = np.where(second, self.origin[dropped], self.origin[kept])
        self.heaviest[kept] = np.maximum(self.heaviest[dropped], self.heaviest[kept])
        self.errors[kept] += self.errors[dropped] + added
        self.merged[kept] = True
        left = np.ones(len(self.means), bool)
        left[dropped] = False
        for name in ("means", "covariances", "alphas", "errors", "origin", "heaviest", "merged"):
            setattr(self, name, getattr(self, name)[left])
        rows = np.flatnonzero(left)
        for a in range(0, len(rows), BLOCK):  # in place: the colours are most of the memory
            some = rows[a : a + BLOCK]
            self.colors[a : a + len(some)] = self.colors[some]
        self.colors = self.colors[: len(rows)]

    def _neighbours(self) -> tuple[Int32[np.ndarray, "M K"], Float64[np.ndarray, " M"]]:
        """Return the nearest neighbours of each Gaussian, and its squared spacing."""
        count = len(self.means)
        order, edges, leaves = self._leaves(self.means)
        boxes = np.empty((2 << (leaves - 1).bit_length(), 2, 3))
        nearest_kernels.fill_boxes(self.means, order, edges, leaves, boxes)
        near, spacing = np.empty((count, min(NEIGHBOURS, count - 1)), np.int32), np.empty(count)
        rank = min(SPACING_RANK, near.shape[1] - 1)
        self._each(
            leaves, lambda a, b: nearest_kernels.nearest(self.means, order, edges, boxes, a, b, rank, near, spacing)
        )
        return near, spacing

    @staticmethod
    def _leaves(means: np.ndarray) -> tuple[Int32[np.ndarray, " M"], Int64[np.ndarray, " edges"], int]:
        """Return the indices of the Gaussians in the order of a k-d tree, and the edges and number of its leaves."""
        order, edges = np.arange(len(means), dtype=np.int32), np.empty(4 * len(means) // LEAF + 2, np.int64)
        leaves = split_into_leaves(np.ascontiguousarray(means.T.astype(np.float32)), LEAF, order, edges)
        return order, edges, leaves

    def _each(self, count: int, kernel: Callable[[int, int], None]) -> None:
        """Call a kernel with the first and last row of each part, in threads."""
        each_part(kernel, even(count, self.pool), self.pool)

    def splats(self) -> tuple[Splats, Int64[np.ndarray, " M"]]:
        """Return the scene and the indices in the input, ascending."""
        order = np.argsort(self.origin)
        index = self.origin[order].astype(np.int64)
        kept = self.source.select(index)
        places = np.flatnonzero(self.merged[order])
        rows = order[places]
        quats, scales = np.empty((len(order), 4), np.float32), np.empty((len(order), 3), np.float32)
        self._each(len(rows), lambda a, b: covariance_kernels.decompose(self.covariances, rows, a, b, quats, scales))
        kept.quats[places], alphas = quats[rows], self.alphas[rows]
        kept.scales[places] = np.clip(scales[rows], -LOG_SCALE_LIMIT, LOG_SCALE_LIMIT)  # what was far apart is larger
        kept.means[places] = self.means[rows]
        kept.opacities[places] = np.clip(np.log(alphas / (1 - alphas)), OPACITY_LOGIT_MIN, OPACITY_LOGIT_MAX)
        kept.sh0[places] = self.colors[rows, :3]
        kept.shN[places] = self.colors[rows, 3:].reshape(len(rows), kept.shN.shape[1], 3)
        return kept, index
