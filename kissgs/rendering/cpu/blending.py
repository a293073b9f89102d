"""Numba kernels of alpha blending, tile by tile: the image, its derivative, and the error of removals.

A footprint's exponent is u² + v² with u = l0 dx + l1 dy, v = l2 dy (the Cholesky factor of half the inverse
covariance): a sum of squares is never negative, and needles lose no digits.

The lists of tiles are read forward for the image and backward for everything else. Backward, the colour B behind a
Gaussian needs no subtraction: B <- B + alpha (colour - B), starting with the background; and T in front of it is T
behind it / (1 - alpha). The derivative of the pixel by the Gaussian's alpha is T (colour - B), and its removal changes
the pixel by alpha T (colour - B).

Inner loops process whole rows of a tile without branches on one array, so that they are vectorised.
"""

from __future__ import annotations

import numpy as np
from numba import float32, float64, int32, int64, njit, void

from kissgs.core.numba_kernels import compiled
from kissgs.rendering.cpu.records import BLENDED, SLOTS, TILE_LISTS, Blended, Slots, TileLists

Place = tuple[np.float32, np.float32, np.float32, np.float32, np.float32]
"""Centre of a footprint relative to a tile, and its l0, l1, l2."""

# Sums may be reordered for vectorisation, at compile time, so that results stay reproducible.
_FAST = {"contract", "reassoc", "nsz"}


@njit(nogil=True, error_model="numpy", fastmath=_FAST, inline="always")
def _exp_minus(s: np.float32) -> np.float32:
    """Return exp(-s) for s from 0 to 6, relative error 1e-6; beyond 6, exp(-6), which is below ALPHA_MIN."""
    t = min(s, np.float32(6.0)) * np.float32(0.125)
    e = np.float32(-0.00569869049)
    e = e * t + np.float32(0.0395219925)
    e = e * t + np.float32(-0.165825967)
    e = e * t + np.float32(0.499846967)
    e = e * t + np.float32(-0.999989536)
    e = e * t + np.float32(0.99999988)
    e *= e
    e *= e
    return e * e


@njit(nogil=True, error_model="numpy")
def _pixel_centres(s: np.ndarray) -> None:
    """Write x and y of a tile's pixel centres into the first and the second 256 values of ``s``."""
    for p in range(256):
        s[p], s[256 + p] = np.float32(p & 15) + np.float32(0.5), np.float32(p >> 4) + np.float32(0.5)


@njit(nogil=True, error_model="numpy")
def _copy_records(records: np.ndarray, members: np.ndarray, first: int, last: int, copies: np.ndarray) -> None:
    """Copy the first 9 values of the records of members ``first`` to ``last`` (exclusive) into ``copies``.

    Records lie anywhere in memory. Copies of many at once do not wait for each other.
    """
    for i in range(first, last):
        for c in range(9):
            copies[i - first, c] = records[members[i], c]


@njit(nogil=True, error_model="numpy")
def _footprint(records: np.ndarray, n: int, x0: int, y0: int) -> tuple[Place, tuple[np.float32, ...]]:
    """Return the place of a footprint relative to (x0, y0); and opacity, red, green, blue."""
    centre_x, centre_y = records[n, 0] - np.float32(x0), records[n, 1] - np.float32(y0)
    place = centre_x, centre_y, records[n, 2], records[n, 3], records[n, 4]
    return place, (records[n, 5], records[n, 6], records[n, 7], records[n, 8])


@njit(nogil=True, error_model="numpy")
def _copy_stops(stops: np.ndarray, tile: int, s: np.ndarray) -> int:
    """Write where the list of each pixel ends into the third 256 values of ``s``; return the largest."""
    last = 0
    for p in range(256):
        last = max(last, stops[tile, p])
        s[512 + p] = np.float32(stops[tile, p])
    return last


@njit(nogil=True, error_model="numpy")
def _rows(span: np.uint16) -> tuple[np.uint64, np.uint64]:
    """Return the first and last (exclusive) pixel of the rows of a span."""
    return np.uint64(span >> 5) * np.uint64(16), np.uint64(span & 31) * np.uint64(16)


@njit(nogil=True, error_model="numpy", fastmath=_FAST, inline="always")
def _alpha(
    x: np.float32,
    y: np.float32,
    drawn: bool,
    place: Place,
    opacity: np.float32,
    limits: tuple[np.float32, np.float32],
) -> tuple[np.float32, np.float32, np.float32, np.float32]:
    """Return u, v, alpha before it is clamped, and alpha, 0 where it is not ``drawn``, at a pixel centre.

    It takes no array: an array that is passed to an inlined function prevents vectorisation.
    """
    mx, my, l0, l1, l2 = place
    least, most = limits
    dx, dy = x - mx, y - my
    u, v = l0 * dx + l1 * dy, l2 * dy
    full = opacity * _exp_minus(u * u + v * v)
    alpha = min(full, most)
    alpha = alpha if alpha >= least else np.float32(0)
    return u, v, full, alpha if drawn else np.float32(0)


@compiled(void(float32[:, ::1], TILE_LISTS, int64, int64, BLENDED), fastmath=_FAST)
def blend(records: np.ndarray, lists: TileLists, first: int, last: int, out: Blended) -> None:
    """Render tiles ``first`` to ``last`` (exclusive)."""
    limits, t_min = (out.limits[0], out.limits[1]), out.limits[2]
    zero, one = np.float32(0), np.float32(1)
    height, width = out.transmittance.shape
    # One array for all values of a pixel (x, y, stop, T, R, G, B): the compiler must assume that several ones overlap.
    s, copies = np.empty(7 * 256, np.float32), np.empty((64, 9), np.float32)
    _pixel_centres(s)
    for tile in range(first, last):
        x0, y0 = (tile % lists.columns) * 16, (tile // lists.columns) * 16
        begin, end = lists.starts[tile], lists.starts[tile + 1]
        for p in range(256):
            inside = x0 + (p & 15) < width and y0 + (p >> 4) < height
            s[512 + p] = np.float32(end - begin) if inside else zero
            s[768 + p] = one
            s[1024 + p] = s[1280 + p] = s[1536 + p] = zero
        for start in range(begin, end, 64):
            _copy_records(records, lists.members, start, min(start + 64, end), copies)
            for i in range(start, min(start + 64, end)):
                place, (opacity, red, green, blue) = _footprint(copies, i - start, x0, y0)
                top, bottom = _rows(lists.spans[i])
                index = np.float32(i - begin)
                for p in range(top, bottom):
                    drawn = index < s[p + np.uint64(512)]
                    _, _, _, alpha = _alpha(s[p], s[p + np.uint64(256)], drawn, place, opacity, limits)
                    t = s[p + np.uint64(768)]
                    after = t * (one - alpha)
                    ends = after <= t_min
                    weight = zero if ends else alpha * t
                    s[p + np.uint64(512)] = index if ends else s[p + np.uint64(512)]
                    s[p + np.uint64(768)] = t if ends else after
                    s[p + np.uint64(1024)] += weight * red
                    s[p + np.uint64(1280)] += weight * green
                    s[p + np.uint64(1536)] += weight * blue
            last_stop = zero
            for p in range(512, 768):
                last_stop = max(last_stop, s[p])
            if last_stop <= np.float32(min(start + 64, end) - 1 - begin):
                break
        _store_tile(s, tile, x0, y0, out)


@njit(nogil=True, error_model="numpy", fastmath=_FAST, inline="always")
def _store_tile(s: np.ndarray, tile: int, x0: int, y0: int, out: Blended) -> None:
    """Write the pixels of a tile over the background."""
    background, (height, width) = out.background, out.transmittance.shape
    for p in range(256):
        x, y = x0 + (p & 15), y0 + (p >> 4)
        out.stops[tile, p] = np.int32(s[512 + p])
        if x < width and y < height:
            out.image[y, x, 0] = s[1024 + p] + s[768 + p] * background[0]
            out.image[y, x, 1] = s[1280 + p] + s[768 + p] * background[1]
            out.image[y, x, 2] = s[1536 + p] + s[768 + p] * background[2]
            out.transmittance[y, x] = s[768 + p]


@compiled(void(float32[:, ::1], TILE_LISTS, SLOTS, int64, int64, BLENDED, float32[::1]), fastmath=_FAST)
def removal_errors(
    records: np.ndarray, lists: TileLists, slots: Slots, first: int, last: int, frame: Blended, errors: np.ndarray
) -> None:
    """Write the squared change of tiles ``first`` to ``last`` (exclusive) by each member's removal into its slot."""
    limits, background = (frame.limits[0], frame.limits[1]), frame.background
    zero, one = np.float32(0), np.float32(1)
    height, width = frame.transmittance.shape
    # Per pixel: x, y, stop, T, and R, G, B behind the Gaussian.
    s = np.empty(7 * 256, np.float32)
    _pixel_centres(s)
    for tile in range(first, last):
        x0, y0 = (tile % lists.columns) * 16, (tile // lists.columns) * 16
        begin, last_stop = lists.starts[tile], _copy_stops(frame.stops, tile, s)
        for p in range(256):
            s[768 + p] = frame.transmittance[min(y0 + (p >> 4), height - 1), min(x0 + (p & 15), width - 1)]
            s[1024 + p], s[1280 + p], s[1536 + p] = background[0], background[1], background[2]
        for i in range(begin + last_stop, lists.starts[tile + 1]):
            errors[slots.of[i - slots.begin]] = zero
        for i in range(begin + last_stop - 1, begin - 1, -1):
            place, (opacity, red, green, blue) = _footprint(records, lists.members[i], x0, y0)
            top, bottom = _rows(lists.spans[i])
            index, total = np.float32(i - begin), zero
            for p in range(top, bottom):
                drawn = index < s[p + np.uint64(512)]
                _, _, _, alpha = _alpha(s[p], s[p + np.uint64(256)], drawn, place, opacity, limits)
                t = s[p + np.uint64(768)] / (one - alpha)
                s[p + np.uint64(768)] = t
                dr = alpha * (red - s[p + np.uint64(1024)])
                dg = alpha * (green - s[p + np.uint64(1280)])
                db = alpha * (blue - s[p + np.uint64(1536)])
                s[p + np.uint64(1024)] += dr
                s[p + np.uint64(1280)] += dg
                s[p + np.uint64(1536)] += db
                total += t * t * (dr * dr + dg * dg + db * db)
            errors[slots.of[i - slots.begin]] = total


@compiled(void(float32[::1], SLOTS, int32[::1], float64[::1]))
def sum_errors(errors: np.ndarray, slots: Slots, visible: np.ndarray, scores: np.ndarray) -> None:
    """Write the sum of the slots of each footprint to ``scores[visible]``."""
    for row in slots.rows:
        total = 0.0
        for slot in range(slots.first[row], slots.first[row + 1]):
            total += errors[slot]
        scores[visible[row]] = total
