"""Lists of the Gaussians that touch an image and each of its tiles, front to back, built in parts by threads."""

from __future__ import annotations

import itertools
from collections.abc import Callable
from dataclasses import dataclass
from typing import TypeVar

import numpy as np
from numba import njit

from kissgs.core.array_types import Float32, Float64, Int32, Int64, UInt16, UInt32
from kissgs.core.errors import UnsupportedError
from kissgs.core.numba_kernels import compiled
from kissgs.core.resources import Workers
from kissgs.core.splats import Splats
from kissgs.rendering import constants
from kissgs.rendering.camera import Camera
from kissgs.rendering.cpu import projection, shading

# Numba kernels of tiles: lists of the footprints that touch each tile, front to back.


@njit(nogil=True, error_model="numpy")
def _sort_list(keys: np.ndarray, rows: np.ndarray, spans: np.ndarray, scratch: np.ndarray, counts: np.ndarray) -> None:
    """Sort the members of one tile by their keys, stably.

    Args:
        keys: ``(n,)`` uint32; unchanged.
        rows: ``(n,)`` footprint of each member; sorted.
        spans: ``(n,)`` span of each member; sorted.
        scratch: ``(4, n)`` uint32 or longer.
        counts: ``(2048,)`` int64.
    """
    count = keys.shape[0]
    order, other = scratch[0], scratch[1]
    for i in range(count):
        order[i] = np.uint32(i)
    if count <= 32:
        for i in range(1, count):
            key, j = keys[i], i
            while j > 0 and keys[order[j - 1]] > key:
                order[j] = order[j - 1]
                j -= 1
            order[j] = np.uint32(i)
    else:
        differing = np.uint32(0)
        for i in range(1, count):
            differing |= keys[i] ^ keys[0]
        for shift in range(0, 33, 11):
            if (differing >> np.uint32(shift)) & np.uint32(2047) == 0:
                continue
            counts[:] = 0
            for i in range(count):
                counts[(keys[i] >> np.uint32(shift)) & np.uint32(2047)] += 1
            total = 0
            for digit in range(2048):
                total, counts[digit] = total + counts[digit], total
            for i in range(count):
                digit = (keys[order[i]] >> np.uint32(shift)) & np.uint32(2047)
                other[counts[digit]] = order[i]
                counts[digit] += 1
            order, other = other, order
    moved_rows, moved_spans = scratch[2], scratch[3]
    for i in range(count):
        moved_rows[i], moved_spans[i] = rows[i], spans[i]
    for i in range(count):
        rows[i], spans[i] = moved_rows[order[i]], moved_spans[order[i]]


@compiled("void(int64[::1], int64, int64, uint32[::1], int32[::1], uint16[::1])")
def sort_tiles(
    starts: np.ndarray, first: int, last: int, keys: np.ndarray, members: np.ndarray, spans: np.ndarray
) -> None:
    """Sort the members of tiles ``first`` to ``last`` (exclusive) by their keys; members of equal keys stay in order.

    Args:
        starts: ``(tiles + 1,)`` index of the first member of each tile.
        first: first tile.
        last: end of the tiles, exclusive.
        keys: sort key of each member, for which the bits of a positive float32 serve; unchanged.
        members: footprint of each member; sorted.
        spans: span of each member; sorted.
    """
    longest = 0
    for tile in range(first, last):
        longest = max(longest, starts[tile + 1] - starts[tile])
    scratch, counts = np.empty((4, longest), np.uint32), np.empty(2048, np.int64)
    for tile in range(first, last):
        a, b = starts[tile], starts[tile + 1]
        _sort_list(keys[a:b], members[a:b], spans[a:b], scratch, counts)


@compiled("int64(int32[::1], int32[::1], int32[::1], int32[::1])")
def fill_slots(members: np.ndarray, first: np.ndarray, slots: np.ndarray, rows: np.ndarray) -> int:
    """Number members footprint by footprint, and in their order within each.

    Args:
        members: footprint of each member, 0 to R - 1.
        first: out, ``(R + 1,)`` first slot of each footprint, and the number of members.
        slots: out, slot of each member.
        rows: out, the footprints that have a member, ascending.

    Returns:
        The number of footprints that have a member.
    """
    count = first.shape[0] - 1
    first[:] = 0
    for row in members:
        first[row] += 1
    total, found = 0, 0
    for row in range(count):
        number = first[row]
        first[row] = total
        total += number
        if number > 0:
            rows[found] = row
            found += 1
    for i in range(members.shape[0]):
        row = members[i]
        slots[i] = first[row]
        first[row] += 1
    # Each entry is now the first slot of the next footprint.
    for row in range(count, 0, -1):
        first[row] = first[row - 1]
    first[0] = 0
    return found


@njit(nogil=True, error_model="numpy")
def _clamp(value: float, top: int) -> int:
    """Return ``value`` rounded down and clamped to 0 to ``top``; 0 for NaN. Safe for values beyond int64."""
    if not value > 0:
        return 0
    return int(value) if value < top else top


@njit(nogil=True, error_model="numpy")
def _columns(records: np.ndarray, n: int, row: int, columns: int) -> tuple[int, int]:
    """Return the first and last (exclusive) tile that footprint ``n`` touches in a row of tiles.

    The footprint is the disc u² + v² <= tau. In a row of tiles, v is in an interval; x = (u - k v) / l0 is largest at
    v = -k √tau / √(1 + k²) or at the interval's nearer end.
    """
    centre_x, centre_y = np.float64(records[n, 0]), np.float64(records[n, 1])
    l0, l1, l2 = np.float64(records[n, 2]), np.float64(records[n, 3]), np.float64(records[n, 4])
    tau = np.float64(records[n, 9]) * 1.0001 + 1e-5  # float32 alphas may exceed the exact ones by rounding
    radius = np.sqrt(tau)
    low = max((16 * row + 0.5 - centre_y) * l2, -radius)
    high = min((16 * row + 15.5 - centre_y) * l2, radius)
    if not low <= high:
        return 0, 0
    k = l1 / l2
    extreme = k * radius / np.sqrt(1.0 + k * k)
    v = min(max(-extreme, low), high)
    right = centre_x + (np.sqrt(max(tau - v * v, 0.0)) - k * v) / l0
    v = min(max(extreme, low), high)
    left = centre_x - (np.sqrt(max(tau - v * v, 0.0)) + k * v) / l0
    return _clamp(np.ceil((left - 15.51) / 16), columns), _clamp(np.floor((right - 0.49) / 16) + 1, columns)


@njit(nogil=True, error_model="numpy")
def _box(records: np.ndarray, n: int, columns: int, rows: int) -> tuple[int, int, int, int]:
    """Return the first and last (exclusive) column and row of tiles that footprint ``n`` touches."""
    x, y = np.float64(records[n, 0]), np.float64(records[n, 1])
    l0, l1, l2 = np.float64(records[n, 2]), np.float64(records[n, 3]), np.float64(records[n, 4])
    width = np.sqrt((np.float64(records[n, 9]) * 1.0001 + 1e-5) * (l1 * l1 + l2 * l2)) / (l0 * l2)
    height = np.float64(records[n, 10]) * 1.0001 + 0.01
    return (
        _clamp(np.ceil((x - width - 15.51) / 16), columns),
        _clamp(np.floor((x + width - 0.49) / 16) + 1, columns),
        _clamp(np.ceil((y - height - 15.5) / 16), rows),
        _clamp(np.floor((y + height - 0.5) / 16) + 1, rows),
    )


@njit(nogil=True, error_model="numpy")
def _span(records: np.ndarray, n: int, column: int, row: int) -> int:
    """Return the first and last (exclusive) row of pixels that a footprint touches in a tile, as ``32 * first + last``.

    Within the tile's columns, the footprint is highest at its own highest point or at the nearer side of the tile.
    """
    x = 16 * column - np.float64(records[n, 0])
    y = 16 * row - np.float64(records[n, 1])
    l0, l1, l2 = np.float64(records[n, 2]), np.float64(records[n, 3]), np.float64(records[n, 4])
    tau = np.float64(records[n, 9]) * 1.0001 + 1e-5
    reach = np.sqrt(tau) / l2
    top_offset = l1 * reach / l0
    a = l1 * l1 + l2 * l2
    dx = min(max(-top_offset, x + 0.5), x + 15.5)
    b = l0 * l1 * dx
    low = (np.sqrt(max(b * b - a * (l0 * l0 * dx * dx - tau), 0.0)) - b) / a
    dx = min(max(top_offset, x + 0.5), x + 15.5)
    b = l0 * l1 * dx
    high = (np.sqrt(max(b * b - a * (l0 * l0 * dx * dx - tau), 0.0)) + b) / a
    return 32 * _clamp(np.ceil(-high - y - 0.51), 16) + _clamp(np.floor(low - y - 0.49) + 1, 16)


@njit(nogil=True, error_model="numpy")
def _whole_span(records: np.ndarray, n: int, row: int) -> int:
    """Return the span of a footprint that lies within one column of tiles, see :func:`_span`."""
    y = 16 * row - np.float64(records[n, 1])
    reach = np.float64(records[n, 10]) * 1.0001 + 0.01
    return 32 * _clamp(np.ceil(-reach - y - 0.51), 16) + _clamp(np.floor(reach - y - 0.49) + 1, 16)


@compiled("void(float32[:, ::1], int64, int64, int64, int64, int64[::1])")
def count_tiles(records: np.ndarray, first: int, last: int, columns: int, rows: int, per_tile: np.ndarray) -> None:
    """Add the number of footprints ``first`` to ``last`` (exclusive) that touch each tile to ``per_tile``."""
    for n in range(first, last):
        left, right, top, bottom = _box(records, n, columns, rows)
        several = right - left > 1 and bottom - top > 1
        for row in range(top, bottom):
            if several:
                left, right = _columns(records, n, row, columns)
            for column in range(left, right):
                per_tile[row * columns + column] += 1


@compiled(
    "void(float32[:, ::1], uint32[::1], int64, int64, int64, int64, int64[::1], uint32[::1], int32[::1], uint16[::1])"
)
def fill_tiles(
    records: np.ndarray,
    depths: np.ndarray,
    first: int,
    last: int,
    columns: int,
    rows: int,
    ends: np.ndarray,
    keys: np.ndarray,
    members: np.ndarray,
    spans: np.ndarray,
) -> None:
    """Write footprints ``first`` to ``last`` (exclusive) into the lists of the tiles that they touch.

    Args:
        records: ``(R, 11)`` records of :func:`kissgs.rendering.cpu.projection.project`.
        depths: ``(R,)`` bits of each footprint's depth.
        first: first footprint.
        last: end of the footprints, exclusive.
        columns: number of tiles in a row of tiles.
        rows: number of rows of tiles.
        ends: index at which the list of each tile continues; advanced.
        keys: out, depth of each entry.
        members: out, footprint of each entry, tile after tile.
        spans: out, rows of pixels that each entry touches, as ``32 * first + last``, last exclusive.
    """
    for n in range(first, last):
        left, right, top, bottom = _box(records, n, columns, rows)
        several = right - left > 1 and bottom - top > 1
        one_column = right - left == 1
        for row in range(top, bottom):
            if several:
                left, right = _columns(records, n, row, columns)
            for column in range(left, right):
                end = ends[row * columns + column]
                keys[end] = depths[n]
                members[end] = n
                spans[end] = _whole_span(records, n, row) if one_column else _span(records, n, column, row)
                ends[row * columns + column] = end + 1


# Lists of the Gaussians that touch an image and each of its tiles, built in parts by threads.
#
# The result does not depend on the number of parts.

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
        count_tiles(records, *part, columns, rows, per_tile)
        return per_tile

    per_part = np.stack(pool.map(count, footprints.parts))
    starts = _running_sum(per_part.sum(axis=0))
    _check_lists(starts)
    keys, members = np.empty(starts[-1], np.uint32), np.empty(starts[-1], np.int32)
    spans = np.empty(starts[-1], np.uint16)
    ends = starts[:-1] + np.cumsum(per_part, axis=0) - per_part

    def fill(n: int) -> None:
        fill_tiles(records, depths, *footprints.parts[n], columns, rows, ends[n], keys, members, spans)

    pool.map(fill, range(len(footprints.parts)))
    lists = TileLists(columns, starts, members, spans)
    each_part(lambda a, b: sort_tiles(starts, a, b, keys, members, spans), even_tiles(lists, pool), pool)
    return lists


def number_slots(footprints: Footprints, lists: TileLists, first: int, last: int) -> Slots:
    """Return the slots of the members of tiles ``first`` to ``last`` (exclusive)."""
    members = lists.members[lists.starts[first] : lists.starts[last]]
    from_slot, of = np.empty(len(footprints.records) + 1, np.int32), np.empty(len(members), np.int32)
    rows = np.empty(min(len(members), len(footprints.records)), np.int32)
    return Slots(of, rows[: fill_slots(members, from_slot, of, rows)], from_slot)


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
