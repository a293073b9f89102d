"""Lists of the Gaussians that touch an image and each of its tiles, front to back, built in parts by threads."""

from __future__ import annotations

import itertools
from collections.abc import Callable
from typing import NamedTuple, TypeVar

import numpy as np
from numba import float32, int32, int64, njit, uint32, void

from kissgs.core.array_types import Int64
from kissgs.core.context import Workers
from kissgs.core.errors import UnsupportedError
from kissgs.core.numba_kernels import compiled
from kissgs.rendering import constants
from kissgs.rendering.cpu.projection import project, shade
from kissgs.rendering.cpu.records import (
    FOOTPRINTS,
    SLOTS,
    TILE_LISTS,
    Footprints,
    Gaussians,
    Projection,
    Slots,
    TileLists,
)


@njit(nogil=True, error_model="numpy")
def _sort_list(keys: np.ndarray, rows: np.ndarray, spans: np.ndarray, scratch: np.ndarray, counts: np.ndarray) -> None:
    """Sort ``rows`` and ``spans`` of one tile's members by their keys, stably. ``scratch`` has four rows, as long as
    the keys or longer, ``counts`` 256 entries."""
    count = keys.shape[0]
    order, other = scratch[0], scratch[1]
    for i in range(count):
        order[i] = np.uint32(i)
    differing = np.uint32(0)
    for i in range(1, count):
        differing |= keys[i] ^ keys[0]
    for shift in range(0, 32, 8):
        if (differing >> np.uint32(shift)) & np.uint32(255) == 0:
            continue
        counts[:] = 0
        for i in range(count):
            counts[(keys[i] >> np.uint32(shift)) & np.uint32(255)] += 1
        total = 0
        for digit in range(256):
            total, counts[digit] = total + counts[digit], total
        for i in range(count):
            digit = (keys[order[i]] >> np.uint32(shift)) & np.uint32(255)
            other[counts[digit]] = order[i]
            counts[digit] += 1
        order, other = other, order
    moved_rows, moved_spans = scratch[2], scratch[3]
    for i in range(count):
        moved_rows[i], moved_spans[i] = rows[i], spans[i]
    for i in range(count):
        rows[i], spans[i] = moved_rows[order[i]], moved_spans[order[i]]


@compiled(void(TILE_LISTS, int64, int64, uint32[::1]))
def sort_tiles(lists: TileLists, first: int, last: int, keys: np.ndarray) -> None:
    """Sort the members of tiles ``first`` to ``last`` (exclusive) by their keys, stably."""
    starts, longest = lists.starts, 0
    for tile in range(first, last):
        longest = max(longest, starts[tile + 1] - starts[tile])
    scratch, counts = np.empty((4, longest), np.uint32), np.empty(256, np.int64)
    for tile in range(first, last):
        a, b = starts[tile], starts[tile + 1]
        _sort_list(keys[a:b], lists.members[a:b], lists.spans[a:b], scratch, counts)


@compiled(int64(int32[::1], SLOTS))
def fill_slots(members: np.ndarray, out: Slots) -> int:
    """Number members footprint by footprint, in their order within each; return how many footprints have any."""
    first, slots, rows = out.first, out.of, out.rows
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
    positive = value if value > 0 else 0.0
    return int(positive if positive < top else np.float64(top))


class Disc(NamedTuple):
    """The disc u² + v² <= tau of a footprint, with u = l0 dx + l1 dy and v = l2 dy, and what follows from it once."""

    x: float  # of the centre
    y: float
    width: float  # half the size of its bounding box, pixels
    height: float
    l2: float
    radius: float  # √tau
    k: float  # l1 / l2
    top: float  # |v| at the leftmost and rightmost points
    per_l0: float
    slant: float  # dx of the highest point
    area: float  # a tau, with a = l1² + l2²
    cross: float  # l0 l1
    product: float  # l0 l2
    per_a: float


@njit(nogil=True, error_model="numpy")
def _disc(records: np.ndarray, n: int) -> Disc:
    """Return the disc of footprint ``n``, a little larger, as float32 alphas may exceed exact ones by rounding."""
    l0, l1, l2 = np.float64(records[n, 2]), np.float64(records[n, 3]), np.float64(records[n, 4])
    tau = np.float64(records[n, 9]) * 1.0001 + 1e-5
    radius, per_l0, a, k = np.sqrt(tau), 1.0 / l0, l1 * l1 + l2 * l2, l1 / l2
    reach = np.sqrt(1.0 + k * k)
    return Disc(
        np.float64(records[n, 0]),
        np.float64(records[n, 1]),
        radius * reach * per_l0,
        np.float64(records[n, 10]) * 1.0001 + 0.01,
        l2,
        radius,
        k,
        k * radius / reach,
        per_l0,
        k * radius * per_l0,
        a * tau,
        l0 * l1,
        l0 * l2,
        1.0 / a,
    )


@njit(nogil=True, error_model="numpy")
def _halves(disc: Disc, row: int, halves: int) -> tuple[int, int]:
    """Return the first and last (exclusive) half of a tile that a footprint touches in a row of tiles, in which v is in
    an interval; x = (u - k v) / l0 is largest at v = -k √tau / √(1 + k²) or at the interval's nearer end."""
    low = max((16 * row + 0.5 - disc.y) * disc.l2, -disc.radius)
    high = min((16 * row + 15.5 - disc.y) * disc.l2, disc.radius)
    if not low <= high:
        return 0, 0
    tau = disc.radius * disc.radius
    v = min(max(-disc.top, low), high)
    right = disc.x + (np.sqrt(max(tau - v * v, 0.0)) - disc.k * v) * disc.per_l0
    v = min(max(disc.top, low), high)
    left = disc.x - (np.sqrt(max(tau - v * v, 0.0)) + disc.k * v) * disc.per_l0
    return _clamp(np.ceil((left - 7.51) / 8), halves), _clamp(np.floor((right - 0.49) / 8) + 1, halves)


@njit(nogil=True, error_model="numpy")
def _box(disc: Disc, halves: int, rows: int) -> tuple[int, int, int, int]:
    """Return the first and last (exclusive) half of a tile, and row of tiles, that a footprint touches."""
    return (
        _clamp(np.ceil((disc.x - disc.width - 7.51) / 8), halves),
        _clamp(np.floor((disc.x + disc.width - 0.49) / 8) + 1, halves),
        _clamp(np.ceil((disc.y - disc.height - 15.5) / 16), rows),
        _clamp(np.floor((disc.y + disc.height - 0.5) / 16) + 1, rows),
    )


@njit(nogil=True, error_model="numpy")
def _span(disc: Disc, half: int, row: int) -> int:
    """Return the rows of pixels that a footprint touches in half of a tile, as ``32 * first + last``, last exclusive.
    Within the half's columns, the footprint is highest at its own highest point or at the nearer side of the half: at
    dx, a dy = -l0 l1 dx ± √(a tau - (l0 l2 dx)²)."""
    x, y = 8 * half - disc.x, 16 * row - disc.y
    dx = min(max(-disc.slant, x + 0.5), x + 7.5)
    across = disc.product * dx
    low = (np.sqrt(max(disc.area - across * across, 0.0)) - disc.cross * dx) * disc.per_a
    dx = min(max(disc.slant, x + 0.5), x + 7.5)
    across = disc.product * dx
    high = (np.sqrt(max(disc.area - across * across, 0.0)) + disc.cross * dx) * disc.per_a
    return 32 * _clamp(np.ceil(-high - y - 0.51), 16) + _clamp(np.floor(low - y - 0.49) + 1, 16)


@njit(nogil=True, error_model="numpy")
def _whole_span(disc: Disc, row: int) -> int:
    """Return the span of a footprint that lies within one column of halves, see :func:`_span`."""
    y = 16 * row - disc.y
    return 32 * _clamp(np.ceil(-disc.height - y - 0.51), 16) + _clamp(np.floor(disc.height - y - 0.49) + 1, 16)


@compiled(void(float32[:, ::1], int64, int64, int64[:, ::1]))
def count_tiles(records: np.ndarray, first: int, last: int, per_tile: np.ndarray) -> None:
    """Add the number of footprints ``first`` to ``last`` (exclusive) that touch each tile to ``per_tile``."""
    rows, columns = per_tile.shape
    for n in range(first, last):
        disc = _disc(records, n)
        left, right, top, bottom = _box(disc, 2 * columns, rows)
        several = right - left > 1 and bottom - top > 1
        for row in range(top, bottom):
            if several:
                left, right = _halves(disc, row, 2 * columns)
            for column in range(left // 2, (right + 1) // 2):
                per_tile[row, column] += 1


@compiled(void(FOOTPRINTS, int64, int64, TILE_LISTS, int64[:, ::1], uint32[::1]))
def fill_tiles(
    footprints: Footprints, first: int, last: int, lists: TileLists, ends: np.ndarray, keys: np.ndarray
) -> None:
    """Append footprints ``first`` to ``last`` (exclusive) to the lists of the tiles that they touch. The list of each
    tile continues at ``ends``. ``keys``: bits of each member's depth, which sort as depths do."""
    records, depths = footprints.records, footprints.depths.view(np.uint32)
    rows, columns = ends.shape
    for n in range(first, last):
        disc = _disc(records, n)
        left, right, top, bottom = _box(disc, 2 * columns, rows)
        several, one_half = right - left > 1 and bottom - top > 1, right - left == 1
        for row in range(top, bottom):
            if several:
                left, right = _halves(disc, row, 2 * columns)
            for column in range(left // 2, (right + 1) // 2):
                end = ends[row, column]
                keys[end] = depths[n]
                lists.members[end] = n
                lists.spans[end] = 0
                for half in range(max(left, 2 * column), min(right, 2 * column + 2)):
                    span = _whole_span(disc, row) if one_half else _span(disc, half, row)
                    lists.spans[end] |= np.uint32(span << (half % 2 * 16))
                ends[row, column] = end + 1


R = TypeVar("R")

Part = tuple[int, int]  # first and last (exclusive) of some items
MAX_PAIRS = 2**31 - 1  # largest number of pairs of a footprint and a tile that it touches: the lists are int32
MAX_MEMBERS = 2**24 - 1  # largest number of footprints in one tile: kernels store their indices as float32
PARTS_PER_THREAD = 4  # number of parts per thread; parts differ in cost, and smaller ones balance the load


def find_footprints(gaussians: Gaussians, projection: Projection, pool: Workers) -> tuple[Footprints, list[Part]]:
    """Project and shade all Gaussians; return those that touch the image, and the ranges of rows that hold them."""
    count = len(gaussians.means)
    found = Footprints(np.empty(count, np.int32), np.empty(count, np.float32), np.empty((count, 11), np.float32))

    def part(first: int, last: int) -> Part:
        end = first + project(gaussians, projection, first, last, found)
        shade(gaussians, projection, first, end, found)
        return first, end

    return found, each_part(part, even(count, pool), pool)


def sort_into_tiles(footprints: Footprints, parts: list[Part], projection: Projection, pool: Workers) -> TileLists:
    """Return lists of the footprints that touch each tile, nearest first; they do not depend on the parts."""
    rows, columns = -(-projection.height // constants.TILE), -(-projection.width // constants.TILE)
    per_part = np.zeros((len(parts), rows, columns), np.int64)
    pool.map(lambda n: count_tiles(footprints.records, *parts[n], per_part[n]), range(len(parts)))
    starts = np.zeros(rows * columns + 1, np.int64)
    np.cumsum(per_part.sum(axis=0), out=starts[1:])
    _check_lists(starts)
    total = int(starts[-1])
    lists = TileLists(columns, starts, np.empty(total, np.int32), np.empty(total, np.uint32))
    keys = np.empty(total, np.uint32)
    ends = starts[:-1].reshape(rows, columns) + np.cumsum(per_part, axis=0) - per_part
    pool.map(lambda n: fill_tiles(footprints, *parts[n], lists, ends[n], keys), range(len(parts)))
    each_part(lambda first, last: sort_tiles(lists, first, last, keys), even_tiles(lists, pool), pool)
    return lists


def number_slots(lists: TileLists, rows: int, tiles: Part | None = None) -> Slots:
    """Return the slots of the members of some tiles, or of all; ``rows``: number of rows for footprints."""
    first, last = tiles or (0, len(lists.starts) - 1)
    begin, end = int(lists.starts[first]), int(lists.starts[last])
    slots = Slots(
        begin, np.empty(end - begin, np.int32), np.empty(min(end - begin, rows), np.int32), np.empty(rows + 1, np.int32)
    )
    found = fill_slots(lists.members[begin:end], slots)
    return slots._replace(rows=slots.rows[:found])


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


def even(count: int, pool: Workers) -> Int64[np.ndarray, " edges"]:
    """Return the edges of at least one part of about equal numbers of items; no part is empty if there are items."""
    parts = max(1, min(pool.threads * PARTS_PER_THREAD, count))
    return np.linspace(0, count, parts + 1).astype(np.int64)


def even_tiles(lists: TileLists, pool: Workers, tiles: Part | None = None) -> Int64[np.ndarray, " edges"]:
    """Return the edges of parts of some tiles, or of all, of about equal cost: members plus a constant per tile."""
    first, last = tiles or (0, len(lists.starts) - 1)
    work = lists.starts[first : last + 1] + 8 * np.arange(last - first + 1)
    edges = np.searchsorted(work, np.linspace(work[0], work[-1], pool.threads * PARTS_PER_THREAD + 1))
    edges[0], edges[-1] = 0, last - first
    return first + np.unique(edges)


def each_part(work: Callable[[int, int], R], edges: Int64[np.ndarray, " edges"], pool: Workers) -> list[R]:
    """Call ``work`` with the edges (first, last) of each part in threads; return the results in order."""
    return pool.map(lambda pair: work(int(pair[0]), int(pair[1])), list(itertools.pairwise(edges)))
