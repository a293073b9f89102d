"""Numba kernels of SSIM and of plain differences: sums over a tile and, in the same pass, gradients; sums for metrics.

SSIM needs the images x and y only as their sum s = x + y and difference d = x - y. With G the blur, S = G s,
D = G d, p = G s² - S² and q = G d² - D² (four blurs instead of five),

    SSIM = (S² - D² + 2 C1) / (S² + D² + 2 C1) · (p - q + 2 C2) / (p + q + 2 C2) = luminance · structure,

and its gradient by x takes three more blurs: 2 (G M + s G ∂p + d G ∂q), where M = S (∂S² - ∂p) + D (∂D² - ∂q). Equal
images have d = 0 and SSIM exactly 1, and swapping them changes no bit.

A tile is processed row by row; the last eleven rows stay in the cache, in ring buffers, s and d in the first, M, ∂p and
∂q in the second. Each row is written twice, the second time eleven rows further, so that the last eleven are always
contiguous and the compiler can vectorise a blur. A tile has at most 480 columns (160 pixels of 3 channels); the maps
extend 15 further on both sides, with a stride of 512; s and d 30 further, with a stride of 576.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from kissgs.core.numba_kernels import compiled

_FAST = {"contract", "nsz", "reassoc"}  # without "nnan", so that NaN stays NaN


@njit
def _zeros(count: int) -> np.ndarray:
    """Return zeros that begin at a cache line: half of the vectors would cross one otherwise, which costs a third."""
    zeros = np.zeros(count + 16, np.float32)
    first = -(zeros.ctypes.data // 4) % 16
    return zeros[first : first + count]


@compiled("float32(float32[::1], int64, int64)", inline="always")
def _blur(x: np.ndarray, i: int, step: int) -> np.float32:
    """Return the 11-tap Gaussian of standard deviation 1.5 over ``x[i], x[i + step], ...``."""
    return (
        np.float32(0.00102838008447911) * (x[i] + x[i + 10 * step])
        + np.float32(0.007598758135239185) * (x[i + step] + x[i + 9 * step])
        + np.float32(0.03600077212843083) * (x[i + 2 * step] + x[i + 8 * step])
        + np.float32(0.10936068950970002) * (x[i + 3 * step] + x[i + 7 * step])
        + np.float32(0.2130055377112537) * (x[i + 4 * step] + x[i + 6 * step])
        + np.float32(0.26601172486179436) * x[i + 5 * step]
    )


@compiled("float32(float32[::1], int64, int64)", inline="always")
def _blur_squares(x: np.ndarray, i: int, step: int) -> np.float32:
    """Return the 11-tap Gaussian over the squares of ``x[i], x[i + step], ...``."""
    return (
        np.float32(0.00102838008447911) * (x[i] * x[i] + x[i + 10 * step] * x[i + 10 * step])
        + np.float32(0.007598758135239185) * (x[i + step] * x[i + step] + x[i + 9 * step] * x[i + 9 * step])
        + np.float32(0.03600077212843083) * (x[i + 2 * step] * x[i + 2 * step] + x[i + 8 * step] * x[i + 8 * step])
        + np.float32(0.10936068950970002) * (x[i + 3 * step] * x[i + 3 * step] + x[i + 7 * step] * x[i + 7 * step])
        + np.float32(0.2130055377112537) * (x[i + 4 * step] * x[i + 4 * step] + x[i + 6 * step] * x[i + 6 * step])
        + np.float32(0.26601172486179436) * (x[i + 5 * step] * x[i + 5 * step])
    )


@compiled("void(float32[::1], float32[::1], float32[::1])", fastmath=_FAST)
def _sum_and_difference(x: np.ndarray, y: np.ndarray, ring: np.ndarray) -> None:
    """Write s and d of a row, twice; values beyond ±1e9 are clamped, so that fourth powers are finite; NaN stays."""
    largest = np.float32(1e9)
    for j in range(len(x)):
        a = largest if x[j] > largest else (-largest if x[j] < -largest else x[j])
        b = largest if y[j] > largest else (-largest if y[j] < -largest else y[j])
        ring[j] = a + b
        ring[j + 576] = a - b
        ring[j + 12672] = a + b
        ring[j + 13248] = a - b


@compiled("void(float32[::1], int64, float32[::1])", fastmath=_FAST)
def _moments(ring: np.ndarray, count: int, out: np.ndarray) -> None:
    """Blur ``count`` columns of s, d and their squares vertically, over the first eleven rows of ``ring``."""
    for j in range(count):
        out[j] = _blur(ring, j, 1152)
        out[j + 576] = _blur(ring, j + 576, 1152)
        out[j + 1152] = _blur_squares(ring, j, 1152)
        out[j + 1728] = _blur_squares(ring, j + 576, 1152)


@njit(inline="always")
def _means_and_variances(moments: np.ndarray, j: int) -> tuple[np.float32, np.float32, np.float32, np.float32]:
    """Blur the moments of column j horizontally; return the means of s and d, and their variances."""
    zero = np.float32(0)
    S = _blur(moments, j, 3)
    D = _blur(moments, j + 576, 3)
    p = _blur(moments, j + 1152, 3) - S * S
    q = _blur(moments, j + 1728, 3) - D * D
    return S, D, (zero if p < zero else p), (zero if q < zero else q)  # variances may be negative by rounding


@compiled("void(float32[::1], float32[::1], float32[::1])", fastmath=_FAST)
def _maps(moments: np.ndarray, values: np.ndarray, ring: np.ndarray) -> None:
    """Blur the moments horizontally; write SSIM into ``values`` and its derivatives M, ∂p and ∂q into ``ring``."""
    c1 = np.float32(2 * 0.01**2)
    c2 = np.float32(2 * 0.03**2)
    one, two = np.float32(1), np.float32(2)
    for j in range(len(values)):
        S, D, p, q = _means_and_variances(moments, j)
        SS = S * S
        DD = D * D
        luminance = (SS - DD + c1) / (SS + DD + c1)
        structure = (p - q + c2) / (p + q + c2)
        by_luminance = one / (SS + DD + c1)
        by_structure = one / (p + q + c2)
        # 1 - structure = 2 q / (p + q + 2 C2), without cancellation.
        dp = two * luminance * (q * by_structure) * by_structure
        dq = -luminance * (one + structure) * by_structure
        dSS = two * structure * (DD * by_luminance) * by_luminance
        dDD = -structure * (one + luminance) * by_luminance
        values[j] = luminance * structure
        M = S * (dSS - dp) + D * (dDD - dq)
        ring[j] = M
        ring[j + 512] = dp
        ring[j + 1024] = dq
        ring[j + 16896] = M
        ring[j + 17408] = dp
        ring[j + 17920] = dq


@compiled("void(float32[::1], float32[::1], float32[::1])", fastmath=_FAST)
def _similarities(moments: np.ndarray, values: np.ndarray, structures: np.ndarray) -> None:
    """Blur the moments horizontally; write SSIM into ``values`` and its second factor into ``structures``."""
    c1 = np.float32(2 * 0.01**2)
    c2 = np.float32(2 * 0.03**2)
    for j in range(len(values)):
        S, D, p, q = _means_and_variances(moments, j)
        SS = S * S
        DD = D * D
        structure = (p - q + c2) / (p + q + c2)
        values[j] = (SS - DD + c1) / (SS + DD + c1) * structure
        structures[j] = structure


@compiled("void(float32[::1], int64, float32[::1])", fastmath=_FAST)
def _blur_maps(ring: np.ndarray, count: int, out: np.ndarray) -> None:
    """Blur ``count`` columns of the maps vertically, over the first eleven rows of ``ring``."""
    for j in range(count):
        out[j] = _blur(ring, j, 1536)
        out[j + 512] = _blur(ring, j + 512, 1536)
        out[j + 1024] = _blur(ring, j + 1024, 1536)


@compiled("void(float32[::1], float32[::1], float32, float32, float32, float32[::1])", fastmath=_FAST)
def _gradient(
    blurred: np.ndarray, row: np.ndarray, l1: np.float32, l2: np.float32, ssim: np.float32, out: np.ndarray
) -> None:
    """Blur the maps horizontally; write a weighted sum of the gradients of |d|, h(d) / 2 and SSIM / 2."""
    zero, one = np.float32(0), np.float32(1)
    for j in range(len(out)):
        s = row[j]
        d = row[j + 576]
        sign = one if d > zero else (-one if d < zero else zero)
        slope = _blur(blurred, j, 3) + s * _blur(blurred, j + 512, 3) + d * _blur(blurred, j + 1024, 3)
        bounded = one if d > one else (-one if d < -one else d)
        out[j] = l1 * sign + l2 * bounded + ssim * slope


@compiled("void(float32[::1], float32[::1], float64[::1])", fastmath=_FAST)
def _add(differences: np.ndarray, values: np.ndarray, sums: np.ndarray) -> None:
    """Add Σ|d|, Σ h(d) and Σ SSIM of a row, in float64."""
    total, squares, similar = 0.0, 0.0, 0.0
    for j in range(len(values)):
        d = abs(np.float64(differences[j]))
        bounded = min(d, 1.0)
        total += d
        squares += bounded * (2 * d - bounded)
        similar += np.float64(values[j])
    sums[0] += total
    sums[1] += squares
    sums[2] += similar


@compiled("void(float32[::1], int64, int64)")
def _clear(ring: np.ndarray, slot: int, length: int) -> None:
    """Set both copies of a row of a ring buffer to zero."""
    for j in range(length):
        ring[slot * length + j] = np.float32(0)
        ring[(slot + 11) * length + j] = np.float32(0)


@compiled(
    "void(float32[:, ::1], float32[:, ::1], int64[::1], float32, float32, float32, float32[:, ::1], float64[::1])"
)
def ssim_tile(
    image: np.ndarray,
    target: np.ndarray,
    tile: np.ndarray,
    l1: np.float32,
    l2: np.float32,
    ssim: np.float32,
    gradient: np.ndarray,
    sums: np.ndarray,
) -> None:
    """Compute sums over one tile, and the gradient of l1 Σ|d| + l2 Σ h(d) / 2 + ssim Σ SSIM / 2. d is image - target,
    whose channels are interleaved; h(d) is d² up to |d| = 1, and 2 |d| - 1 beyond. ``tile`` is top, bottom, left and
    right, ends exclusive; columns count channels, at most 480. ``gradient`` is ``(0, 0)`` for the sums only, to which
    Σ|d|, Σ h(d) and Σ SSIM are added."""
    height, width = image.shape
    top, bottom, left, right = tile
    count = right - left
    first, last = max(left - 30, 0), min(right + 30, width)  # columns of s and d inside the image
    near, far = max(15 - left, 0), min(count + 30, width - left + 15)  # of the maps; the others stay zero
    ring = _zeros(22 * 1152)
    moments = _zeros(4 * 576)
    values = _zeros(512)
    map_ring = _zeros(22 * 1536)
    blurred = _zeros(3 * 512)
    reach = 10 if gradient.size > 0 else 5
    for step in range(bottom - top + 2 * reach):
        slot, oldest = step % 11, (step + 1) % 11
        y = top - reach + step
        if 0 <= y < height:
            _sum_and_difference(image[y, first:last], target[y, first:last], ring[slot * 1152 + first - left + 30 :])
        else:
            _clear(ring, slot, 1152)
        if step < 10:
            continue
        y -= 5  # row of the maps
        if 0 <= y < height:
            _moments(ring[oldest * 1152 :], count + 60, moments)
            _maps(moments[near:], values[near:far], map_ring[slot * 1536 + near :])
            if top <= y < bottom:
                _add(ring[(oldest + 5) * 1152 + 606 :], values[15 : 15 + count], sums)
        else:
            _clear(map_ring, slot, 1536)
        if step < 20 or gradient.size == 0:
            continue
        y -= 5  # row of the gradient
        _blur_maps(map_ring[oldest * 1536 :], count + 30, blurred)
        _gradient(blurred, ring[oldest * 1152 + 30 :], l1, l2, ssim, gradient[y, left:right])


@compiled("void(float32[:, ::1], float32[:, ::1], int64[::1], float64[:, :, :, ::1])")
def similarity_tile(image: np.ndarray, target: np.ndarray, tile: np.ndarray, sums: np.ndarray) -> None:
    """Add the sums of SSIM and of its factor structure over one tile, for each patch and channel, to ``(h, w, 2, 3)``.
    The tile is as for :func:`ssim_tile`. Patches of 32x32 pixels start at the top left of the image, and the last ones
    take what remains of it; a single patch is the whole image."""
    height, width = image.shape
    top, bottom, left, right = tile
    first, last = max(left - 15, 0), min(right + 15, width)  # columns inside the image; the others stay zero
    ring = _zeros(22 * 1152)
    moments = _zeros(4 * 576)
    maps = np.zeros((2, right - left), dtype=np.float32)
    for step in range(bottom - top + 10):
        slot, y = step % 11, top - 5 + step
        if 0 <= y < height:
            _sum_and_difference(image[y, first:last], target[y, first:last], ring[slot * 1152 + first - left + 15 :])
        else:
            _clear(ring, slot, 1152)
        if step < 10:
            continue
        _moments(ring[(step + 1) % 11 * 1152 :], right - left + 30, moments)
        _similarities(moments, maps[0], maps[1])
        row = min((y - 5) // 32, sums.shape[0] - 1)
        for j in range(0, right - left, 3):
            column = min((left + j) // 96, sums.shape[1] - 1)
            for channel in range(3):
                sums[row, column, 0, channel] += np.float64(maps[0, j + channel])
                sums[row, column, 1, channel] += np.float64(maps[1, j + channel])
