"""Lists of the Gaussians that touch an image and each of its tiles, built in parts by threads.

The result does not depend on the number of parts.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable
from dataclasses import dataclass
from typing import TypeVar

import numpy as np

from kissgs.core.array_types import Float32, Float64, Int32, Int64, UInt16, UInt32
from kissgs.core.errors import UnsupportedError
from kissgs.core.splats import Splats
from kissgs.core.threads import Workers
from kissgs.rendering import constants
from kissgs.rendering.camera import Camera
from kissgs.rendering.cpu import projection, shading, tiles

R = TypeVar("R")

MAX_PAIRS = 2**31 - 1
"""Largest number of pairs of a footprint and a tile that it touches: the lists are int32."""

MAX_MEMBERS = 2**24 - 1
"""Largest number of footprints in one tile: kernels store their indices as float32."""

PARTS_PER_THREAD = 4
"""Number of parts per thread; parts differ in cost, and smaller ones balance the load."""


@dataclass(frozen=True, slots=True)
class Footprints:
    """The M Gaussians that touch an image, in the order of the scene, in rows of arrays for all N.

    Attributes:
        parts: ranges of rows that hold footprints; other rows are not set.
        visible: ``(N,)`` index of the Gaussian of each row.
        depths: ``(N,)`` bits of each footprint's depth, a positive float32; they sort as depths do.
        records: ``(N, 11)``, see :func:`kissgs.rendering.cpu.projection.project`.
    """

    parts: list[tuple[int, int]]
    visible: Int32[np.ndarray, " N"]
    depths: UInt32[np.ndarray, " N"]
    records: Float32[np.ndarray, "N 11"]

    @property
    def count(self) -> int:
        """The number M of footprints."""
        return sum(last - first for first, last in self.parts)

    def rows(self) -> Int64[np.ndarray, " M"]:
        """Return the rows that hold footprints, ascending."""
        return np.concatenate([np.arange(first, last) for first, last in self.parts])


@dataclass(frozen=True, slots=True)
class TileLists:
    """Lists of the footprints that touch each tile.

    Attributes:
        columns: number of tiles in a row of tiles.
        starts: ``(tiles + 1,)`` index of the first member of each tile.
        members: ``(P,)`` rows of the footprints, tile after tile, front to back.
        spans: ``(P,)`` rows of pixels that each member touches, see :func:`kissgs.rendering.cpu.tiles.fill_tiles`.
    """

    columns: int
    starts: Int64[np.ndarray, " tiles_1"]
    members: Int32[np.ndarray, " P"]
    spans: UInt16[np.ndarray, " P"]


@dataclass(frozen=True, slots=True)
class Slots:
    """Numbers of the members of some tiles, footprint by footprint, so that sums over tiles have a fixed order.

    Attributes:
        of: ``(S,)`` slot of each member of these tiles.
        rows: ``(T,)`` rows of the footprints that are members, ascending.
        first: ``(N + 1,)`` first slot of each row; a row's slots end where the next one's begin.
    """

    of: Int32[np.ndarray, " S"]
    rows: Int32[np.ndarray, " T"]
    first: Int32[np.ndarray, " N_1"]


def projection_constants(splats: Splats, camera: Camera) -> Float64[np.ndarray, "6"]:
    """Return the constants of projection, as kernels take them."""
    margin, alpha_min = constants.FRUSTUM_MARGIN, constants.ALPHA_MIN
    antialiased = float(splats.antialiased)
    return np.array([constants.NEAR, constants.FAR, camera.dilation, margin, alpha_min, antialiased], np.float64)


def find_footprints(splats: Splats, camera: Camera, pool: Workers) -> Footprints:
    """Project and shade all Gaussians; return those that touch the image."""
    count = len(splats)
    visible, depths = np.empty(count, np.int32), np.empty(count, np.float32)
    records = np.empty((count, 11), np.float32)

    def part(first: int, last: int) -> tuple[int, int]:
        found = projection.project(
            splats.means,
            splats.quats,
            splats.scales,
            splats.opacities,
            first,
            last,
            camera.viewmat,
            camera.K,
            camera.width,
            camera.height,
            projection_constants(splats, camera),
            visible,
            depths,
            records,
        )
        shading.shade(splats.means, splats.sh0, splats.shN, camera.position, visible, first, first + found, records)
        return first, first + found

    return Footprints(each_part(part, even(count, pool), pool), visible, depths.view(np.uint32), records)


def sort_into_tiles(footprints: Footprints, camera: Camera, pool: Workers) -> TileLists:
    """Return lists of the footprints that touch each tile, nearest first.

    Raises:
        UnsupportedError: there are more than :data:`MAX_PAIRS`, or more than :data:`MAX_MEMBERS` in one tile.
    """
    columns, rows = -(-camera.width // constants.TILE), -(-camera.height // constants.TILE)
    records, depths = footprints.records, footprints.depths

    def count(part: tuple[int, int]) -> Int64[np.ndarray, " tiles"]:
        per_tile = np.zeros(columns * rows, np.int64)
        tiles.count_tiles(records, *part, columns, rows, per_tile)
        return per_tile

    per_part = np.stack(pool.map(count, footprints.parts))
    starts = _running_sum(per_part.sum(axis=0))
    _check_lists(starts)
    keys, members = np.empty(starts[-1], np.uint32), np.empty(starts[-1], np.int32)
    spans = np.empty(starts[-1], np.uint16)
    ends = starts[:-1] + np.cumsum(per_part, axis=0) - per_part

    def fill(n: int) -> None:
        tiles.fill_tiles(records, depths, *footprints.parts[n], columns, rows, ends[n], keys, members, spans)

    pool.map(fill, range(len(footprints.parts)))
    lists = TileLists(columns, starts, members, spans)
    each_part(lambda a, b: tiles.sort_tiles(starts, a, b, keys, members, spans), even_tiles(lists, pool), pool)
    return lists


def number_slots(footprints: Footprints, lists: TileLists, first: int, last: int) -> Slots:
    """Return the slots of the members of tiles ``first`` to ``last`` (exclusive)."""
    members = lists.members[lists.starts[first] : lists.starts[last]]
    from_slot, of = np.empty(len(footprints.records) + 1, np.int32), np.empty(len(members), np.int32)
    rows = np.empty(min(len(members), len(footprints.records)), np.int32)
    return Slots(of, rows[: tiles.number_slots(members, from_slot, of, rows)], from_slot)


def _check_lists(starts: Int64[np.ndarray, " tiles_1"]) -> None:
    if starts[-1] > MAX_PAIRS:
        raise UnsupportedError(
            f"this view has {starts[-1]:,} pairs of a Gaussian and a tile of the image, more than {MAX_PAIRS:,}; "
            "render a smaller image (sensitivity_view_size where an encoder measures)"
        )
    longest = int(np.diff(starts).max())
    if longest > MAX_MEMBERS:
        raise UnsupportedError(
            f"{longest:,} Gaussians touch the same 16x16 pixels of this view, more than {MAX_MEMBERS:,}; render "
            "a larger image (sensitivity_view_size where an encoder measures), or move the camera nearer"
        )


def _running_sum(counts: Int64[np.ndarray, " n"]) -> Int64[np.ndarray, " n_1"]:
    total = np.zeros(len(counts) + 1, np.int64)
    np.cumsum(counts, out=total[1:])
    return total


def even(count: int, pool: Workers) -> Int64[np.ndarray, " edges"]:
    """Return the edges of at least one part of about equal numbers of items; no part is empty if there are items."""
    parts = max(1, min(pool.threads * PARTS_PER_THREAD, count))
    return np.linspace(0, count, parts + 1).astype(np.int64)


def even_tiles(lists: TileLists, pool: Workers, first: int = 0, last: int | None = None) -> Int64[np.ndarray, " edges"]:
    """Return the edges of parts of tiles of about equal cost: the number of members plus a constant per tile.

    Args:
        lists: lists of all tiles.
        pool: threads.
        first: first tile.
        last: end of the tiles, exclusive; None for all.
    """
    last = len(lists.starts) - 1 if last is None else last
    work = lists.starts[first : last + 1] + 8 * np.arange(last - first + 1)
    edges = np.searchsorted(work, np.linspace(work[0], work[-1], pool.threads * PARTS_PER_THREAD + 1))
    edges[0], edges[-1] = 0, last - first
    return first + np.unique(edges)


def each_part(work: Callable[[int, int], R], edges: Int64[np.ndarray, " edges"], pool: Workers) -> list[R]:
    """Call ``work`` with the edges (first, last) of each part in threads; return the results in order."""
    return pool.map(lambda pair: work(int(pair[0]), int(pair[1])), list(itertools.pairwise(edges)))
