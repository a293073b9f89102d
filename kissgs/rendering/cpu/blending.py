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
from numba import njit

from kissgs.core.numba_kernels import compiled

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
def _footprint(records: np.ndarray, n: int, x0: int, y0: int) -> tuple[tuple[np.float32, ...], tuple[np.float32, ...]]:
    """Return the centre relative to (x0, y0), l0, l1, l2; and opacity, red, green, blue."""
    return (
        (
            records[n, 0] - np.float32(x0),
            records[n, 1] - np.float32(y0),
            records[n, 2],
            records[n, 3],
            records[n, 4],
        ),
        (records[n, 5], records[n, 6], records[n, 7], records[n, 8]),
    )


@compiled(
    "void(float32[:, ::1], int32[::1], uint16[::1], int64[::1], int64, int64, int64, int64, int64,"
    " float32[::1], float32[::1], float32[:, :, ::1], float32[:, ::1], int32[:, ::1])",
    fastmath=_FAST,
)
def blend(
    records: np.ndarray,
    members: np.ndarray,
    spans: np.ndarray,
    starts: np.ndarray,
    first: int,
    last: int,
    width: int,
    height: int,
    columns: int,
    limits: np.ndarray,
    background: np.ndarray,
    image: np.ndarray,
    transmittance: np.ndarray,
    stops: np.ndarray,
) -> None:
    """Render tiles ``first`` to ``last`` (exclusive).

    Args:
        records: ``(M, 11)`` records of :func:`kissgs.rendering.cpu.projection.project`.
        members: rows of ``records`` that touch each tile, tile after tile, front to back.
        spans: rows of pixels that each member touches, see :func:`kissgs.rendering.cpu.tiles.fill_tiles`.
        starts: ``(tiles + 1,)`` index of the first member of each tile.
        first: first tile.
        last: end of the tiles, exclusive.
        width: of the image, pixels.
        height: of the image, pixels.
        columns: number of tiles in a row of tiles.
        limits: ALPHA_MIN, ALPHA_MAX, TRANSMITTANCE_MIN.
        background: RGB.
        image: out, ``(H, W, 3)``.
        transmittance: out, ``(H, W)``, behind all Gaussians.
        stops: out, ``(tiles, 256)``: index of the first member that is not drawn at the pixel.
    """
    alpha_min, alpha_max, t_min = limits[0], limits[1], limits[2]
    zero, one = np.float32(0), np.float32(1)
    # One array for all values of a pixel (x, y, stop, T, R, G, B): the compiler must assume that several ones overlap.
    s, copies = np.empty(7 * 256, np.float32), np.empty((64, 9), np.float32)
    _pixel_centres(s)
    for tile in range(first, last):
        x0, y0 = (tile % columns) * 16, (tile // columns) * 16
        begin, end = starts[tile], starts[tile + 1]
        for p in range(256):
            inside = x0 + (p & 15) < width and y0 + (p >> 4) < height
            s[512 + p] = np.float32(end - begin) if inside else zero
            s[768 + p] = one
            s[1024 + p] = s[1280 + p] = s[1536 + p] = zero
        for start in range(begin, end, 64):
            _copy_records(records, members, start, min(start + 64, end), copies)
            for i in range(start, min(start + 64, end)):
                (mx, my, l0, l1, l2), (opacity, red, green, blue) = _footprint(copies, i - start, x0, y0)
                top, bottom = np.uint64(spans[i] >> 5), np.uint64(spans[i] & 31)
                index = np.float32(i - begin)
                for p in range(top * np.uint64(16), bottom * np.uint64(16)):
                    dx, dy = s[p] - mx, s[p + np.uint64(256)] - my
                    u, v = l0 * dx + l1 * dy, l2 * dy
                    alpha = min(opacity * _exp_minus(u * u + v * v), alpha_max)
                    alpha = alpha if alpha >= alpha_min else zero
                    alpha = alpha if index < s[p + np.uint64(512)] else zero
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
        for p in range(256):
            x, y = x0 + (p & 15), y0 + (p >> 4)
            stops[tile, p] = np.int32(s[512 + p])
            if x < width and y < height:
                image[y, x, 0] = s[1024 + p] + s[768 + p] * background[0]
                image[y, x, 1] = s[1280 + p] + s[768 + p] * background[1]
                image[y, x, 2] = s[1536 + p] + s[768 + p] * background[2]
                transmittance[y, x] = s[768 + p]


@compiled(
    "void(float32[:, ::1], int32[::1], uint16[::1], int32[::1], int64[::1], int64, int64, int64,"
    " float32[::1], float32[::1], float32[:, ::1], int32[:, ::1], float32[::1])",
    fastmath=_FAST,
)
def removal_errors(
    records: np.ndarray,
    members: np.ndarray,
    spans: np.ndarray,
    slots: np.ndarray,
    starts: np.ndarray,
    first: int,
    last: int,
    columns: int,
    limits: np.ndarray,
    background: np.ndarray,
    transmittance: np.ndarray,
    stops: np.ndarray,
    errors: np.ndarray,
) -> None:
    """Compute the squared change of tiles ``first`` to ``last`` (exclusive) by the removal of each member.

    The arguments are those of :func:`kissgs.rendering.cpu.backward.blend_backward`. ``errors``: out,
    ``(slots,)``, sums over the tile's pixels and RGB.
    """
    alpha_min, alpha_max = limits[0], limits[1]
    zero, one = np.float32(0), np.float32(1)
    height, width = transmittance.shape
    # Per pixel: x, y, stop, T, and R, G, B behind the Gaussian.
    s = np.empty(7 * 256, np.float32)
    _pixel_centres(s)
    for tile in range(first, last):
        x0, y0 = (tile % columns) * 16, (tile // columns) * 16
        begin = starts[tile]
        last_stop = 0
        for p in range(256):
            last_stop = max(last_stop, stops[tile, p])
            s[512 + p] = np.float32(stops[tile, p])
            s[768 + p] = transmittance[min(y0 + (p >> 4), height - 1), min(x0 + (p & 15), width - 1)]
            s[1024 + p], s[1280 + p], s[1536 + p] = background[0], background[1], background[2]
        for i in range(begin + last_stop, starts[tile + 1]):
            errors[slots[i]] = zero
        for i in range(begin + last_stop - 1, begin - 1, -1):
            (mx, my, l0, l1, l2), (opacity, red, green, blue) = _footprint(records, members[i], x0, y0)
            top, bottom = np.uint64(spans[i] >> 5), np.uint64(spans[i] & 31)
            index = np.float32(i - begin)
            total = zero
            for p in range(top * np.uint64(16), bottom * np.uint64(16)):
                dx, dy = s[p] - mx, s[p + np.uint64(256)] - my
                u, v = l0 * dx + l1 * dy, l2 * dy
                alpha = min(opacity * _exp_minus(u * u + v * v), alpha_max)
                alpha = alpha if alpha >= alpha_min else zero
                alpha = alpha if index < s[p + np.uint64(512)] else zero
                t = s[p + np.uint64(768)] / (one - alpha)
                s[p + np.uint64(768)] = t
                dr = alpha * (red - s[p + np.uint64(1024)])
                dg = alpha * (green - s[p + np.uint64(1280)])
                db = alpha * (blue - s[p + np.uint64(1536)])
                s[p + np.uint64(1024)] += dr
                s[p + np.uint64(1280)] += dg
                s[p + np.uint64(1536)] += db
                total += t * t * (dr * dr + dg * dg + db * db)
            errors[slots[i]] = total


@compiled("void(float32[::1], int32[::1], int32[::1], int32[::1], float64[::1])")
def sum_errors(
    errors: np.ndarray, rows: np.ndarray, slots_from: np.ndarray, visible: np.ndarray, scores: np.ndarray
) -> None:
    """Write the sum of the slots of each of the footprints ``rows`` to ``scores[visible]``."""
    for row in rows:
        total = 0.0
        for slot in range(slots_from[row], slots_from[row + 1]):
            total += errors[slot]
        scores[visible[row]] = total
