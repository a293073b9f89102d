"""Partition of a scene into chunks of nearby Gaussians, in two passes over blocks that fit into memory."""

from __future__ import annotations

import itertools

import numpy as np

from kissgs.core.array_types import Float32, Int64


def chunk_depth(count: int, chunk: int) -> int:
    """Return the number of cuts one after another until chunks of a scene have at most about ``chunk`` Gaussians."""
    return max(0, int(np.ceil(np.log2(max(count, 1) / chunk))))


def leaf_groups(
    means: Float32[np.ndarray, "n 3"], leaf: int
) -> tuple[Int64[np.ndarray, " n"], Int64[np.ndarray, " e"]]:
    """Split a chunk into leaves of at most ``leaf`` Gaussians of equal counts.

    Returns:
        Indices of the Gaussians, leaf after leaf, ascending within each; and the edges of the leaves in it.
    """
    from kissgs.rendering.cpu.neighbours import split_into_leaves

    order, edges = np.arange(len(means), dtype=np.int32), np.empty(4 * len(means) // leaf + 2, np.int64)
    leaves = split_into_leaves(np.ascontiguousarray(means.T), leaf, order, edges)
    edges = edges[: leaves + 1]
    for first, last in itertools.pairwise(edges):
        order[first:last].sort()
    return order.astype(np.int64), edges
