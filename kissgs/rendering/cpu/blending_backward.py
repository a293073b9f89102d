"""Numba kernel of the backward pass of alpha blending, tile by tile; see :mod:`kissgs.rendering.cpu.blending`."""

from __future__ import annotations

import numpy as np

from kissgs.core.numba_kernels import compiled
from kissgs.rendering.cpu.blending import _FAST, _copy_records, _exp_minus, _footprint, _pixel_centres


@compiled(
    "void(float32[:, ::1], int32[::1], uint16[::1], int32[::1], int64[::1], int64, int64, int64,"
    " float32[::1], float32[::1], float32[:, ::1], int32[:, ::1],"
    " float32[:, :, ::1], float32[:, ::1], float32[:, ::1], boolean[::1])",
    fastmath=_FAST,
)
def blend_backward(
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
    v_image: np.ndarray,
    v_alpha: np.ndarray,
    v_slots: np.ndarray,
    changed: np.ndarray,
) -> None:
    """Compute gradients of tiles ``first`` to ``last`` (exclusive), which were rendered.

    Args:
        records, members, spans, starts, first, last, columns, limits, background, transmittance, stops: as for
            :func:`kissgs.rendering.cpu.blending.blend`.
        slots: row of ``v_slots`` of each member.
        v_image: ``(H, W, 3)`` gradient of the loss by the image.
        v_alpha: ``(H, W)`` gradient of the loss by 1 - transmittance.
        v_slots: out, ``(slots, 9)``, 0 before: sums over the tile's pixels of the gradient by the exponent times 1, u,
            v, u², uv, v²; and the gradient by the colour's R, G, B.
        changed: out, ``(M,)``, False before: True for footprints whose gradient is not 0 in one of the tiles.
    """
    alpha_min, alpha_max = limits[0], limits[1]
    zero, one = np.float32(0), np.float32(1)
    height, width = transmittance.shape
    # Per pixel: x, y, stop, T; gradient by R, G, B and alpha; product of the colour behind and its gradient.
    s = np.empty(9 * 256, np.float32)
    # Slots lie anywhere in memory, as records do.
    copies, sums = np.empty((64, 9), np.float32), np.empty((64, 9), np.float32)
    _pixel_centres(s)
    for tile in range(first, last):
        x0, y0 = (tile % columns) * 16, (tile // columns) * 16
        begin = starts[tile]
        last_stop = 0
        for p in range(256):
            x, y = x0 + (p & 15), y0 + (p >> 4)
            last_stop = max(last_stop, stops[tile, p])
            s[512 + p] = np.float32(stops[tile, p])
            inside = x < width and y < height
            x, y = min(x, width - 1), min(y, height - 1)
            s[768 + p] = transmittance[y, x] if inside else one
            s[1024 + p] = v_image[y, x, 0] if inside else zero
            s[1280 + p] = v_image[y, x, 1] if inside else zero
            s[1536 + p] = v_image[y, x, 2] if inside else zero
            s[1792 + p] = v_alpha[y, x] if inside else zero
            s[2048 + p] = background[0] * s[1024 + p] + background[1] * s[1280 + p] + background[2] * s[1536 + p]
        for end in range(begin + last_stop, begin, -64):
            start = max(begin, end - 64)
            _copy_records(records, members, start, end, copies)
            for i in range(end - 1, start - 1, -1):
                j = i - start
                (mx, my, l0, l1, l2), (opacity, red, green, blue) = _footprint(copies, j, x0, y0)
                top, bottom = np.uint64(spans[i] >> 5), np.uint64(spans[i] & 31)
                index = np.float32(i - begin)
                m, mu, mv, muu, muv, mvv, vr, vg, vb = zero, zero, zero, zero, zero, zero, zero, zero, zero
                for p in range(top * np.uint64(16), bottom * np.uint64(16)):
                    dx, dy = s[p] - mx, s[p + np.uint64(256)] - my
                    u, v = l0 * dx + l1 * dy, l2 * dy
                    full = opacity * _exp_minus(u * u + v * v)
                    alpha = min(full, alpha_max)
                    alpha = alpha if alpha >= alpha_min else zero
                    alpha = alpha if index < s[p + np.uint64(512)] else zero
                    t = s[p + np.uint64(768)] / (one - alpha)
                    s[p + np.uint64(768)] = t
                    gr, gg, gb = s[p + np.uint64(1024)], s[p + np.uint64(1280)], s[p + np.uint64(1536)]
                    weight = alpha * t
                    vr += weight * gr
                    vg += weight * gg
                    vb += weight * gb
                    change = red * gr + green * gg + blue * gb + s[p + np.uint64(1792)] - s[p + np.uint64(2048)]
                    s[p + np.uint64(2048)] += alpha * change
                    g = -weight * change
                    g = g if full <= alpha_max else zero
                    m += g
                    mu += g * u
                    mv += g * v
                    muu += g * u * u
                    muv += g * u * v
                    mvv += g * v * v
                sums[j, 0], sums[j, 1], sums[j, 2], sums[j, 3], sums[j, 4], sums[j, 5] = m, mu, mv, muu, muv, mvv
                sums[j, 6], sums[j, 7], sums[j, 8] = vr, vg, vb
            for i in range(start, end):
                for c in range(9):
                    v_slots[slots[i], c] = sums[i - start, c]
                    if sums[i - start, c] != 0:
                        changed[members[i]] = True


@compiled(
    "void(float32[:, ::1], int32[::1], uint16[::1], int32[::1], int64[::1], int64, int64, int64,"
    " float32[::1], int32[:, ::1], float32[:, :, ::1], float32[:, ::1])",
    fastmath=_FAST,
)
def blend_colors_backward(
    records: np.ndarray,
    members: np.ndarray,
    spans: np.ndarray,
    slots: np.ndarray,
    starts: np.ndarray,
    first: int,
    last: int,
    columns: int,
    limits: np.ndarray,
    stops: np.ndarray,
    v_image: np.ndarray,
    v_slots: np.ndarray,
) -> None:
    """Compute gradients by colours alone, of tiles ``first`` to ``last`` (exclusive).

    The arguments are those of :func:`blend_backward`. ``v_slots``: out, ``(slots, 3)``, sums over the tile's pixels of
    the gradient by the colour's R, G, B.
    """
    alpha_min, alpha_max = limits[0], limits[1]
    zero, one = np.float32(0), np.float32(1)
    height, width = v_image.shape[0], v_image.shape[1]
    # Per pixel: x, y, stop, T; gradient by R, G, B.
    s, copies = np.empty(7 * 256, np.float32), np.empty((64, 9), np.float32)
    _pixel_centres(s)
    for tile in range(first, last):
        x0, y0 = (tile % columns) * 16, (tile // columns) * 16
        begin, last_stop = starts[tile], 0
        for p in range(256):
            x, y = x0 + (p & 15), y0 + (p >> 4)
            last_stop = max(last_stop, stops[tile, p])
            s[512 + p] = np.float32(stops[tile, p])
            s[768 + p] = one
            inside = x < width and y < height
            x, y = min(x, width - 1), min(y, height - 1)
            s[1024 + p] = v_image[y, x, 0] if inside else zero
            s[1280 + p] = v_image[y, x, 1] if inside else zero
            s[1536 + p] = v_image[y, x, 2] if inside else zero
        for i in range(begin + last_stop, starts[tile + 1]):
            v_slots[slots[i], :] = zero
        for start in range(begin, begin + last_stop, 64):
            end = min(start + 64, begin + last_stop)
            _copy_records(records, members, start, end, copies)
            for i in range(start, end):
                (mx, my, l0, l1, l2), (opacity, _, _, _) = _footprint(copies, i - start, x0, y0)
                top, bottom = np.uint64(spans[i] >> 5), np.uint64(spans[i] & 31)
                index = np.float32(i - begin)
                red, green, blue = zero, zero, zero
                for p in range(top * np.uint64(16), bottom * np.uint64(16)):
                    dx, dy = s[p] - mx, s[p + np.uint64(256)] - my
                    u, v = l0 * dx + l1 * dy, l2 * dy
                    alpha = min(opacity * _exp_minus(u * u + v * v), alpha_max)
                    alpha = alpha if alpha >= alpha_min else zero
                    alpha = alpha if index < s[p + np.uint64(512)] else zero
                    weight = alpha * s[p + np.uint64(768)]
                    s[p + np.uint64(768)] -= weight
                    red += weight * s[p + np.uint64(1024)]
                    green += weight * s[p + np.uint64(1280)]
                    blue += weight * s[p + np.uint64(1536)]
                v_slots[slots[i], 0], v_slots[slots[i], 1], v_slots[slots[i], 2] = red, green, blue


@compiled(
    "void(float32[:, ::1], float32[:, ::1], int32[::1], int32[::1], int32[::1], int64, int64, float32, float32[:, ::1])"
)
def add_colors(
    v_slots: np.ndarray,
    records: np.ndarray,
    rows: np.ndarray,
    slots_from: np.ndarray,
    visible: np.ndarray,
    first: int,
    last: int,
    factor: float,
    v_colors: np.ndarray,
) -> None:
    """Add ``factor`` times the sum of the slots of the footprints ``rows[first:last]`` to ``v_colors[visible]``.

    Colours that are clamped to 0 have no gradient.
    """
    for i in range(first, last):
        row = rows[i]
        for c in range(3):
            if records[row, 6 + c] > 0:
                total = np.float32(0)
                for slot in range(slots_from[row], slots_from[row + 1]):
                    total += v_slots[slot, c]
                v_colors[visible[row], c] += factor * total
