"""Compiled inner loops of :mod:`kissgs.planning.order_refinement`: near pixels, and local search (2-opt, Or-opt)."""

from __future__ import annotations

import numpy as np
from numba import njit

from kissgs.core.array_types import Int32, UInt8
from kissgs.core.numba_kernels import compiled


@njit(nogil=True, error_model="numpy")
def _bits_between(pixels: np.ndarray, bits: np.ndarray, a: int, b: int) -> int:
    """Return the bits of pixel ``a`` beside pixel ``b``."""
    total = 0
    for channel in range(pixels.shape[1]):
        total += bits[channel, np.uint8(pixels[a, channel] - pixels[b, channel])]
    return total


@compiled("void(uint8[:, ::1], int32[:, ::1], int32[:, ::1], int64, int32[:, ::1])")
def near_pixels(
    pixels: UInt8[np.ndarray, "N C"],
    bits: Int32[np.ndarray, "C 256"],
    curves: Int32[np.ndarray, "K N"],
    reach: int,
    near: Int32[np.ndarray, "N k"],
) -> None:
    """Find the pixels that take the fewest bits beside each pixel, among those that are near it on some curves.

    ``bits`` are those of each difference modulo 256, ``curves`` permutations, and ``reach`` places on a curve in both
    directions. ``near`` has the fewest bits first, and is filled up with the pixel itself.
    """
    count, most = near.shape
    best = np.empty((count, most), np.int64)
    for n in range(count):
        for place in range(most):
            near[n, place], best[n, place] = n, 1 << 40
    for curve in range(curves.shape[0]):
        for i in range(count):
            n = curves[curve, i]
            for j in range(max(i - reach, 0), min(i + reach + 1, count)):
                if j == i:
                    continue
                other = curves[curve, j]
                cost = _bits_between(pixels, bits, n, other)
                if cost >= best[n, most - 1]:
                    continue
                known = False
                for place in range(most):
                    known |= near[n, place] == other
                if known:
                    continue
                place = most - 1
                while place > 0 and best[n, place - 1] > cost:
                    near[n, place], best[n, place] = near[n, place - 1], best[n, place - 1]
                    place -= 1
                near[n, place], best[n, place] = other, cost


@njit(nogil=True, error_model="numpy")
def _reverse(order: np.ndarray, places: np.ndarray, first: int, last: int) -> None:
    """Reverse the order from ``first`` to ``last``, both included."""
    while first < last:
        a, b = order[first], order[last]
        order[first], order[last] = b, a
        places[b], places[a] = first, last
        first, last = first + 1, last - 1


@njit(nogil=True, error_model="numpy")
def _reversal(
    order: np.ndarray, places: np.ndarray, pixels: np.ndarray, bits: np.ndarray, near: np.ndarray, a: int, side: int
) -> bool:
    """Join ``a`` to a near pixel by the best reversal (2-opt), on its later ``side``, 1, or its earlier one, -1."""
    count, i = len(order), places[a]
    if not 0 <= i + side < count:
        return False
    beside = order[i + side]
    now = _bits_between(pixels, bits, a, beside)
    best, found = 0, -1
    for place in range(near.shape[1]):
        b = near[a, place]
        j, joined = places[b], _bits_between(pixels, bits, a, b)
        if joined >= now:
            break
        if not 0 <= j + side < count:
            continue
        other = order[j + side]
        gain = now + _bits_between(pixels, bits, b, other) - joined - _bits_between(pixels, bits, beside, other)
        if gain > best:
            best, found = gain, j
    if found < 0:
        return False
    later = 1 if side > 0 else 0
    _reverse(order, places, min(i, found) + later, max(i, found) + later - 1)
    return True


@njit(nogil=True, error_model="numpy")
def _move(
    order: np.ndarray, places: np.ndarray, pixels: np.ndarray, bits: np.ndarray, near: np.ndarray, a: int, length: int
) -> bool:
    """Move the ``length`` pixels that begin with ``a`` beside a pixel near their first or last one (Or-opt)."""
    count, i = len(order), places[a]
    if i < 1 or i + length >= count:
        return False
    before, last, after = order[i - 1], order[i + length - 1], order[i + length]
    saved = (
        _bits_between(pixels, bits, before, a)
        + _bits_between(pixels, bits, last, after)
        - _bits_between(pixels, bits, before, after)
    )
    best, found, found_side, joined_first = 0, -1, 0, False
    for first in (True, False):
        joined, loose = (a, last) if first else (last, a)
        for place in range(near.shape[1]):
            b = near[joined, place]
            cost, j = _bits_between(pixels, bits, joined, b), places[b]
            if cost >= saved:
                break
            if i <= j < i + length:
                continue
            for side in (1, -1):
                k = j + side
                if not 0 <= k < count or i <= k < i + length:
                    continue
                other = order[k]
                gain = saved - cost - _bits_between(pixels, bits, loose, other) + _bits_between(pixels, bits, b, other)
                if gain > best:
                    best, found, found_side, joined_first = gain, j, side, first
    if found < 0:
        return False
    if joined_first != (found_side > 0):  # after b its joined end comes first, before b last
        _reverse(order, places, i, i + length - 1)
    if found > i:
        end = found if found_side > 0 else found - 1
        _rotate(order, places, i, i + length, end + 1)
    else:
        _rotate(order, places, found + 1 if found_side > 0 else found, i, i + length)
    return True


@njit(nogil=True, error_model="numpy")
def _rotate(order: np.ndarray, places: np.ndarray, first: int, middle: int, end: int) -> None:
    """Swap the part from ``first`` to before ``middle`` with the part from there to before ``end``."""
    moved = np.concatenate((order[middle:end], order[first:middle]))
    for k in range(len(moved)):
        order[first + k] = moved[k]
        places[moved[k]] = first + k


@compiled("void(uint8[:, ::1], int32[:, ::1], int32[:, ::1], int64, int32[::1])")
def improve(
    pixels: UInt8[np.ndarray, "N C"],
    bits: Int32[np.ndarray, "C 256"],
    near: Int32[np.ndarray, "N k"],
    passes: int,
    order: Int32[np.ndarray, " N"],
) -> None:
    """Reorder pixels such that each takes fewer bits beside the one before it; the first and the last one stay.

    ``bits`` are equal for a difference and its negative.
    """
    places = np.empty(len(order), np.int32)
    for place in range(len(order)):
        places[order[place]] = place
    for _ in range(passes):
        changes = 0
        for a in range(len(order)):
            for side in (1, -1):
                changes += _reversal(order, places, pixels, bits, near, a, side)
            for length in (1, 2, 3):
                if _move(order, places, pixels, bits, near, a, length):
                    changes += 1
                    break
        if changes == 0:
            break
