"""Local scale: the distance between Gaussians around each one, from which its surroundings fill an image."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from kissgs.core.array_types import Bool, Float64, Int
from kissgs.core.splats import Splats

LEAF = 512
"""Largest number of Gaussians in a leaf of the tree, among which neighbours are searched."""

NEIGHBOURS = 4
"""The local scale is the distance within which 1 / NEIGHBOURS of the leaf's Gaussians lie."""

SAMPLED = 4
"""Stride of the leaf's Gaussians to which distances are measured."""

GAP = 0.2
"""Share of the distance expected on a surface of uniform density: if the nearest half, quarter or eighth of the
neighbours is nearer than that, the object has no more Gaussians, and their distance is used."""


def local_scale(splats: Splats) -> Float64[np.ndarray, " N"]:
    """Return the distance from each Gaussian to about its 128th neighbour, ``(N,)``, world units, positive.

    Distances are measured within the leaves of a k-d tree of equal counts, which adapts to parts of any size. For an
    object of fewer Gaussians, the distance is extrapolated as if its surface continued. The result is at least the
    Gaussian's own size.

    Args:
        splats: a finite scene.
    """
    means = splats.means.astype(np.float64)
    found = np.empty(len(means))
    for leaf in _leaves(means):
        points = means[leaf]
        squared = sum(
            np.square(axis[:, None] - axis[::SAMPLED]) for axis in points.T
        )  # accurate for near ones, unlike |a|² + |b|² - 2ab
        rank = min(squared.shape[1] // NEIGHBOURS, squared.shape[1] - 1)
        ranks = [rank, *(few for few in (rank // 2, rank // 4, rank // 8) if few > 1)]
        nearest = np.partition(squared, ranks, axis=1)[:, ranks] * (rank / np.maximum(ranks, 1))
        smallest = nearest.min(axis=1)
        found[leaf] = np.sqrt(np.where(smallest < GAP**2 * nearest[:, 0], smallest, nearest[:, 0]))
    sizes = np.exp(np.sort(splats.scales, axis=1)[:, 1].astype(np.float64))
    least = np.maximum(1e-6 * np.abs(means).max(axis=1, initial=0), 1e-12)  # about the resolution of float32 positions
    return np.maximum(np.maximum(found, sizes), least)


def _leaves(means: Float64[np.ndarray, "N 3"]) -> Iterator[Int[np.ndarray, " n"]]:
    """Yield the indices of each leaf: parts are split at the median of the longest side down to :data:`LEAF` points."""
    parts = [np.arange(len(means))] if len(means) else []
    while parts:
        part = parts.pop()
        if len(part) <= LEAF:
            yield part
            continue
        axis = int(np.ptp(means[part], axis=0).argmax())
        lower = _lower_half(means[part, axis])
        parts += [part[lower], part[~lower]]


def _lower_half(values: Float64[np.ndarray, " n"]) -> Bool[np.ndarray, " n"]:
    """Return a mask of the lower half, the first of equal values: argpartition's choice depends on the processor."""
    count = len(values) // 2
    middle = np.partition(values, count)[count]
    lower = values < middle
    lower[np.flatnonzero(values == middle)[: count - int(lower.sum())]] = True
    return lower
