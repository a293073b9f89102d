"""Levels of detail of one chunk: each leaf merged to half its Gaussians, again and again."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from kissgs.compaction.covariance_kernels import covariances_of
from kissgs.compaction.merging import merged_levels
from kissgs.core.array_types import Float64
from kissgs.core.progress import Progress, silent
from kissgs.core.splats import Splats, concatenate
from kissgs.core.threads import Workers
from kissgs.streaming.level_errors import level_errors
from kissgs.streaming.partition import leaf_groups

MERGING = 0.7
"""Share of merging in the time for the levels of a chunk; the rest measures their errors."""


@dataclass(frozen=True, slots=True, eq=False)
class ChunkLevels:
    """The levels of a chunk.

    Attributes:
        levels: the Gaussians of each level, the finest first, leaf after leaf.
        counts: number of Gaussians of each leaf, per level.
        bounds: ``(leaves, 2, 3)`` lowest and highest corner of each leaf: the boxes of one standard deviation around
            the Gaussians of all its levels.
        errors: for each leaf, the error of each level (:func:`kissgs.streaming.level_errors.level_errors`).
    """

    levels: list[Splats]
    counts: list[list[int]]
    bounds: Float64[np.ndarray, "leaves 2 3"]
    errors: list[list[float]]


def level_count(count: int, coarsest: int) -> int:
    """Return how many levels a scene has until the coarsest, by halving, has at most ``coarsest`` Gaussians."""
    return 1 + max(0, int(np.ceil(np.log2(max(count, 1) / coarsest))))


def chunk_levels(chunk: Splats, levels: int, leaf: int, threads: int, progress: Progress = silent) -> ChunkLevels:
    """Split a chunk into leaves and merge each to half its Gaussians for every further level.

    Args:
        chunk: the Gaussians, clean, at least one.
        levels: number of levels, the finest included.
        leaf: largest number of Gaussians in a leaf.
        threads: number of threads; 0 means one per processor. The result does not depend on it.
        progress: receives the stage "merge".
    """
    order, edges = leaf_groups(chunk.means, leaf)
    with Workers(threads) as pool:
        leaves = pool.map(
            lambda at: _leaf_levels(chunk.select(order[edges[at] : edges[at + 1]]), levels),
            range(len(edges) - 1),
            lambda fraction: progress("merge", MERGING * fraction),
        )
        errors = pool.map(level_errors, leaves, lambda fraction: progress("merge", MERGING + (1 - MERGING) * fraction))
    return ChunkLevels(
        [concatenate([own[level] for own in leaves]) for level in range(levels)],
        [[len(own[level]) for own in leaves] for level in range(levels)],
        np.stack([bounds(concatenate(own)) for own in leaves]),
        errors,
    )


def _leaf_levels(leaf: Splats, levels: int) -> list[Splats]:
    counts = [max(1, -(-len(leaf) >> level)) for level in range(1, levels)]
    return [leaf, *merged_levels(leaf, counts, threads=1)]


def bounds(splats: Splats) -> Float64[np.ndarray, "2 3"]:
    """Return the corners of the box around the boxes of one standard deviation of all Gaussians."""
    covariances = np.empty((len(splats), 6))
    covariances_of(splats.quats, splats.scales, 0, len(splats), covariances)
    reach = np.sqrt(covariances[:, [0, 3, 5]])
    means = splats.means.astype(np.float64)
    return np.stack([(means - reach).min(axis=0), (means + reach).max(axis=0)])
