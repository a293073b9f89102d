"""Positions: their signed logarithm, the origin of a scene, and those that a container would move visibly."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np

from kissgs.core.array_types import Float, Float32, Float64, UInt8, UInt16
from kissgs.core.errors import InvalidContainerError
from kissgs.core.splats import MEAN_LIMIT, Splats, sampled_rows

# Signed logarithm, in which positions are stored, and its inverse.

MAX_SIGNED_LOG = 88.7  # largest signed logarithm of a position: exp of more exceeds float32


def signed_log(x: Float[np.ndarray, "..."]) -> Float64[np.ndarray, "..."]:
    """Return sign(x) ln(1 + |x|), in float64."""
    wide = x.astype(np.float64)
    return np.copysign(np.log1p(np.abs(wide)), wide)


def signed_exp(y: Float[np.ndarray, "..."]) -> Float64[np.ndarray, "..."]:
    """Return sign(y) (e^|y| - 1), in float64: the inverse of :func:`signed_log`."""
    wide = y.astype(np.float64)
    return np.copysign(np.expm1(np.abs(wide)), wide)


# Coarse positions: those that a container would move by more than can be seen, and cuts of space that mend it.

COARSE_ERROR = 0.25  # error of a position, in units of the Gaussian's size, above which it is coarse
COARSE_SHARE = 0.01  # share of coarse positions above which a scene has lost something
CONTAINER_LEVELS = (1 << 16) - 1  # steps between the smallest and the largest signed logarithm of positions

ORIGIN = '--origin auto (in Python origin="auto")'

STREAMED_REMEDY = "no origin helps here, but compressing into FOLDER/lod-meta.json does, whose parts have fine steps"
"""Remedy for coarse positions where no origin helps: streamed SOG."""

LEAST, MOST_CUTS = 32, 12
"""Number of Gaussians in a chunk, and of cuts one after another, up to which chunks are cut for finer positions."""

TRIED = 1 << 16  # largest number of Gaussians with which cuts are tried before they are named as a remedy


def coarse_share(errors: Float[np.ndarray, " N"], scales: Float32[np.ndarray, "N 3"]) -> float:
    """Return the share of Gaussians whose position is off by more than a quarter of their visible size. ``errors`` are
    those of the coordinate that is off most, world units."""
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
    ends ``low`` and ``high`` are signed logarithms; ``count`` is that of the scene, of which the rows are a sample."""
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

    def coarse_nearby() -> float:
        return float(coarse_chances(near, sizes, np.ptp(signed_log(near)).repeat(3)).mean())

    remedies: dict[str, Callable[[], float]] = {
        f"{ORIGIN} moves the scene there": coarse_nearby,
        STREAMED_REMEDY: lambda: coarse_in_parts(wide),
        f"compressing into FOLDER/lod-meta.json with {ORIGIN} gives its parts fine steps": partial(
            coarse_in_parts, near
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
    Positions and :func:`visible_sizes` are in world units, extents in signed logarithms."""
    half_steps = np.maximum(container_steps(positions, extents) / 2, 1e-300)
    return np.asarray(1 - np.minimum(COARSE_ERROR * sizes[:, None] / half_steps, 1).prod(axis=1))


def container_steps(
    positions: Float64[np.ndarray, "N 3"], extents: Float64[np.ndarray, " 3"]
) -> Float64[np.ndarray, "N 3"]:
    """Return a container's finest steps at positions, world units, with the rounding of the range's ends to float32."""
    rounded = np.spacing(np.abs(signed_log(positions)).astype(np.float32))
    return np.asarray((1 + np.abs(positions)) * (extents / CONTAINER_LEVELS + rounded))


def visible_sizes(scales: Float32[np.ndarray, "N 3"]) -> Float64[np.ndarray, " N"]:
    """Return the second of the three standard deviations: the smaller one that a flat Gaussian shows from its front."""
    return np.asarray(np.exp(np.sort(scales, axis=1)[:, 1].astype(np.float64)))


@dataclass(frozen=True, slots=True, eq=False)
class Cuts:
    """Axis-parallel cuts of space: a complete binary tree, whose leaves are the chunks."""

    depth: int
    axes: UInt8[np.ndarray, " nodes"]  # axis of each inner node; node n has the children 2 n and 2 n + 1, the root is 1
    values: Float64[np.ndarray, " nodes"]  # of each cut; positions at and above it belong to the second child

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
    ``rows`` are positions and visible sizes."""
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


# The origin of a scene, near which the steps of float32 and of containers are finer than any Gaussian.
#
# float32 has 24 bits, and a container 16 bits for the logarithm of a position: far from zero, as in geo-referenced
# scenes, both have coarse steps. So positions may be relative to :attr:`kissgs.Splats.origin`, which is float64.

Origin = tuple[float, float, float]

WORLD: Origin = (0.0, 0.0, 0.0)  # origin of a scene whose positions are those of the world


def world_positions(splats: Splats) -> Float64[np.ndarray, "N 3"]:
    """Return the positions in the world, float64 ``(N, 3)``."""
    return splats.means.astype(np.float64) + np.array(splats.origin)


def with_origin(splats: Splats, origin: Origin | None) -> Splats:
    """Return the scene with positions relative to another origin; None: to its own."""
    if origin in (None, splats.origin):
        return splats
    means = (world_positions(splats) - np.array(origin)).astype(np.float32)
    return replace(splats, means=means, origin=origin)


def in_world(splats: Splats) -> Splats:
    """Return the scene with the positions of the world where float32 can hold them, else the same scene."""
    fits = splats.origin != WORLD and origin_for(world_positions(splats), splats.scales) == WORLD
    return with_origin(splats, WORLD) if fits else splats


def centred(splats: Splats) -> Splats:
    """Return the scene with its origin in its middle, that of :func:`middle_of`."""
    return with_origin(splats, middle_of([world_positions(splats)], len(splats)))


def middle_of(blocks: Iterable[Float64[np.ndarray, "n 3"]], count: int) -> Origin:
    """Return the whole numbers nearest to the median of :func:`sampled_rows` of ``count`` positions that are finite."""
    some = sampled_rows(blocks, count)[:, :3]
    some = some[np.isfinite(some).all(axis=1)]
    x, y, z = np.rint(np.median(some, axis=0)) + 0.0 if len(some) else WORLD
    return float(x), float(y), float(z)


def from_world(splats: Splats, positions: Float64[np.ndarray, "N 3"], origin: Origin | None = None) -> Splats:
    """Return the scene at positions of the world, as float32 relative to an origin. Without an origin it is that of
    :func:`origin_for`. A note says if float32 is too coarse for objects so far apart."""
    origin = origin_for(positions, splats.scales) if origin is None else origin
    relative = positions - np.array(origin)
    with np.errstate(over="ignore", invalid="ignore"):
        means = relative.astype(np.float32)
        share = _rounded_share(relative, splats.scales)
    notes = splats.notes
    if share > COARSE_SHARE:
        notes = (*notes, f"positions are rounded to float32, too coarsely for {share:.0%} of the Gaussians")
    return replace(splats, means=means, origin=origin, notes=notes)


def origin_for(positions: Float64[np.ndarray, "N 3"], scales: Float32[np.ndarray, "N 3"]) -> Origin:
    """Return the origin for positions as float32: that of the world unless they would be coarse, else their middle."""
    return middle_of([positions], len(positions)) if _rounded_share(positions, scales) > COARSE_SHARE else WORLD


def _rounded_share(positions: Float64[np.ndarray, "N 3"], scales: Float32[np.ndarray, "N 3"]) -> float:
    """Return the share of positions that are coarse as float32; those that overflow it are left out."""
    with np.errstate(over="ignore", invalid="ignore"):
        errors = np.abs(positions - positions.astype(np.float32)).max(axis=1, initial=0)
    finite = np.isfinite(errors)
    return coarse_share(errors[finite], scales[finite])


def relative_to(origin: Origin) -> str:
    """Return the clause that says where the positions of a scene are."""
    return "positions are relative to the point ({:,.0f}, {:,.0f}, {:,.0f})".format(*origin)


def recorded(origin: Origin, view: Mapping[str, Any] | None = None) -> dict[str, Any]:
    """Return entries of a container's metadata under the key "kissgs": the view; the origin, if not the world's."""
    return {**({} if origin == WORLD else {"origin": list(origin)}), **({} if view is None else {"view": view})}


def read_origin(document: Mapping[str, Any], name: str) -> Origin:
    """Return the origin that the metadata ``document`` of the file ``name`` records."""
    own = document.get("kissgs")
    found = own.get("origin", WORLD) if isinstance(own, dict) else WORLD
    try:
        x, y, z = (float(value) if type(value) in (int, float) else math.nan for value in found)
    except (TypeError, ValueError, OverflowError):
        x = y = z = math.nan
    if not all(abs(value) <= MEAN_LIMIT for value in (x, y, z)):
        raise InvalidContainerError(f"{name}: kissgs.origin is not three numbers up to 1e15; export the scene again")
    return x, y, z
