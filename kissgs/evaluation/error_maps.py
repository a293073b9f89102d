"""Error maps: differences of two images per pixel, as colours, and the crop with the largest error."""

from __future__ import annotations

import math

import numpy as np

from kissgs.core.array_types import Float32, Float64, UInt8

INFERNO = (
    (0, 0, 4),
    (27, 12, 65),
    (74, 12, 107),
    (120, 28, 109),
    (165, 44, 96),
    (207, 68, 70),
    (237, 105, 37),
    (251, 155, 6),
    (247, 209, 61),
    (252, 255, 164),
)
"""Matplotlib's colour map "inferno" at ten points, RGB from 0 to 255: its lightness grows evenly."""

FULL_SCALES = (1, 2, 3, 5, 10, 15, 20, 30, 50, 100, 255)
"""Errors that the brightest colour may stand for, levels of an 8-bit image."""

WINDOW = 32
"""Side of the square over which the largest error is searched, pixels."""


def rms_difference(
    image: Float32[np.ndarray, "H W 3"], other: Float32[np.ndarray, "H W 3"]
) -> Float32[np.ndarray, "H W"]:
    """Return the root mean square error over RGB of each pixel, in levels of an 8-bit image, 0 to 255.

    The images are float32 from 0 to 1.
    """
    squares = np.square(image - other).mean(axis=2)
    return np.asarray(255 * np.sqrt(squares), np.float32)


def full_scale(psnr: float) -> int:
    """Return the error, in levels, of the brightest colour for an image with this PSNR in decibels.

    It is the next of :data:`FULL_SCALES` above four times the root mean square error, which itself would leave most of
    the image bright; with the largest error, most would be black.
    """
    wanted = 4 * 255 * 10 ** (-psnr / 20) if math.isfinite(psnr) else 0.0
    return next((scale for scale in FULL_SCALES if scale >= wanted), FULL_SCALES[-1])


def heat_map(levels: Float32[np.ndarray, "H W"], full: float) -> UInt8[np.ndarray, "H W 3"]:
    """Return ``levels`` as RGB colours, black for 0 to pale yellow for ``full`` and above; NaN counts as ``full``."""
    steps = np.linspace(0, 255, len(INFERNO))
    table = np.stack([np.interp(np.arange(256), steps, channel) for channel in zip(*INFERNO, strict=True)], axis=1)
    share = np.nan_to_num(levels / full, nan=1.0).clip(0, 1)
    return np.rint(table).astype(np.uint8)[np.rint(share * 255).astype(np.uint8)]


def worst_crop(levels: Float32[np.ndarray, "H W"], side: int) -> tuple[slice, slice]:
    """Return rows and columns of a square of ``side`` pixels around the largest error, clipped to the image.

    The largest error is the window of :data:`WINDOW` pixels with the largest mean square; without any error, the
    middle.

    Args:
        levels: error of each pixel; NaN counts as 255.
        side: side of the crop, pixels.
    """
    height, width = levels.shape
    down, across = min(WINDOW, height), min(WINDOW, width)
    sums = _sums(np.square(np.nan_to_num(levels.astype(np.float64), nan=255.0)), down, across)
    top, left = np.unravel_index(sums.argmax(), sums.shape)
    if sums[top, left] <= 0:
        top, left = (height - down) // 2, (width - across) // 2
    return _interval(int(top) + down // 2, side, height), _interval(int(left) + across // 2, side, width)


def _sums(values: Float64[np.ndarray, "H W"], down: int, across: int) -> Float64[np.ndarray, "h w"]:
    """Return the sums over every rectangle of ``down`` rows and ``across`` columns."""
    corners = np.pad(values, ((1, 0), (1, 0))).cumsum(axis=0).cumsum(axis=1)
    strips = corners[down:] - corners[:-down]
    return np.asarray(strips[:, across:] - strips[:, :-across])


def _interval(middle: int, side: int, length: int) -> slice:
    start = max(0, min(middle - side // 2, length - side))
    return slice(start, min(start + side, length))
