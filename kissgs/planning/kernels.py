"""Compiled inner loops of the encoder."""

from __future__ import annotations

import numpy as np

from kissgs.core.array_types import Float32, Int32, Int64, UInt8
from kissgs.core.numba_kernels import compiled


@compiled("void(uint16[:, ::1], uint64[::1])")
def hilbert_keys(cells: np.ndarray, keys: np.ndarray) -> None:
    """Write the position of every cell ``(N, 3)`` uint16 along the 3D Hilbert curve of order 16 to ``keys`` ``(N,)``.

    Skilling, "Programming the Hilbert curve", AIP Conf. Proc. 707 (2004).
    """
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


@compiled("void(float32[:, :, ::1], int64, float32[:, :, ::1], float64[:, ::1])")
def box_blur_rows(image: np.ndarray, radius: int, out: np.ndarray, total: np.ndarray) -> None:
    """Average 2*radius+1 columns of every row of ``(H, W, C)``, wrapping around; ``total`` is ``(1, C)`` scratch."""
    height, width, channels = image.shape
    scale = 1.0 / (2 * radius + 1)
    for y in range(height):
        for c in range(channels):
            total[0, c] = 0.0
        for x in range(-radius, radius + 1):
            for c in range(channels):
                total[0, c] += image[y, x % width, c]
        for x in range(width):
            enter = (x + radius + 1) % width
            leave = (x - radius) % width
            for c in range(channels):
                out[y, x, c] = total[0, c] * scale
                total[0, c] += np.float64(image[y, enter, c]) - np.float64(image[y, leave, c])


@compiled("void(float32[:, :, ::1], int64, float32[:, :, ::1], float64[:, ::1])")
def box_blur_columns(image: np.ndarray, radius: int, out: np.ndarray, total: np.ndarray) -> None:
    """Average 2*radius+1 rows of every column of ``(H, W, C)``, mirrored at the borders without repeating the edge.

    ``total`` is ``(W, C)`` scratch.
    """
    height, width, channels = image.shape
    scale = 1.0 / (2 * radius + 1)
    period = max(2 * (height - 1), 1)
    total[:, :] = 0.0
    for y in range(-radius, radius + 1):
        source = abs(y) % period
        source = min(source, period - source)
        for x in range(width):
            for c in range(channels):
                total[x, c] += image[source, x, c]
    for y in range(height):
        enter = (y + radius + 1) % period
        enter = min(enter, period - enter)
        leave = abs(y - radius) % period
        leave = min(leave, period - leave)
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

    This permutation has the smallest squared distance, since the squares of items and targets do not depend on it.
    The sums before and after are added to ``score``.
    """
    product = np.empty((4, 4), dtype=np.float32)
    for i in range(4):
        item = placed[cells[i]]
        for j in range(4):
            cell = cells[j]
            acc = np.float32(0)
            for c in range(items.shape[1]):
                acc += items[item, c] * target[cell, c]
            product[i, j] = acc
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
    """Move the items of some blocks of a shifted tiling towards their target, in random groups of four.

    Shuffles of a block depend on ``seed`` and the block's number alone, not on threads. A block ends after a pass that
    reduces its squared distance by less than the share ``threshold``. Return the reduction of all squared distances.
    """
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
