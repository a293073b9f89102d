"""Where two pictures differ: how much at each pixel, in colours, and the place where it is worst."""

from __future__ import annotations

import math

import numpy as np

from kissgs.core.array_types import Float32, Float64, UInt8

STOPS = (
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
"""Matplotlib's "inferno", thinned: lightness grows evenly, so that it can be read without its colours."""

SCALES = (1, 2, 3, 5, 10, 15, 20, 30, 50, 100, 255)
"""What full colour may stand for, levels of an 8-bit picture."""

WINDOW = 32
"""Pixels: the side of what counts as one place."""


def difference(image: Float32[np.ndarray, "H W 3"], other: Float32[np.ndarray, "H W 3"]) -> Float32[np.ndarray, "H W"]:
    """Root mean square over red, green and blue at each pixel, in levels of an 8-bit picture: 0 to 255."""
    squares = np.square(image - other).mean(axis=2)
    return np.asarray(255 * np.sqrt(squares), np.float32)


def full_scale(psnr: float) -> int:
    """Levels that full colour stands for where a picture has this PSNR: some four times its mean error, a round number.

    The mean error itself would leave most of a picture bright; its largest one, most of it black.
    """
    wanted = 4 * 255 * 10 ** (-psnr / 20) if math.isfinite(psnr) else 0.0
    return next((scale for scale in SCALES if scale >= wanted), SCALES[-1])


def heat_map(levels: Float32[np.ndarray, "H W"], full: float) -> UInt8[np.ndarray, "H W 3"]:
    """``levels`` in colours, from black for 0 to pale yellow for ``full`` and above; NaN counts as ``full``."""
    steps = np.linspace(0, 255, len(STOPS))
    table = np.stack([np.interp(np.arange(256), steps, channel) for channel in zip(*STOPS, strict=True)], axis=1)
    share = np.nan_to_num(levels / full, nan=1.0).clip(0, 1)
    return np.rint(table).astype(np.uint8)[np.rint(share * 255).astype(np.uint8)]


def worst_place(levels: Float32[np.ndarray, "H W"], side: int) -> tuple[slice, slice]:
    """Rows and columns of the square of ``side`` pixels around the place that differs most; less if the picture is.

    A place is a square of :data:`WINDOW` pixels, and how much it differs the mean square over it. Where nothing
    differs at all, it is the middle.
    """
    height, width = levels.shape
    down, across = min(WINDOW, height), min(WINDOW, width)
    sums = _sums(np.square(np.nan_to_num(levels.astype(np.float64), nan=255.0)), down, across)
    top, left = np.unravel_index(sums.argmax(), sums.shape)
    if sums[top, left] <= 0:
        top, left = (height - down) // 2, (width - across) // 2
    return _around(int(top) + down // 2, side, height), _around(int(left) + across // 2, side, width)


def _sums(values: Float64[np.ndarray, "H W"], down: int, across: int) -> Float64[np.ndarray, "h w"]:
    """Over every rectangle of ``down`` rows and ``across`` columns."""
    corners = np.pad(values, ((1, 0), (1, 0))).cumsum(axis=0).cumsum(axis=1)
    strips = corners[down:] - corners[:-down]
    return np.asarray(strips[:, across:] - strips[:, :-across])


def _around(middle: int, side: int, length: int) -> slice:
    start = max(0, min(middle - side // 2, length - side))
    return slice(start, min(start + side, length))
