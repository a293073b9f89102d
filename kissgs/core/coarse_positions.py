"""Coarse positions: those that a container would move by more than can be seen, and cuts of space that mend it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from kissgs.core.array_types import Float, Float32, Float64, UInt8, UInt16
from kissgs.core.signed_log import signed_log

COARSE_ERROR = 0.25
"""Error of a position, in units of the Gaussian's size, above which it is coarse."""

COARSE_SHARE = 0.01
"""Share of coarse positions above which a scene has lost something."""

CONTAINER_LEVELS = (1 << 16) - 1
"""Steps between the smallest and the largest signed logarithm of a container's positions."""

ORIGIN = '--origin auto (in Python origin="auto")'

STREAMED_REMEDY = "no origin helps here, but compressing into FOLDER/lod-meta.json does, whose parts have fine steps"
"""Remedy for coarse positions where no origin helps: streamed SOG."""

LEAST, MOST_CUTS = 32, 12
"""Number of Gaussians in a chunk, and of cuts one after another, up to which chunks are cut for finer positions."""

TRIED = 1 << 16
"""Largest number of Gaussians with which cuts are tried before they are named as a remedy."""


def coarse_share(errors: Float[np.ndarray, " N"], scales: Float32[np.ndarray, "N 3"]) -> float:
    """Return the share of Gaussians whose position is off by more than a quarter of their visible size.

    ``errors`` are those of the coordinate that is off most, world units.
    """
    return float((errors > COARSE_ERROR * visible_sizes(scales)).mean()) if len(errors) else 0.0


def coarse_note(
    means: Float32[np.ndarray, "N 3"],
    scales: Float32[np.ndarray, "N 3"],
    low: Float32[np.ndarray, " 3"],
    high: Float32[np.ndarray, " 3"],
    count: int,
) -> str:
    """Return a sentence with the remedy if a container's finest steps are too coarse for a scene, else an empty string.

    The planner's own steps may be coarser for small Gaussians, where it chooses so: that is no loss by distance. The
    ends ``low`` and ``high`` are signed logarithms; ``count`` is that of the scene, of which the rows are a sample.
    """
    wide = means.astype(np.float64)
    extents, sizes = high.astype(np.float64) - low, visible_sizes(scales)
    chances = coarse_chances(wide, sizes, extents)
    share = float(chances.mean()) if len(chances) else 0.0
    if share <= COARSE_SHARE:
        return ""
    step = float(np.median(container_steps(wide, extents).max(axis=1)[chances > 0]))
    near = wide - np.rint(np.median(wide, axis=0))

    def coarse_in_parts(positions: Float64[np.ndarray, "N 3"]) -> float:
        rows = np.column_stack([positions, sizes]).astype(np.float32)[:: 1 + len(sizes) // TRIED]
        return coarse_in_chunks(rows, cuts_without_coarse(rows, Cuts.of(rows[:, :3], 0), count))

    remedies: dict[str, Callable[[], float]] = {
        f"{ORIGIN} moves the scene there": lambda: float(
            coarse_chances(near, sizes, np.ptp(signed_log(near)).repeat(3)).mean()
        ),
        STREAMED_REMEDY: lambda: coarse_in_parts(wide),
        f"compressing into FOLDER/lod-meta.json with {ORIGIN} gives its parts fine steps": lambda: coarse_in_parts(
            near
        ),
    }
    helpful = (name for name, coarse in remedies.items() if coarse() <= COARSE_SHARE)
    remedy = next(helpful, f"compress objects so far apart into files of their own, with {ORIGIN}")
    return (
        f"positions have steps of about {step:.2g}, too coarse for {share:.0%} of the Gaussians, because a container "
        f"has fine steps only near the origin: {remedy}"
    )


def coarse_chances(
    positions: Float64[np.ndarray, "N 3"], sizes: Float64[np.ndarray, " N"], extents: Float64[np.ndarray, " 3"]
) -> Float64[np.ndarray, " N"]:
    """Return the chance of each position to be coarse in a container: errors are even, up to half a step of each axis.

    Positions and :func:`visible_sizes` are in world units, extents in signed logarithms.
    """
    half_steps = np.maximum(container_steps(positions, extents) / 2, 1e-300)
    chances: Float64[np.ndarray, " N"] = 1 - np.minimum(COARSE_ERROR * sizes[:, None] / half_steps, 1).prod(axis=1)
    return chances


def container_steps(
    positions: Float64[np.ndarray, "N 3"], extents: Float64[np.ndarray, " 3"]
) -> Float64[np.ndarray, "N 3"]:
    """Return a container's finest steps at positions, world units, with the rounding of the range's ends to float32."""
    rounded = np.spacing(np.abs(signed_log(positions)).astype(np.float32))
    steps: Float64[np.ndarray, "N 3"] = (1 + np.abs(positions)) * (extents / CONTAINER_LEVELS + rounded)
    return steps


def visible_sizes(scales: Float32[np.ndarray, "N 3"]) -> Float64[np.ndarray, " N"]:
    """Return the second of the three standard deviations: the smaller one that a flat Gaussian shows from its front."""
    sizes: Float64[np.ndarray, " N"] = np.exp(np.sort(scales, axis=1)[:, 1].astype(np.float64))
    return sizes


@dataclass(frozen=True, slots=True, eq=False)
class Cuts:
    """Axis-parallel cuts of space: a complete binary tree, whose leaves are the chunks."""

    depth: int
    axes: UInt8[np.ndarray, " nodes"]
    """Axis of each inner node; node n has the children 2 n and 2 n + 1, the root is 1."""
    values: Float64[np.ndarray, " nodes"]
    """Coordinate of each cut; positions at and above it belong to the second child."""

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
    if not len(rows):
        return 0.0
    chunks, coarse = cuts.chunk_of(rows[:, :3]), 0.0
    order = np.argsort(chunks, kind="stable")
    for part in np.split(rows[order].astype(np.float64), np.flatnonzero(np.diff(chunks[order])) + 1):
        extents = np.ptp(signed_log(part[:, :3]), axis=0)
        coarse += float(coarse_chances(part[:, :3], part[:, 3], extents).sum())
    return coarse / len(rows)


def cuts_without_coarse(sample: Float32[np.ndarray, "S 4"], cuts: Cuts, count: int) -> Cuts:
    """Return deeper cuts if positions are coarse in the chunks of these, unless about as many are in small chunks."""
    tried = [(coarse_in_chunks(sample, cuts), cuts)]
    while tried[-1][0] > COARSE_SHARE and tried[-1][1].depth < MOST_CUTS and count >> tried[-1][1].depth > LEAST:
        deeper = Cuts.of(sample[:, :3], tried[-1][1].depth + 1)
        tried.append((coarse_in_chunks(sample, deeper), deeper))
    if tried[-1][0] <= COARSE_SHARE:
        return tried[-1][1]
    most = 1.1 * min(share for share, _ in tried)
    return next(each for share, each in tried if share <= most)
