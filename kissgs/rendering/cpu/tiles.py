"""Numba kernels of tiles: lists of the footprints that touch each tile, front to back."""

from __future__ import annotations

import numpy as np
from numba import njit

from kissgs.core.numba_kernels import compiled


@compiled("void(uint32[::1], int64[::1], int64[::1])")
def sort_keys(keys: np.ndarray, order: np.ndarray, scratch: np.ndarray) -> None:
    """Write the permutation that sorts ``keys`` stably to ``order``, by radix sort; ``scratch`` has the same length."""
    count = keys.shape[0]
    for n in range(count):
        order[n] = n
    counts = np.empty(2048, np.int64)
    for shift in range(0, 33, 11):
        counts[:] = 0
        for n in range(count):
            counts[(keys[n] >> np.uint32(shift)) & np.uint32(2047)] += 1
        total = 0
        for digit in range(2048):
            total, counts[digit] = total + counts[digit], total
        for n in range(count):
            digit = (keys[order[n]] >> np.uint32(shift)) & np.uint32(2047)
            scratch[counts[digit]] = order[n]
            counts[digit] += 1
        for n in range(count):
            order[n] = scratch[n]


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
def _rows(records: np.ndarray, n: int, rows: int) -> tuple[int, int]:
    """Return the first and last (exclusive) row of tiles that footprint ``n`` touches."""
    centre, reach = np.float64(records[n, 1]), np.float64(records[n, 10]) * 1.0001 + 0.01
    return _clamp(np.ceil((centre - reach - 15.5) / 16), rows), _clamp(np.floor((centre + reach - 0.5) / 16) + 1, rows)


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


@compiled("void(float32[:, ::1], int64, int64, int64, int64, int64[::1], int64[::1])")
def count_tiles(
    records: np.ndarray, first: int, last: int, columns: int, rows: int, per_tile: np.ndarray, per_footprint: np.ndarray
) -> None:
    """Count footprints ``first`` to ``last`` (exclusive) per tile, added to ``per_tile``, and tiles per footprint."""
    for n in range(first, last):
        total = 0
        top, bottom = _rows(records, n, rows)
        for row in range(top, bottom):
            left, right = _columns(records, n, row, columns)
            for column in range(left, right):
                per_tile[row * columns + column] += 1
            total += max(right - left, 0)
        per_footprint[n] = total


@compiled(
    "void(float32[:, ::1], int64, int64, int64, int64, int64[::1], int64[::1], int32[::1], int32[::1], uint16[::1])"
)
def fill_tiles(
    records: np.ndarray,
    first: int,
    last: int,
    columns: int,
    rows: int,
    ends: np.ndarray,
    slots_from: np.ndarray,
    members: np.ndarray,
    slots: np.ndarray,
    spans: np.ndarray,
) -> None:
    """Write footprints ``first`` to ``last`` (exclusive) into the lists of the tiles that they touch.

    Args:
        records: ``(M, 11)`` records of :func:`kissgs.rendering.cpu.projection.project`, front to back.
        first: first footprint.
        last: end of the footprints, exclusive.
        columns: number of tiles in a row of tiles.
        rows: number of rows of tiles.
        ends: index at which the list of each tile continues; advanced.
        slots_from: first slot of each footprint, which has one for each tile that it touches.
        members: out, lists of footprints, tile after tile.
        slots: out, slot of each entry of ``members``.
        spans: out, rows of pixels that each entry touches, as ``32 * first + last``, last exclusive.
    """
    for n in range(first, last):
        slot = slots_from[n]
        top, bottom = _rows(records, n, rows)
        for row in range(top, bottom):
            left, right = _columns(records, n, row, columns)
            for column in range(left, right):
                tile = row * columns + column
                members[ends[tile]] = n
                slots[ends[tile]] = slot
                spans[ends[tile]] = _span(records, n, column, row)
                ends[tile] += 1
                slot += 1
