"""Image metrics as in the 3DGS literature: PSNR, SSIM, MS-SSIM; LPIPS and FLIP by their packages."""

from __future__ import annotations

import http.client
import importlib
import itertools
import math

import numpy as np

from kissgs.core.array_types import Float32, Float64, Int, Shaped
from kissgs.core.context import Workers
from kissgs.core.errors import InvalidViewsError, UnsupportedError

# Images are floats in [0, 1] or uint8. Values outside [0, 1] are not clamped here; clamp renderings first. A NaN in
# either image makes the result NaN, so that no average hides a failed rendering.

WINDOW = 11  # side of the Gaussian window of SSIM and MS-SSIM, pixels
SCALE_WEIGHTS = 0.0448, 0.2856, 0.3001, 0.2363, 0.1333  # exponents of MS-SSIM's scales, as published
PATCH = 32  # side of the patches over which ssim_with_patches averages, pixels
TILE_PIXELS = 160  # width of a tile, pixels: the largest that the ring buffers of the kernel hold
TILE_ROWS = 128  # height of a tile, pixels; 20 rows around each tile are blurred again for it


def psnr(image: Shaped[np.ndarray, "..."], reference: Shaped[np.ndarray, "..."]) -> float:
    """Return the peak signal-to-noise ratio, -10 log10 of the mean squared difference, decibels; ∞ for equal images."""
    a, b = image_pair(image, reference)
    with np.errstate(invalid="ignore"):  # the difference of infinities is NaN, and so is the result
        error = float(np.mean(np.square(a.astype(np.float64) - b)))
    return math.inf if error == 0 else -10 * math.log10(error)


def ssim(image: Shaped[np.ndarray, "..."], reference: Shaped[np.ndarray, "..."]) -> float:
    """Return the structural similarity, from -1 to 1; exactly 1 for equal images. The mean over all pixels and
    channels, as in 3DGS: a Gaussian window of 11x11 pixels and standard deviation 1.5, padding with zeros, C1 = 0.01²,
    C2 = 0.03². Wang et al., "Image Quality Assessment: From Error Visibility to Structural Similarity", IEEE
    Transactions on Image Processing 13 (2004)."""
    return ssim_with_patches(image, reference)[0]


def ssim_with_patches(
    image: Shaped[np.ndarray, "..."], reference: Shaped[np.ndarray, "..."]
) -> tuple[float, Float64[np.ndarray, "h w"]]:
    """Return :func:`ssim`, and its mean over each patch between the :func:`patch_edges` of rows and of columns."""
    a, b = image_pair(image, reference)
    heights, widths = (np.diff(patch_edges(length)) for length in a.shape[:2])
    sums = _similarity_sums(a, b, (len(heights), len(widths)))[:, :, 0].sum(axis=2)
    return float(sums.sum()) / a.size, sums / (3 * np.outer(heights, widths))


def patch_edges(length: int) -> Int[np.ndarray, " n"]:
    """Return where patches begin along a side of this many pixels, and its end: every :data:`PATCH` pixels. A remainder
    of at least half a patch is one of its own; a smaller one belongs to the patch before it, if any."""
    edges = PATCH * np.arange(max(1, (length + PATCH // 2) // PATCH) + 1)
    edges[-1] = length
    return edges


def ms_ssim(image: Shaped[np.ndarray, "..."], reference: Shaped[np.ndarray, "..."]) -> float:
    """Return the multi-scale structural similarity, from 0 to 1; exactly 1 for equal images.

    The product over five scales, each of half the resolution of the one before (means of 2x2 pixels; an odd last row or
    column is dropped), of means raised to :data:`SCALE_WEIGHTS`: of SSIM at the last scale, of its factor that compares
    contrast and structure at the others. Negative means count as 0. It is computed for each channel and averaged. Wang,
    Simoncelli and Bovik, "Multiscale Structural Similarity for Image Quality Assessment", Asilomar Conference on
    Signals, Systems and Computers 2003.

    The window and constants are those of :func:`ssim`. As in the publication only windows inside the image count, since
    at the coarsest scale zeros beyond the border would reach a large share of the windows. A shorter side below 176
    pixels has less than :data:`WINDOW` pixels at the last scale: only the scales that hold a window are used, and their
    exponents are divided by their sum. Below 11 pixels, the result is :func:`ssim`, at least 0.
    """
    a, b = (np.clip(pixels, -1e9, 1e9) for pixels in image_pair(image, reference))
    scales = min((min(a.shape[:2]) // WINDOW).bit_length(), len(SCALE_WEIGHTS))
    if scales == 0:
        return float(np.maximum(ssim(a, b), 0))
    exponents = np.array(SCALE_WEIGHTS[:scales])
    if scales < len(SCALE_WEIGHTS):
        exponents /= exponents.sum()
    product = np.ones(3)
    for scale, exponent in enumerate(exponents):
        sums = _similarity_sums(a, b, (1, 1), WINDOW // 2)[0, 0]  # over all windows inside the images
        similarity, structure = sums / ((a.shape[0] - WINDOW + 1) * (a.shape[1] - WINDOW + 1))
        product *= np.maximum(similarity if scale == scales - 1 else structure, 0) ** exponent
        a, b = _halved(a), _halved(b)
    return float(product.mean())


def _similarity_sums(
    a: Float32[np.ndarray, "H W 3"], b: Float32[np.ndarray, "H W 3"], patches: tuple[int, int], inset: int = 0
) -> Float64[np.ndarray, "h w 2 3"]:
    """Return sums of SSIM and of its second factor for each patch and channel; a border of ``inset`` is left out."""
    from kissgs.rendering import ssim_kernels

    sums = np.zeros((*patches, 2, 3))
    rows = a.reshape(len(a), -1), b.reshape(len(b), -1)
    for tile in _tiles(a.shape[0] - 2 * inset, a.shape[1] - 2 * inset):
        ssim_kernels.similarity_tile(*rows, tile + np.repeat([inset, 3 * inset], 2), sums)
    return sums


def _halved(image: Float32[np.ndarray, "H W 3"]) -> Float32[np.ndarray, "h w 3"]:
    """Return the means of 2x2 pixels, without an odd last row or column."""
    height, width = len(image) // 2 * 2, image.shape[1] // 2 * 2
    rows = image[0:height:2, :width] + image[1:height:2, :width]  # faster than one mean over two axes
    return (rows[:, ::2] + rows[:, 1::2]) * np.float32(0.25)


def image_pair(
    image: Shaped[np.ndarray, "..."], reference: Shaped[np.ndarray, "..."]
) -> tuple[Float32[np.ndarray, "H W 3"], Float32[np.ndarray, "H W 3"]]:
    """Return both images as contiguous float32, uint8 divided by 255."""
    if image.shape != reference.shape or image.ndim != 3 or image.shape[2] != 3 or image.size == 0:
        raise InvalidViewsError(
            f"images to compare must have one shape, (height, width, 3), not {image.shape} and {reference.shape}"
        )
    return _as_floats(image), _as_floats(reference)


def _as_floats(image: np.ndarray) -> np.ndarray:
    if image.dtype == np.uint8:
        return image.astype(np.float32, order="C") / np.float32(255)
    if not np.issubdtype(image.dtype, np.floating):
        raise InvalidViewsError(f"images to compare must be uint8 or floats in [0, 1], not {image.dtype}")
    with np.errstate(over="ignore"):  # float64 beyond float32 is infinite
        return np.ascontiguousarray(image, dtype=np.float32)


def differences_and_ssim(
    images: Float32[np.ndarray, "V H W 3"],
    targets: Float32[np.ndarray, "V H W 3"],
    pool: Workers,
    gradient: Float32[np.ndarray, "V H W 3"] | None = None,
    weights: tuple[float, float, float] = (0.0, 0.0, 0.0),
) -> Float64[np.ndarray, "3"]:
    """Return sums over all pixels and channels, and compute the gradient of their weighted sum in the same pass. With d
    = image - target, the sums are Σ |d|, Σ d² (for |d| above 1, 2 |d| - 1 in its place) and Σ SSIM."""
    from kissgs.rendering import ssim_kernels

    count, height, width, _ = images.shape
    tiles = [(view, tile) for view in range(count) for tile in _tiles(height, width)]
    gradients = np.empty((count, 0, 0), dtype=np.float32) if gradient is None else gradient.reshape(count, height, -1)
    l1, l2, ssim = np.float32(weights[0]), np.float32(2 * weights[1]), np.float32(2 * weights[2])
    rows = images.reshape(count, height, -1), targets.reshape(count, height, -1)

    def work(task: tuple[int, np.ndarray]) -> np.ndarray:
        view, tile = task
        sums = np.zeros(3)
        ssim_kernels.ssim_tile(rows[0][view], rows[1][view], tile, l1, l2, ssim, gradients[view], sums)
        return sums

    return np.sum(pool.map(work, tiles), axis=0)


def _tiles(height: int, width: int) -> list[np.ndarray]:
    """Return top, bottom, left and right of each tile, ends exclusive; columns count channels, three per pixel."""
    row_edges = np.linspace(0, height, -(-height // TILE_ROWS) + 1).astype(np.int64)
    column_edges = np.linspace(0, width, -(-width // TILE_PIXELS) + 1).astype(np.int64) * 3
    return [
        np.array([top, bottom, left, right])
        for top, bottom in itertools.pairwise(row_edges)
        for left, right in itertools.pairwise(column_edges)
    ]


class Flip:
    """LDR-FLIP by the package ``flip-evaluator``: from 0 for equal images to 1. Construct it once and call it often. It
    estimates the difference that an observer sees who flips between two images on a display with 67 pixels per degree
    of visual angle. Andersson et al., "FLIP: A Difference Evaluator for Alternating Images", Proceedings of the ACM on
    Computer Graphics and Interactive Techniques 3 (2020)."""

    def __init__(self) -> None:
        """Load the package."""
        try:
            self._package = importlib.import_module("flip_evaluator")
        except ModuleNotFoundError as error:
            raise UnsupportedError("FLIP needs flip-evaluator, which is missing: pip install flip-evaluator") from error

    def __call__(self, image: Shaped[np.ndarray, "..."], reference: Shaped[np.ndarray, "..."]) -> float:
        """Return the mean over all pixels of two sRGB images, clamped to [0, 1]; NaN if either has a NaN."""
        first, second = (np.clip(pixels, 0, 1) for pixels in image_pair(image, reference))
        if np.isnan(first).any() or np.isnan(second).any():  # the package takes NaN for a value
            return float("nan")
        errors, *_ = self._package.evaluate(second, first, "LDR", applyMagma=False, computeMeanError=False)
        return float(errors.mean(dtype=np.float64))  # the package adds them up in float32


class Lpips:
    """LPIPS with VGG-16: from 0 for equal images up to about 1. Construct it once and call it often. This is the LPIPS
    of papers on Gaussian splatting: like the evaluation script of 3DGS, it passes images in [0, 1] to the network,
    which was calibrated on [-1, 1]. Zhang et al., "The Unreasonable Effectiveness of Deep Features as a Perceptual
    Metric", CVPR 2018."""

    def __init__(self, device: str = "cpu") -> None:
        """Load the network, whose weights (528 MB) torchvision downloads on first use."""
        try:
            package = importlib.import_module("torchmetrics.image.lpip")
            self._network = package.LearnedPerceptualImagePatchSimilarity(net_type="vgg").to(device)
        except ModuleNotFoundError as error:
            raise UnsupportedError(
                f"LPIPS needs torchmetrics and torchvision ({error}): pip install torchmetrics torchvision"
            ) from error
        except (OSError, RuntimeError, http.client.HTTPException) as error:
            raise UnsupportedError(
                f"LPIPS could not load its network, vgg16 ({error}): torchvision must be of torch's build; it "
                "downloads the weights on first use: construct kissgs.rendering.metrics.Lpips once while online, or "
                "copy the file into the folder checkpoints of torch.hub.get_dir()"
            ) from error
        self._device = device

    def __call__(self, image: Shaped[np.ndarray, "..."], reference: Shaped[np.ndarray, "..."]) -> float:
        """Return the distance of two images; NaN if either has a NaN."""
        import torch

        pair = image_pair(image, reference)
        height, width, _ = pair[0].shape
        if min(height, width) < 16:  # the network halves its input four times
            raise UnsupportedError(f"LPIPS needs images of at least 16x16 pixels, not {width}x{height}")
        if any(np.isnan(array).any() for array in pair):  # the package refuses NaN
            return float("nan")
        clamped = (torch.from_numpy(np.clip(array, 0, 1)) for array in pair)
        first, second = (array.to(self._device).permute(2, 0, 1)[None] for array in clamped)
        with torch.no_grad():
            return float(self._network(first, second).item())
