"""Numba kernels of tiles: lists of the footprints that touch each tile, front to back."""

from __future__ import annotations

import numpy as np
from numba import njit

from kissgs.core.numba_kernels import compiled


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
def number_slots(members: np.ndarray, first: np.ndarray, slots: np.ndarray, rows: np.ndarray) -> int:
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
