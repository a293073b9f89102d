"""Partition of a scene into chunks of nearby Gaussians, in two passes over blocks that fit into memory."""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import numpy as np

from kissgs.core.array_types import Float32, Float64, Int64, UInt8, UInt16
from kissgs.core.origin import COARSE_SHARE, coarse_chances
from kissgs.core.signed_log import signed_log

LEAST = 512
"""Number of Gaussians in a chunk up to which it is not cut further."""


@dataclass(frozen=True, slots=True, eq=False)
class Cuts:
    """Axis-parallel cuts of space: a complete binary tree, whose leaves are the chunks.

    Attributes:
        depth: D; there are 2^D chunks.
        axes: ``(2^D,)`` axis of each inner node; node n has the children 2 n and 2 n + 1, the root is 1.
        values: ``(2^D,)`` coordinate of each cut; positions at and above it belong to the second child.
    """

    depth: int
    axes: UInt8[np.ndarray, " nodes"]
    values: Float64[np.ndarray, " nodes"]

    @classmethod
    def of(cls, positions: Float32[np.ndarray, "S 3"], depth: int) -> Cuts:
        """Cut each part at the median of its longest side, ``depth`` times."""
        axes, values = np.zeros(1 << depth, np.uint8), np.zeros(1 << depth)
        parts = {1: positions}
        for node in range(1, 1 << depth):
            part = parts.pop(node)
            axis = int(np.argmax(np.ptp(part, axis=0))) if len(part) else 0
            cut = float(np.median(part[:, axis])) if len(part) else 0.0
            above = part[:, axis] >= cut
            axes[node], values[node] = axis, cut
            parts[2 * node], parts[2 * node + 1] = part[~above], part[above]
        return cls(depth, axes, values)

    @property
    def chunks(self) -> int:
        """Number of chunks."""
        return 1 << self.depth

    def chunk_of(self, means: Float32[np.ndarray, "n 3"]) -> UInt16[np.ndarray, " n"]:
        """Return the chunk of each position."""
        node, rows = np.ones(len(means), np.int64), np.arange(len(means))
        for _ in range(self.depth):
            node = 2 * node + (means[rows, self.axes[node]] >= self.values[node])
        return (node - self.chunks).astype(np.uint16)


def coarse_in_chunks(rows: Float32[np.ndarray, "S 4"], cuts: Cuts) -> float:
    """Return the share of positions that are coarse in containers with a range of each axis, one for each chunk.

    ``rows`` are positions and visible sizes.
    """
    chunks, coarse = cuts.chunk_of(rows[:, :3]), 0.0
    for chunk in np.unique(chunks):
        part = rows[chunks == chunk].astype(np.float64)
        extents = np.ptp(signed_log(part[:, :3]), axis=0)
        coarse += float(coarse_chances(part[:, :3], part[:, 3], extents).sum())
    return coarse / max(len(rows), 1)


def cuts_without_coarse(sample: Float32[np.ndarray, "S 4"], cuts: Cuts, count: int) -> Cuts:
    """Return deeper cuts if positions are coarse in the chunks of ``cuts``, unless about as many are in small chunks.

    Args:
        sample: positions and visible sizes.
        cuts: the fewest cuts.
        count: number of Gaussians of the scene.
    """
    tried = [(coarse_in_chunks(sample, cuts), cuts)]
    while tried[-1][0] > COARSE_SHARE and count >> tried[-1][1].depth > LEAST:
        deeper = Cuts.of(sample[:, :3], tried[-1][1].depth + 1)
        tried.append((coarse_in_chunks(sample, deeper), deeper))
    if tried[-1][0] <= COARSE_SHARE:
        return tried[-1][1]
    most = 1.1 * min(share for share, _ in tried)
    return next(each for share, each in tried if share <= most)


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
