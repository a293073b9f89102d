"""How far apart Gaussians lie, place by place: the distance from which a Gaussian's surroundings fill an image."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from kissgs.core.array_types import Bool, Float64, Int
from kissgs.core.splats import Splats

LEAF = 512
"""Gaussians among which neighbours are sought, at most."""

NEIGHBOURS = 4
"""The distance is that within which one in so many of the leaf's Gaussians lies."""

SAMPLED = 4
"""One in so many of a leaf's Gaussians is measured to."""

GAP = 0.2
"""Where fewer neighbours lie so much nearer than on a surface of even density, there are no more in the same object."""


def local_scale(splats: Splats) -> Float64[np.ndarray, " N"]:
    """Distance from each Gaussian to about its 128th neighbour, world units, positive.

    A k-d tree with equal numbers in its leaves adapts to scenes whose parts differ by any factor in size; distances are
    measured within a leaf. Where an object has fewer Gaussians, it is the distance at which there would be so many if
    its surface went on. A Gaussian larger than its neighbourhood counts by its own size.

    Args:
        splats: finite.
    """
    means = splats.means.astype(np.float64)
    found = np.empty(len(means))
    for leaf in _leaves(means):
        points = means[leaf]
        squared = sum(np.square(axis[:, None] - axis[::SAMPLED]) for axis in points.T)  # keeps the digits of near ones
        rank = min(squared.shape[1] // NEIGHBOURS, squared.shape[1] - 1)
        ranks = [rank, *(few for few in (rank // 2, rank // 4, rank // 8) if few > 1)]
        nearest = np.partition(squared, ranks, axis=1)[:, ranks] * (rank / np.maximum(ranks, 1))
        least = nearest.min(axis=1)
        found[leaf] = np.sqrt(np.where(least < GAP**2 * nearest[:, 0], least, nearest[:, 0]))
    sizes = np.exp(np.sort(splats.scales, axis=1)[:, 1].astype(np.float64))
    least = np.maximum(1e-6 * np.abs(means).max(axis=1, initial=0), 1e-12)  # float32 positions are hardly finer
    return np.maximum(np.maximum(found, sizes), least)


def _leaves(means: Float64[np.ndarray, "N 3"]) -> Iterator[Int[np.ndarray, " n"]]:
    """Split at the median of the longest side until no part has more than :data:`LEAF` points."""
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
    """Which values are the lower half, of equal ones the first: argpartition's choice depends on the processor."""
    count = len(values) // 2
    middle = np.partition(values, count)[count]
    lower = values < middle
    lower[np.flatnonzero(values == middle)[: count - int(lower.sum())]] = True
    return lower
