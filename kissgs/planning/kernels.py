"""Compiled inner loops of the encoder: sorting, rotations' forms, local search of the order, and choice of levels."""

from __future__ import annotations

import numpy as np
from numba import njit

from kissgs.core.array_types import Float32, Float64, Int32, Int64, UInt8, UInt64
from kissgs.core.numba_kernels import compiled


@compiled("void(uint16[:, ::1], uint64[::1])")
def hilbert_keys(cells: np.ndarray, keys: np.ndarray) -> None:
    """Write the position of every cell ``(N, 3)`` uint16 along the 3D Hilbert curve of order 16 to ``keys`` ``(N,)``.
    Skilling, "Programming the Hilbert curve", AIP Conf. Proc. 707 (2004)."""
    for n in range(cells.shape[0]):
        x0 = np.uint32(cells[n, 0])
        x1 = np.uint32(cells[n, 1])
        x2 = np.uint32(cells[n, 2])
        for shift in range(15, 0, -1):
            bit = np.uint32(1) << np.uint32(shift)
            low = bit - np.uint32(1)
            if x0 & bit:
                x0 ^= low
            if x1 & bit:
                x0 ^= low
            else:
                swap = (x0 ^ x1) & low
                x0 ^= swap
                x1 ^= swap
            if x2 & bit:
                x0 ^= low
            else:
                swap = (x0 ^ x2) & low
                x0 ^= swap
                x2 ^= swap
        x1 ^= x0
        x2 ^= x1
        gray = np.uint32(0)
        for shift in range(15, 0, -1):
            bit = np.uint32(1) << np.uint32(shift)
            if x2 & bit:
                gray ^= bit - np.uint32(1)
        x0 ^= gray
        x1 ^= gray
        x2 ^= gray
        key = np.uint64(0)
        for shift in range(15, -1, -1):
            s = np.uint32(shift)
            key = (
                (key << np.uint64(3))
                | (np.uint64((x0 >> s) & np.uint32(1)) << np.uint64(2))
                | (np.uint64((x1 >> s) & np.uint32(1)) << np.uint64(1))
                | np.uint64((x2 >> s) & np.uint32(1))
            )
        keys[n] = key


@compiled("void(float32[:, :, ::1], int64[::1], float32[:, :, ::1])")
def box_blur(image: np.ndarray, places: np.ndarray, out: np.ndarray) -> None:
    """Write the mean of the rows ``places[y:][:size]`` of ``(H, W, C)`` to row ``y``; there are ``H + size`` places."""
    height, width, channels = image.shape
    size = places.shape[0] - height
    scale, total = 1.0 / size, np.zeros((width, channels))
    for place in places[:size]:
        for x in range(width):
            for c in range(channels):
                total[x, c] += image[place, x, c]
    for y in range(height):
        leave, enter = places[y], places[y + size]
        for x in range(width):
            for c in range(channels):
                out[y, x, c] = total[x, c] * scale
                total[x, c] += np.float64(image[enter, x, c]) - np.float64(image[leave, x, c])


@compiled("uint64(uint64)", inline="always")
def _mix(state: np.uint64) -> np.uint64:
    """Return the next number of splitmix64, which is equal on every machine and in every thread."""
    z = state + np.uint64(0x9E3779B97F4A7C15)
    z = (z ^ (z >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    z = (z ^ (z >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    return z ^ (z >> np.uint64(31))


@compiled("void(float32[:, ::1], int32[::1], float32[:, ::1], int32[::1], float64[::1])")
def _sort_four(items: np.ndarray, placed: np.ndarray, target: np.ndarray, cells: np.ndarray, score: np.ndarray) -> None:
    """Permute the four items in ``cells`` so that the sum of their scalar products with the cells' targets is largest.
    This permutation has the smallest squared distance, since the squares of items and targets do not depend on it. The
    sums before and after are added to ``score``."""
    product = np.empty((4, 4), dtype=np.float32)
    c0, c1, c2, c3 = cells[0], cells[1], cells[2], cells[3]
    for i in range(4):
        item = placed[cells[i]]
        s0 = s1 = s2 = s3 = np.float32(0)  # four sums at once, since each waits for its last addition
        for c in range(items.shape[1]):
            value = items[item, c]
            s0 += value * target[c0, c]
            s1 += value * target[c1, c]
            s2 += value * target[c2, c]
            s3 += value * target[c3, c]
        product[i, 0], product[i, 1], product[i, 2], product[i, 3] = s0, s1, s2, s3
    before = product[0, 0] + product[1, 1] + product[2, 2] + product[3, 3]
    best = before
    b0, b1, b2, b3 = 0, 1, 2, 3
    for p0 in range(4):
        for p1 in range(4):
            if p1 == p0:
                continue
            for p2 in range(4):
                if p2 in (p0, p1):
                    continue
                p3 = 6 - p0 - p1 - p2
                total = product[0, p0] + product[1, p1] + product[2, p2] + product[3, p3]
                if total > best:
                    best = total
                    b0, b1, b2, b3 = p0, p1, p2, p3
    score[0] += before
    score[1] += best
    if best > before:
        i0, i1, i2, i3 = placed[cells[0]], placed[cells[1]], placed[cells[2]], placed[cells[3]]
        placed[cells[b0]] = i0  # item 0 goes to cell b0: the assignment itself, not its inverse
        placed[cells[b1]] = i1
        placed[cells[b2]] = i2
        placed[cells[b3]] = i3


@compiled("float64(float32[:, ::1], int32[::1], float32[:, ::1], int64[::1], uint64, float64)")
def plas_blocks(
    items: Float32[np.ndarray, "S*S C"],
    placed: Int32[np.ndarray, " S*S"],  # item in each cell; modified
    target: Float32[np.ndarray, "S*S C"],
    tiling: Int64[np.ndarray, " 6"],  # S, shift down and right, side of a block, first block and end of the blocks
    seed: np.uint64,
    threshold: float,
) -> float:
    """Move the items of some blocks of a shifted tiling towards their target, in random groups of four. Shuffles of a
    block depend on ``seed`` and the block's number alone, not on threads. A block ends after a pass that reduces its
    squared distance by less than the share ``threshold``. Return the reduction of all squared distances."""
    side, down, right, size, first, last = tiling
    per_row = side // size
    cells = np.empty(size * size, dtype=np.int32)
    score = np.zeros(2)
    gained = 0.0
    for block in range(first, last):
        top = down + block // per_row * size
        left = right + block % per_row * size
        distance = 0.0
        for i in range(size * size):
            cell = (top + i // size) % side * side + (left + i % size) % side
            cells[i] = cell
            for c in range(items.shape[1]):
                step = items[placed[cell], c] - target[cell, c]
                distance += step * step
        state = seed + np.uint64(block)
        for _ in range(16):
            for i in range(size * size - 1, 0, -1):
                state = _mix(state)
                j = np.int64(state % np.uint64(i + 1))
                cells[i], cells[j] = cells[j], cells[i]
            score[:] = 0.0
            for group in range(0, size * size, 4):
                _sort_four(items, placed, target, cells[group : group + 4], score)
            shrunk = 2.0 * (score[1] - score[0])
            gained += shrunk
            if shrunk <= threshold * distance:
                break
            distance -= shrunk
    return gained


@compiled("void(float32[:, ::1], float32[:, ::1], float32[:, ::1], float32[:, ::1], int64[:, ::1], uint8[::1])")
def nearest_forms(
    quats: Float32[np.ndarray, "N 4"],  # unit quaternions times the proxy's levels per unit
    scales: Float32[np.ndarray, "N 3"],  # log-scales times the proxy's levels per unit
    target: Float32[np.ndarray, "N 7"],  # target w, x, y, z and three log-scales, in these units
    rotations: Float32[np.ndarray, "24 4"],
    permutations: Int64[np.ndarray, "24 3"],  # order of the scales in the forms
    forms: UInt8[np.ndarray, " N"],  # row of the table, plus 24 for -q; modified: the form on entry wins ties
) -> None:
    """Choose for each Gaussian the one of its 48 equivalent forms with the smallest L1 distance to its target."""
    for n in range(quats.shape[0]):
        w, x, y, z = quats[n, 0], quats[n, 1], quats[n, 2], quats[n, 3]
        t = target[n]
        best = np.float32(np.inf)
        chosen = int(forms[n])
        for k in range(24):
            a, b, c, d = rotations[k, 0], rotations[k, 1], rotations[k, 2], rotations[k, 3]
            qw = w * a - x * b - y * c - z * d
            qx = w * b + x * a + y * d - z * c
            qy = w * c - x * d + y * a + z * b
            qz = w * d + x * c - y * b + z * a
            size = np.float32(0)
            for i in range(3):
                size += abs(scales[n, permutations[k, i]] - t[4 + i])
            plain = size + abs(qw - t[0]) + abs(qx - t[1]) + abs(qy - t[2]) + abs(qz - t[3])
            negated = size + abs(qw + t[0]) + abs(qx + t[1]) + abs(qy + t[2]) + abs(qz + t[3])
            if plain < best or (plain == best and k == forms[n]):
                best = plain
                chosen = k
            if negated < best or (negated == best and k + 24 == forms[n]):
                best = negated
                chosen = k + 24
        forms[n] = chosen


@compiled("void(float64[:, ::1], float64[:, ::1], uint8[::1])")
def largest_w(quats: np.ndarray, rotations: np.ndarray, forms: np.ndarray) -> None:
    """Write the form of largest w of each quaternion ``(N, 4)`` to ``forms``; among equals, the first of the table. w
    is compared in units of 1e-9: without rounding, equal forms would differ. ``rotations`` is ``(24, 4)``."""
    for n in range(quats.shape[0]):
        w, x, y, z = quats[n, 0], quats[n, 1], quats[n, 2], quats[n, 3]
        best = least = np.rint(w * 1e9)  # the first form is the identity
        chosen = lowest = 0
        for k in range(1, 24):
            found = w * rotations[k, 0] - x * rotations[k, 1] - y * rotations[k, 2] - z * rotations[k, 3]
            found = np.rint(found * 1e9)
            if found > best:
                best, chosen = found, k
            if found < least:
                least, lowest = found, k
        forms[n] = chosen if best >= -least else lowest + 24


@compiled(
    "void(float64[:, ::1], float32[:, ::1], uint8[::1], float64[:, ::1], int64[:, ::1], float64[:, ::1],"
    " float32[:, ::1])"
)
def apply_forms(
    quats: Float64[np.ndarray, "N 4"],
    scales: Float32[np.ndarray, "N 3"],
    forms: UInt8[np.ndarray, " N"],  # row of the table, plus 24 if the quaternion is negated
    rotations: Float64[np.ndarray, "24 4"],
    permutations: Int64[np.ndarray, "24 3"],  # scale order of each form
    new_quats: Float64[np.ndarray, "N 4"],  # written
    new_scales: Float32[np.ndarray, "N 3"],  # written
) -> None:
    """Write rotations and log-scales in the forms: the Hamilton product with a row of the table, and its order."""
    for n in range(quats.shape[0]):
        row, sign = forms[n] % 24, 1.0 if forms[n] < 24 else -1.0
        w1, x1, y1, z1 = quats[n, 0], quats[n, 1], quats[n, 2], quats[n, 3]
        w2, x2, y2, z2 = rotations[row, 0], rotations[row, 1], rotations[row, 2], rotations[row, 3]
        new_quats[n, 0] = sign * (w1 * w2 - x1 * x2 - y1 * y2 - z1 * z2)
        new_quats[n, 1] = sign * (w1 * x2 + x1 * w2 + y1 * z2 - z1 * y2)
        new_quats[n, 2] = sign * (w1 * y2 - x1 * z2 + y1 * w2 + z1 * x2)
        new_quats[n, 3] = sign * (w1 * z2 + x1 * y2 - y1 * x2 + z1 * w2)
        for i in range(3):
            new_scales[n, i] = scales[n, permutations[row, i]]


@njit(nogil=True, error_model="numpy")
def _covariance(quats: np.ndarray, scales: np.ndarray, largest: float, n: int, out: np.ndarray) -> None:
    """Write the covariance of one Gaussian, divided by the square of exp(``largest``), to ``out``, ``(2, 3, 3)``."""
    w, x, y, z = quats[n, 0], quats[n, 1], quats[n, 2], quats[n, 3]
    axes = out[1]
    axes[0, 0], axes[0, 1], axes[0, 2] = 1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)
    axes[1, 0], axes[1, 1], axes[1, 2] = 2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)
    axes[2, 0], axes[2, 1], axes[2, 2] = 2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)
    for k in range(3):
        deviation = np.exp(np.float64(scales[n, k]) - largest)
        for i in range(3):
            axes[i, k] *= deviation
    for i in range(3):
        for j in range(3):
            out[0, i, j] = axes[i, 0] * axes[j, 0] + axes[i, 1] * axes[j, 1] + axes[i, 2] * axes[j, 2]


@compiled("float64(float64[:, ::1], float32[:, ::1], float64[:, ::1], float32[:, ::1])")
def covariance_error(quats: np.ndarray, scales: np.ndarray, new_quats: np.ndarray, new_scales: np.ndarray) -> float:
    """Return the largest relative difference of the covariances before and after, Frobenius norm; 0 of no rows."""
    before, after = np.empty((2, 3, 3)), np.empty((2, 3, 3))
    worst = 0.0
    for n in range(quats.shape[0]):
        largest = np.float64(max(scales[n, 0], scales[n, 1], scales[n, 2]))  # avoids squares of e^±60
        _covariance(quats, scales, largest, n, before)
        _covariance(new_quats, new_scales, largest, n, after)
        size = difference = 0.0
        for i in range(3):
            for j in range(3):
                size += before[0, i, j] * before[0, i, j]
                difference += (after[0, i, j] - before[0, i, j]) ** 2
        worst = max(worst, difference / size)
    return np.sqrt(worst)


@compiled("void(uint64[::1], int32[::1], uint64[::1], int32[::1], int64)")
def sort_keys(
    keys: UInt64[np.ndarray, " N"],
    order: Int32[np.ndarray, " N"],
    other_keys: UInt64[np.ndarray, " N"],
    other_order: Int32[np.ndarray, " N"],
    passes: int,
) -> None:
    """Sort ``keys`` stably by their lowest 12 · ``passes`` bits, and write the permutation to ``order``, by radix sort.
    ``passes`` is even, so that the result ends in ``keys`` and ``order``; the others are scratch."""
    count = keys.shape[0]
    counts = np.zeros((passes, 4096), np.int64)
    for n in range(count):
        order[n] = n
        key = keys[n]
        for digit in range(passes):
            counts[digit, (key >> np.uint64(12 * digit)) & np.uint64(4095)] += 1
    for digit in range(passes):
        total = 0
        for value in range(4096):
            total, counts[digit, value] = total + counts[digit, value], total
        here, there = (keys, other_keys) if digit % 2 == 0 else (other_keys, keys)
        old, new = (order, other_order) if digit % 2 == 0 else (other_order, order)
        shift = np.uint64(12 * digit)
        for n in range(count):
            value = (here[n] >> shift) & np.uint64(4095)
            place = counts[digit, value]
            counts[digit, value] = place + 1
            there[place] = here[n]
            new[place] = old[n]


# Local search of the order (2-opt, Or-opt).


@njit(nogil=True, error_model="numpy")
def _bits_between(pixels: np.ndarray, bits: np.ndarray, a: int, b: int) -> int:
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
    directions. ``near`` has the fewest bits first, and is filled up with the pixel itself."""
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
    _reverse(order, places, first, middle - 1)
    _reverse(order, places, middle, end - 1)
    _reverse(order, places, first, end - 1)


@compiled("void(uint8[:, ::1], int32[:, ::1], int32[:, ::1], int64, int32[::1])")
def improve(
    pixels: UInt8[np.ndarray, "N C"],
    bits: Int32[np.ndarray, "C 256"],
    near: Int32[np.ndarray, "N k"],
    passes: int,
    order: Int32[np.ndarray, " N"],
) -> None:
    """Reorder pixels such that each takes fewer bits beside the one before it; the first and the last one stay.
    ``bits`` are equal for a difference and its negative."""
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


# Choice of levels by squared error and bits.


@njit(nogil=True, error_model="numpy")
def _form_hessian(packed: np.ndarray, order: np.ndarray, floor: np.ndarray, hessian: np.ndarray) -> None:
    """Unpack a Hessian of :class:`kissgs.Sensitivity` for a form with its axes in ``order``, ``(3,)``. ``floor``:
    ``(3,)`` is added to the diagonal: opacity, scales, rotation."""
    hessian[0, 0] = packed[0] + floor[0]
    for i in range(3):
        hessian[0, 1 + i] = hessian[1 + i, 0] = packed[1 + order[i]]
        hessian[1 + i, 1 + i] = packed[4 + order[i]] + floor[1]
        hessian[4 + i, 4 + i] = packed[7 + order[i]] + floor[2]


@njit(nogil=True, error_model="numpy")
def _rotation_vectors(quat: np.ndarray, vectors: np.ndarray) -> None:
    """Write the derivative of the rotation vector by each component of a quaternion, ``(4, 3)``. A change dq of a
    quaternion q turns by the vector 2 Im(conj(q) dq) / |q|²."""
    w, x, y, z = quat[0], quat[1], quat[2], quat[3]
    scale = 2 / (w * w + x * x + y * y + z * z)
    w, x, y, z = scale * w, scale * x, scale * y, scale * z
    vectors[0, 0], vectors[0, 1], vectors[0, 2] = -x, -y, -z
    vectors[1, 0], vectors[1, 1], vectors[1, 2] = w, -z, y
    vectors[2, 0], vectors[2, 1], vectors[2, 2] = z, w, -x
    vectors[3, 0], vectors[3, 1], vectors[3, 2] = -y, x, w


@njit(nogil=True, error_model="numpy")
def _start(
    values: np.ndarray,
    stored: np.ndarray,
    omitted: int,
    tables: np.ndarray,
    levels: np.ndarray,
    vectors: np.ndarray,
    jacobian: np.ndarray,
    error: np.ndarray,
) -> float:
    """Write the error (opacity, scales, rotation vector) of the levels, and its derivatives by the stored components.
    Return the sum of the squares of the components. Where one is left out, the others move it."""
    for j in range(4):
        error[j] = tables[j, levels[j]] - values[j]
    error[4:] = 0.0
    squares = 0.0
    for i in range(len(stored)):
        component, found = stored[i], tables[4 + i, levels[4 + i]]
        squares += found * found
        ratio = values[4 + component] / max(values[4 + omitted], 0.2) if omitted >= 0 else 0.0
        for k in range(3):
            error[4 + k] += (found - values[4 + component]) * vectors[component, k]
            jacobian[4 + i, 4 + k] = vectors[component, k]
            if omitted >= 0:
                jacobian[4 + i, 4 + k] -= ratio * vectors[omitted, k]
    if omitted >= 0:
        missing = np.sqrt(max(1.0 - squares, 0.0)) - values[4 + omitted]
        for k in range(3):
            error[4 + k] += missing * vectors[omitted, k]
    return squares


@compiled(
    "void(float64[:, ::1], int64[:, ::1], int64[::1], float32[:, ::1], uint8[::1], int64[:, ::1], int64[::1],"
    " float64[:, ::1], int64[:, ::1], float64[:, :, ::1], float64[:, :, ::1], float64[::1], int64[:, ::1])"
)
def choose_levels(
    values: Float64[np.ndarray, "N 8"],  # opacity logit, log-scales, quaternion of any length above 0
    stored: Int64[np.ndarray, "N parts"],  # components of the quaternion that have levels
    omitted: Int64[np.ndarray, " N"],  # the one that follows from the length 1, and is not negative; -1 for none
    hessians: Float32[np.ndarray, "N 10"],  # shape Hessians of Sensitivity
    forms: UInt8[np.ndarray, " N"],  # 0 to 23, plus 24 for -q
    orders: Int64[np.ndarray, "24 3"],  # original axis of each axis of a form
    classes: Int64[np.ndarray, " N"],
    tables: Float64[np.ndarray, "C 256"],  # ascending values of the levels
    ends: Int64[np.ndarray, "C 2"],  # smallest and largest level to use
    rate_table: Float64[np.ndarray, "classes C 256"],  # lambda times the bits of each level
    search_range: Float64[np.ndarray, "N 2 C"],  # largest distance of a level below and above the value
    floor: Float64[np.ndarray, " 3"],  # added to the Hessians' diagonals: opacity, scales, rotation
    levels: Int64[np.ndarray, "N C"],  # modified
) -> None:
    """Choose the levels of each Gaussian's opacity, log-scales and quaternion by squared error plus lambda · bits. They
    are chosen one after the other, each given the others, because an error of the opacity can compensate one of a
    scale."""
    columns = levels.shape[1]
    hessian, jacobian, error = np.zeros((7, 7), np.float64), np.zeros((8, 7), np.float64), np.empty(7, np.float64)
    vectors = np.empty((4, 3), np.float64)
    for j in range(4):
        jacobian[j, j] = 1.0
    for n in range(values.shape[0]):
        _form_hessian(hessians[n], orders[forms[n] % 24], floor, hessian)
        _rotation_vectors(values[n, 4:], vectors)
        squares = _start(values[n], stored[n], omitted[n], tables, levels[n], vectors, jacobian, error)
        for j in range(columns):
            start, end = (j, j + 1) if j < 4 else (4, 7)  # the other derivatives are 0
            slope = curvature = 0.0
            for k in range(start, end):
                gradient = across = 0.0
                for i in range(7):
                    gradient += hessian[k, i] * error[i]
                for i in range(start, end):
                    across += hessian[k, i] * jacobian[j, i]
                slope += jacobian[j, k] * gradient
                curvature += jacobian[j, k] * across
            curvature = max(curvature, 0.0)
            value = values[n, j] if j < 4 else values[n, 4 + stored[n, j - 4]]
            least, most = value - search_range[n, 0, j], value + search_range[n, 1, j]
            chosen, now = levels[n, j], tables[j, levels[n, j]]
            others = squares - now * now
            level = min(max(levels[n, j], ends[j, 0]), ends[j, 1])
            while level > ends[j, 0] and tables[j, level - 1] >= least:
                level -= 1
            best = np.inf
            while level <= ends[j, 1] and tables[j, level] <= most:
                found = tables[j, level]
                move = found - now
                cost = (2 * slope + move * curvature) * move + rate_table[classes[n], j, level]
                exists = omitted[n] < 0 or j < 4 or others + found * found <= 0.9999
                if cost < best and found >= least and exists:
                    best, chosen = cost, level
                level += 1
            if chosen != levels[n, j]:
                move = tables[j, chosen] - now
                for k in range(start, end):
                    error[k] += move * jacobian[j, k]
                if j >= 4:
                    squares = others + tables[j, chosen] * tables[j, chosen]
                levels[n, j] = chosen
