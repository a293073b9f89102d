"""Numba kernels of alpha blending, tile by tile: the image, its gradients, errors of removals, moments for sensitivity.

A footprint's exponent is u² + v² with u = l0 dx + l1 dy, v = l2 dy (the Cholesky factor of half the inverse
covariance): a sum of squares is never negative, and needles lose no digits.

The lists of tiles are read forward for the image and backward for everything else. Backward, the colour B behind a
Gaussian needs no subtraction: B <- B + alpha (colour - B), starting with the background; and T in front of it is T
behind it / (1 - alpha). The derivative of the pixel by the Gaussian's alpha is T (colour - B), and its removal changes
the pixel by alpha T (colour - B).

Inner loops process rows of half a tile, eight pixels, without branches on one array, so that they are vectorised.
"""

from __future__ import annotations

import numpy as np
from numba import float32, float64, int32, int64, njit, void

from kissgs.core.numba_kernels import compiled
from kissgs.rendering.cpu.records import FRAME, SLOTS, Blended, Frame, Slots, TileLists

Place = tuple[np.float32, np.float32, np.float32, np.float32, np.float32]  # relative to a tile: centre, l0, l1, l2

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
def _pixel(p: int) -> tuple[int, int]:
    """Return column and row of pixel ``p`` of a tile: its left half comes first, row after row."""
    return (p >> 7) * 8 + (p & 7), (p >> 3) & 15


@njit(nogil=True, error_model="numpy")
def _pixel_centres(s: np.ndarray) -> None:
    """Write x and y of a tile's pixel centres into the first and the second 256 values of ``s``."""
    for p in range(256):
        x, y = _pixel(p)
        s[p], s[256 + p] = np.float32(x) + np.float32(0.5), np.float32(y) + np.float32(0.5)


@njit(nogil=True, error_model="numpy")
def _copy_records(records: np.ndarray, members: np.ndarray, first: int, last: int, copies: np.ndarray) -> None:
    """Copy the first 9 values of the records of members ``first`` to ``last`` (exclusive) into ``copies``. Records lie
    anywhere in memory. Copies of many at once do not wait for each other."""
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
def _rows(span: np.uint32, half: int) -> tuple[np.uint64, np.uint64]:
    """Return the first and last (exclusive) pixel that a span has in the left (0) or right (1) half of a tile."""
    rows, begin = span >> np.uint32(16 * half), np.uint64(128 * half)
    first, last = (rows >> np.uint32(5)) & np.uint32(31), rows & np.uint32(31)
    return begin + np.uint64(8) * np.uint64(first), begin + np.uint64(8) * np.uint64(last)


@njit(nogil=True, error_model="numpy", fastmath=_FAST, inline="always")
def _alpha(
    x: np.float32, y: np.float32, drawn: bool, place: Place, opacity: np.float32, limits: tuple[np.float32, np.float32]
) -> tuple[np.float32, np.float32, np.float32, np.float32]:
    """Return u, v, alpha before it is clamped, and alpha, 0 where it is not ``drawn``, at a pixel centre. It takes no
    array: an array that is passed to an inlined function prevents vectorisation."""
    mx, my, l0, l1, l2 = place
    least, most = limits
    dx, dy = x - mx, y - my
    u, v = l0 * dx + l1 * dy, l2 * dy
    full = opacity * _exp_minus(u * u + v * v)
    alpha = min(full, most)
    alpha = alpha if alpha >= least else np.float32(0)
    return u, v, full, alpha if drawn else np.float32(0)


@compiled(void(FRAME, int64, int64), fastmath=_FAST)
def blend(frame: Frame, first: int, last: int) -> None:
    """Render tiles ``first`` to ``last`` (exclusive)."""
    records, lists, out = frame.footprints.records, frame.lists, frame.blended
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
            x, y = _pixel(p)
            inside = x0 + x < width and y0 + y < height
            s[512 + p] = np.float32(end - begin) if inside else zero
            s[768 + p] = one
            s[1024 + p] = s[1280 + p] = s[1536 + p] = zero
        for start in range(begin, end, 64):
            _copy_records(records, lists.members, start, min(start + 64, end), copies)
            for i in range(start, min(start + 64, end)):
                place, (opacity, red, green, blue) = _footprint(copies, i - start, x0, y0)
                index = np.float32(i - begin)
                for half in range(2):
                    top, bottom = _rows(lists.spans[i], half)
                    for p in range(top, bottom):
                        drawn = index < s[p + np.uint64(512)]
                        _, _, _, alpha = _alpha(s[p], s[p + np.uint64(256)], drawn, place, opacity, limits)
                        t = s[p + np.uint64(768)]
                        ends = t * (one - alpha) <= t_min
                        alpha = zero if ends else alpha
                        weight = alpha * t
                        # Arithmetic in place of choices between two values, which would compile to masked stores: slow.
                        s[p + np.uint64(512)] += (one if ends else zero) * (index - s[p + np.uint64(512)])
                        s[p + np.uint64(768)] = t * (one - alpha)
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
        x, y = _pixel(p)
        x, y = x0 + x, y0 + y
        out.stops[tile, p] = np.int32(s[512 + p])
        if x < width and y < height:
            out.image[y, x, 0] = s[1024 + p] + s[768 + p] * background[0]
            out.image[y, x, 1] = s[1280 + p] + s[768 + p] * background[1]
            out.image[y, x, 2] = s[1536 + p] + s[768 + p] * background[2]
            out.transmittance[y, x] = s[768 + p]


@compiled(void(FRAME, SLOTS, int64, int64, float32[::1]), fastmath=_FAST)
def removal_errors(frame: Frame, slots: Slots, first: int, last: int, errors: np.ndarray) -> None:
    """Write the squared change of tiles ``first`` to ``last`` (exclusive) by each member's removal into its slot."""
    records, lists, blended = frame.footprints.records, frame.lists, frame.blended
    limits, background = (blended.limits[0], blended.limits[1]), blended.background
    zero, one = np.float32(0), np.float32(1)
    height, width = blended.transmittance.shape
    # Per pixel: x, y, stop, T, and R, G, B behind the Gaussian.
    s = np.empty(7 * 256, np.float32)
    _pixel_centres(s)
    for tile in range(first, last):
        x0, y0 = (tile % lists.columns) * 16, (tile // lists.columns) * 16
        begin, last_stop = lists.starts[tile], _copy_stops(blended.stops, tile, s)
        for p in range(256):
            x, y = _pixel(p)
            s[768 + p] = blended.transmittance[min(y0 + y, height - 1), min(x0 + x, width - 1)]
            s[1024 + p], s[1280 + p], s[1536 + p] = background[0], background[1], background[2]
        for i in range(begin + last_stop - 1, begin - 1, -1):
            place, (opacity, red, green, blue) = _footprint(records, lists.members[i], x0, y0)
            index, total = np.float32(i - begin), zero
            for half in range(2):
                top, bottom = _rows(lists.spans[i], half)
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
def sum_slots(values: np.ndarray, slots: Slots, visible: np.ndarray, sums: np.ndarray) -> None:
    """Write the sum of the slots of each footprint to ``sums[visible]``."""
    for row in slots.rows:
        total = 0.0
        for slot in range(slots.first[row], slots.first[row + 1]):
            total += values[slot]
        sums[visible[row]] = total


# Gradients.


@njit(nogil=True, error_model="numpy")
def _copy_gradient(v_image: np.ndarray, x0: int, y0: int, s: np.ndarray) -> None:
    """Write the gradient of a tile's pixels by R, G, B from the fifth 256 values of ``s`` on; 0 beyond the image."""
    height, width, _ = v_image.shape
    for p in range(256):
        x, y = _pixel(p)
        x, y = x0 + x, y0 + y
        inside = x < width and y < height
        x, y = min(x, width - 1), min(y, height - 1)
        s[1024 + p] = v_image[y, x, 0] if inside else np.float32(0)
        s[1280 + p] = v_image[y, x, 1] if inside else np.float32(0)
        s[1536 + p] = v_image[y, x, 2] if inside else np.float32(0)


@njit(nogil=True, error_model="numpy", fastmath=_FAST, inline="always")
def _begin_gradient(frame: Blended, v_alpha: np.ndarray, x0: int, y0: int, s: np.ndarray) -> None:
    """Write T of a tile's pixels, and the product of the background and its gradient, less the gradient by alpha."""
    height, width = v_alpha.shape
    background = frame.background
    for p in range(256):
        x, y = _pixel(p)
        x, y = x0 + x, y0 + y
        inside = x < width and y < height
        x, y = min(x, width - 1), min(y, height - 1)
        s[768 + p] = frame.transmittance[y, x] if inside else np.float32(1)
        behind = background[0] * s[1024 + p] + background[1] * s[1280 + p] + background[2] * s[1536 + p]
        s[1792 + p] = behind - v_alpha[y, x] if inside else np.float32(0)


@njit(nogil=True, error_model="numpy", fastmath=_FAST, inline="always")
def _backward(
    s: np.ndarray,
    span: np.uint32,
    index: np.float32,
    footprint: tuple[Place, tuple[np.float32, ...]],
    limits: tuple[np.float32, np.float32],
    sums: np.ndarray,
) -> None:
    """Compute the nine sums of one footprint over a tile's pixels, and step in front of it."""
    place, (opacity, red, green, blue) = footprint
    zero, one = np.float32(0), np.float32(1)
    m, mu, mv, muu, muv, mvv, vr, vg, vb = zero, zero, zero, zero, zero, zero, zero, zero, zero
    for half in range(2):
        top, bottom = _rows(span, half)
        for p in range(top, bottom):
            drawn = index < s[p + np.uint64(512)]
            u, v, full, alpha = _alpha(s[p], s[p + np.uint64(256)], drawn, place, opacity, limits)
            t = s[p + np.uint64(768)] / (one - alpha)
            s[p + np.uint64(768)] = t
            gr, gg, gb = s[p + np.uint64(1024)], s[p + np.uint64(1280)], s[p + np.uint64(1536)]
            weight = alpha * t
            vr += weight * gr
            vg += weight * gg
            vb += weight * gb
            change = red * gr + green * gg + blue * gb - s[p + np.uint64(1792)]
            s[p + np.uint64(1792)] += alpha * change
            g = weight * change
            g = g if full <= limits[1] else zero
            m += g
            mu += g * u
            mv += g * v
            muu += g * u * u
            muv += g * u * v
            mvv += g * v * v
    sums[0], sums[1], sums[2], sums[3], sums[4], sums[5] = -m, -mu, -mv, -muu, -muv, -mvv
    sums[6], sums[7], sums[8] = vr, vg, vb


@compiled(void(FRAME, SLOTS, int64, int64, float32[:, :, ::1], float32[:, ::1], float32[:, ::1]), fastmath=_FAST)
def blend_backward(
    frame: Frame, slots: Slots, first: int, last: int, v_image: np.ndarray, v_alpha: np.ndarray, v_slots: np.ndarray
) -> None:
    """Compute the gradients of tiles ``first`` to ``last`` (exclusive), given those by the image and by its alpha.
    ``v_slots``, ``(slots, 9)``, 0 before, receives the sums over the tile's pixels of the gradient by the exponent
    times 1, u, v, u², uv, v², and of the gradient by the colour's R, G, B."""
    records, lists, blended = frame.footprints.records, frame.lists, frame.blended
    limits = blended.limits[0], blended.limits[1]
    # Per pixel: x, y, stop, T; gradient by R, G, B; product of the colour behind and its gradient, less that by alpha.
    s = np.empty(8 * 256, np.float32)
    # Slots lie anywhere in memory, as records do.
    copies, sums = np.empty((64, 9), np.float32), np.empty((64, 9), np.float32)
    _pixel_centres(s)
    for tile in range(first, last):
        x0, y0 = (tile % lists.columns) * 16, (tile // lists.columns) * 16
        begin, last_stop = lists.starts[tile], _copy_stops(blended.stops, tile, s)
        _copy_gradient(v_image, x0, y0, s)
        _begin_gradient(blended, v_alpha, x0, y0, s)
        for end in range(begin + last_stop, begin, -64):
            start = max(begin, end - 64)
            _copy_records(records, lists.members, start, end, copies)
            for i in range(end - 1, start - 1, -1):
                footprint = _footprint(copies, i - start, x0, y0)
                _backward(s, lists.spans[i], np.float32(i - begin), footprint, limits, sums[i - start])
            for i in range(start, end):
                slot = slots.of[i - slots.begin]
                for c in range(9):
                    v_slots[slot, c] = sums[i - start, c]


@compiled(int64(SLOTS, float32[:, ::1], int32[::1]))
def rows_with_gradients(slots: Slots, v_slots: np.ndarray, rows: np.ndarray) -> int:
    """Write the rows of footprints with any sum of :func:`blend_backward` but 0 to ``rows``; return their number."""
    found = 0
    for row in slots.rows:
        rows[found] = row
        some = False
        for slot in range(slots.first[row], slots.first[row + 1]):
            for c in range(9):
                some |= v_slots[slot, c] != 0
        found += some
    return found


@compiled(void(FRAME, SLOTS, int64, int64, float32[:, :, ::1], float32[:, ::1]), fastmath=_FAST)
def blend_colors_backward(
    frame: Frame, slots: Slots, first: int, last: int, v_image: np.ndarray, v_slots: np.ndarray
) -> None:
    """Compute the last three sums of :func:`blend_backward` alone, ``(slots, 3)``, front to back."""
    records, lists, blended = frame.footprints.records, frame.lists, frame.blended
    limits = blended.limits[0], blended.limits[1]
    zero = np.float32(0)
    # Per pixel: x, y, stop, T; gradient by R, G, B.
    s, copies = np.empty(7 * 256, np.float32), np.empty((64, 9), np.float32)
    _pixel_centres(s)
    for tile in range(first, last):
        x0, y0 = (tile % lists.columns) * 16, (tile // lists.columns) * 16
        begin, last_stop = lists.starts[tile], _copy_stops(blended.stops, tile, s)
        _copy_gradient(v_image, x0, y0, s)
        s[768:1024] = np.float32(1)
        for start in range(begin, begin + last_stop, 64):
            end = min(start + 64, begin + last_stop)
            _copy_records(records, lists.members, start, end, copies)
            for i in range(start, end):
                place, (opacity, _, _, _) = _footprint(copies, i - start, x0, y0)
                index, slot = np.float32(i - begin), slots.of[i - slots.begin]
                red, green, blue = zero, zero, zero
                for half in range(2):
                    top, bottom = _rows(lists.spans[i], half)
                    for p in range(top, bottom):
                        drawn = index < s[p + np.uint64(512)]
                        _, _, _, alpha = _alpha(s[p], s[p + np.uint64(256)], drawn, place, opacity, limits)
                        weight = alpha * s[p + np.uint64(768)]
                        s[p + np.uint64(768)] -= weight
                        red += weight * s[p + np.uint64(1024)]
                        green += weight * s[p + np.uint64(1280)]
                        blue += weight * s[p + np.uint64(1536)]
                v_slots[slot, 0], v_slots[slot, 1], v_slots[slot, 2] = red, green, blue


# Moments: sums over the pixels of a footprint, from which the sensitivity follows
# (:mod:`kissgs.rendering.cpu.sensitivity`).

MOMENTS = 10  # number of moments of each footprint in each tile


@njit(nogil=True, error_model="numpy")
def _begin_moments(records: np.ndarray, lists: TileLists, tile: int, frame: Blended, s: np.ndarray) -> None:
    """Write T, the colour behind all Gaussians, and the transmittance to the background behind, of a tile's pixels.
    What is behind the end of a pixel's list has about the colour of the next Gaussian, and hides the background."""
    x0, y0 = (tile % lists.columns) * 16, (tile // lists.columns) * 16
    height, width = frame.transmittance.shape
    background, begin, max_color = frame.background, lists.starts[tile], np.float32(2)
    for p in range(256):
        x, y = _pixel(p)
        s[768 + p] = frame.transmittance[min(y0 + y, height - 1), min(x0 + x, width - 1)]
        s[1024 + p], s[1280 + p], s[1536 + p], s[1792 + p] = background[0], background[1], background[2], 1
        if begin + frame.stops[tile, p] < lists.starts[tile + 1]:
            n = lists.members[begin + frame.stops[tile, p]]
            s[1024 + p] = min(records[n, 6], max_color)
            s[1280 + p] = min(records[n, 7], max_color)
            s[1536 + p] = min(records[n, 8], max_color)
            s[1792 + p] = 0


@njit(nogil=True, error_model="numpy", fastmath=_FAST, inline="always")
def _moments(
    s: np.ndarray,
    span: np.uint32,
    index: np.float32,
    footprint: tuple[Place, tuple[np.float32, ...]],
    limits: tuple[np.float32, np.float32],
    variance: np.float32,
    sums: np.ndarray,
) -> None:
    """Compute the moments of one footprint over a tile's pixels, and step in front of it."""
    place, (opacity, red, green, blue) = footprint
    zero, one = np.float32(0), np.float32(1)
    max_color = np.float32(2)  # a display shows at most 1; brighter colours are limited to twice that
    red, green, blue = min(red, max_color), min(green, max_color), min(blue, max_color)
    m0, m20, m11, m02, m40, m31, m22, m13, m04 = zero, zero, zero, zero, zero, zero, zero, zero, zero
    squared_weight = zero
    for half in range(2):
        top, bottom = _rows(span, half)
        for p in range(top, bottom):
            drawn = index < s[p + np.uint64(512)]
            u, v, full, alpha = _alpha(s[p], s[p + np.uint64(256)], drawn, place, opacity, limits)
            t = s[p + np.uint64(768)] / (one - alpha)
            s[p + np.uint64(768)] = t
            dr = alpha * (red - s[p + np.uint64(1024)])
            dg = alpha * (green - s[p + np.uint64(1280)])
            db = alpha * (blue - s[p + np.uint64(1536)])
            s[p + np.uint64(1024)] += dr
            s[p + np.uint64(1280)] += dg
            s[p + np.uint64(1536)] += db
            weight = alpha * t
            squared_weight += weight * weight
            background_change = alpha * s[p + np.uint64(1792)]
            s[p + np.uint64(1792)] -= background_change
            g = t * t * (dr * dr + dg * dg + db * db + variance * (background_change * background_change))
            m0 += g
            g = g if full <= limits[1] else zero
            uu, uv, vv = u * u, u * v, v * v
            guu, gvv = g * uu, g * vv
            m20 += guu
            m11 += g * uv
            m02 += gvv
            m40 += guu * uu
            m31 += guu * uv
            m22 += guu * vv
            m13 += gvv * uv
            m04 += gvv * vv
    sums[0], sums[1], sums[2], sums[3] = m0, m20, m11, m02
    sums[4], sums[5], sums[6], sums[7], sums[8] = m40, m31, m22, m13, m04
    sums[9] = squared_weight


@compiled(void(FRAME, SLOTS, int64, int64, float64, float32[:, ::1]), fastmath=_FAST)
def moments(frame: Frame, slots: Slots, first: int, last: int, spread: float, sums: np.ndarray) -> None:
    """Compute moments of the members of tiles ``first`` to ``last`` (exclusive), ``(slots, 10)``. These are sums over
    the tile's pixels of |w|² times 1, u², uv, v², u⁴, u³v, u²v², uv³, v⁴; and of (alpha T)². ``spread`` is the standard
    deviation of each channel of the background. Pixels at which alpha is clamped to ALPHA_MAX count in the first sum
    only, which is therefore the error of removing the Gaussian."""
    records, lists, blended = frame.footprints.records, frame.lists, frame.blended
    limits, variance = (blended.limits[0], blended.limits[1]), np.float32(3 * spread * spread)
    # Per pixel: x, y, stop, T; R, G, B behind the Gaussian, and transmittance to the background behind it.
    s, copies = np.empty(8 * 256, np.float32), np.empty((64, 9), np.float32)
    _pixel_centres(s)
    for tile in range(first, last):
        x0, y0 = (tile % lists.columns) * 16, (tile // lists.columns) * 16
        begin, last_stop = lists.starts[tile], _copy_stops(blended.stops, tile, s)
        _begin_moments(records, lists, tile, blended, s)
        for end in range(begin + last_stop, begin, -64):
            start = max(begin, end - 64)
            _copy_records(records, lists.members, start, end, copies)
            for i in range(end - 1, start - 1, -1):
                footprint, index = _footprint(copies, i - start, x0, y0), np.float32(i - begin)
                _moments(s, lists.spans[i], index, footprint, limits, variance, sums[slots.of[i - slots.begin]])
