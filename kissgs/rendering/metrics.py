"""How alike two images are: PSNR and SSIM, as the 3DGS literature measures them.

Images are ``(H, W, 3)``, in [0, 1] or uint8. Values outside [0, 1] are taken as they are: who compares what a screen
would show clips first. A NaN in either image makes the result NaN, so that no average hides a failed rendering.
"""

from __future__ import annotations

import itertools
import math

import numpy as np

from kissgs.core.array_types import Float32, Float64, Shaped
from kissgs.core.errors import InvalidViewsError
from kissgs.core.threads import Workers

TILE_PIXELS = 160  # across: the most that fits the kernel's rings
TILE_ROWS = 128  # the rows around a tile are blurred once more for it: 20 per tile


def psnr(image: Shaped[np.ndarray, "..."], reference: Shaped[np.ndarray, "..."]) -> float:
    """Peak signal-to-noise ratio, in decibels: -10 log10 of the mean squared difference; infinite for equal images.

    Raises:
        InvalidViewsError: the arrays are not two images of the same size.
    """
    a, b = image_pair(image, reference)
    with np.errstate(invalid="ignore"):  # the difference of infinities is NaN, which the result then says
        error = float(np.mean(np.square(a.astype(np.float64) - b)))
    return math.inf if error == 0 else -10 * math.log10(error)


def ssim(image: Shaped[np.ndarray, "..."], reference: Shaped[np.ndarray, "..."]) -> float:
    """Structural similarity, from -1 to 1; exactly 1 for equal images.

    The mean over all pixels and channels, as in 3DGS: a Gaussian window of 11x11 pixels and standard deviation 1.5,
    the image continued with zeros (so images of any size will do), C1 = 0.01², C2 = 0.03². Values beyond ±1e9 count as
    that. Wang et al., "Image Quality Assessment: From Error Visibility to Structural Similarity", IEEE Transactions
    on Image Processing 13 (2004).

    Raises:
        InvalidViewsError: the arrays are not two images of the same size.
    """
    a, b = image_pair(image, reference)
    with Workers(1) as pool:
        sums = difference_and_ssim(a[None], b[None], pool)
    return float(sums[1]) / a.size


def image_pair(
    image: Shaped[np.ndarray, "..."], reference: Shaped[np.ndarray, "..."]
) -> tuple[Float32[np.ndarray, "H W 3"], Float32[np.ndarray, "H W 3"]]:
    """Both as contiguous float32, uint8 divided by 255.

    Raises:
        InvalidViewsError: the arrays are not two images of the same size.
    """
    if image.shape != reference.shape or image.ndim != 3 or image.shape[2] != 3 or image.size == 0:
        raise InvalidViewsError(
            f"images to compare must both be (height, width, 3), not {image.shape} and {reference.shape}"
        )
    return _as_floats(image), _as_floats(reference)


def _as_floats(image: np.ndarray) -> np.ndarray:
    if image.dtype == np.uint8:
        return image.astype(np.float32, order="C") / np.float32(255)
    if not np.issubdtype(image.dtype, np.floating):
        raise InvalidViewsError(f"images to compare must be uint8 or floats in [0, 1], not {image.dtype}")
    with np.errstate(over="ignore"):  # float64 beyond float32 is infinite
        return np.ascontiguousarray(image, dtype=np.float32)


def difference_and_ssim(
    images: Float32[np.ndarray, "V H W 3"],
    targets: Float32[np.ndarray, "V H W 3"],
    pool: Workers,
    gradient: Float32[np.ndarray, "V H W 3"] | None = None,
    weights: tuple[float, float] = (0.0, 0.0),
) -> Float64[np.ndarray, "2"]:
    """Sums over all pixels and channels, and their gradient in the same pass: what a loss needs.

    Args:
        images: any values; contiguous, like all of these.
        targets: what they are compared with.
        pool: where the tiles are worked on; no bit of the result depends on its size.
        gradient: written, if given: that of the sums below, weighted, by ``images``.
        weights: of the two sums in the gradient.

    Returns:
        Σ |image - target| and Σ SSIM.
    """
    from kissgs.rendering import ssim_kernels

    count, height, width, _ = images.shape
    tiles = [(view, tile) for view in range(count) for tile in _tiles(height, width)]
    slopes = np.empty((count, 0, 0), dtype=np.float32) if gradient is None else gradient.reshape(count, height, -1)
    l1, ssim = np.float32(weights[0]), np.float32(2 * weights[1])
    rows = images.reshape(count, height, -1), targets.reshape(count, height, -1)

    def work(task: tuple[int, np.ndarray]) -> np.ndarray:
        view, tile = task
        sums = np.zeros(2)
        ssim_kernels.ssim_tile(rows[0][view], rows[1][view], tile, l1, ssim, slopes[view], sums)
        return sums

    return np.sum(pool.map(work, tiles), axis=0)


def _tiles(height: int, width: int) -> list[np.ndarray]:
    """First row and the one after the last, first column and the one after the last, in channels, of every tile."""
    downs = np.linspace(0, height, -(-height // TILE_ROWS) + 1).astype(np.int64)
    rights = np.linspace(0, width, -(-width // TILE_PIXELS) + 1).astype(np.int64) * 3
    return [
        np.array([top, bottom, left, right])
        for top, bottom in itertools.pairwise(downs)
        for left, right in itertools.pairwise(rights)
    ]
