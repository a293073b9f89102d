"""Undistortion: conversion of photographs of a distorting lens to those of a pinhole camera.

The distortion model is Brown's with OpenCV's coefficients, which COLMAP's SIMPLE_RADIAL, RADIAL, OPENCV and FULL_OPENCV
and nerfstudio share. Fisheye lenses have other models, which the readers of camera files reject.
"""

from __future__ import annotations

from dataclasses import astuple, dataclass
from functools import lru_cache

import numpy as np

from kissgs.core.array_types import Bool, Float32, Float64, UInt8
from kissgs.core.errors import InvalidViewsError

MIN_AREA = 0.1
"""Minimum share of the photograph's area that must remain; real lenses keep more than half."""

_BLOCK_PIXELS = 1 << 14
"""Number of pixels undistorted at a time, so that temporaries of about 2 MB stay in the processor's cache."""

_GRID = 33
"""Points per side at which the interior of a window is checked; its border is checked at every pixel."""


@dataclass(frozen=True, slots=True)
class Distortion:
    """Distortion coefficients: radial k1 to k6 (k4 to k6 in the denominator) and tangential p1, p2."""

    k1: float = 0.0
    k2: float = 0.0
    p1: float = 0.0
    p2: float = 0.0
    k3: float = 0.0
    k4: float = 0.0
    k5: float = 0.0
    k6: float = 0.0

    def __bool__(self) -> bool:
        """Whether the lens distorts at all."""
        return any(astuple(self))

    def apply(
        self, x: Float64[np.ndarray, "*shape"], y: Float64[np.ndarray, "*shape"]
    ) -> tuple[Float64[np.ndarray, "*shape"], Float64[np.ndarray, "*shape"]]:
        """Return the distorted image point of the ray (x, y, 1), in units of the focal length."""
        r2 = x * x + y * y
        radial = 1 + r2 * (self.k1 + r2 * (self.k2 + r2 * self.k3))
        if self.k4 or self.k5 or self.k6:
            radial = radial / (1 + r2 * (self.k4 + r2 * (self.k5 + r2 * self.k6)))
        if not (self.p1 or self.p2):
            return x * radial, y * radial
        return (
            x * radial + 2 * self.p1 * x * y + self.p2 * (r2 + 2 * x * x),
            y * radial + 2 * self.p2 * x * y + self.p1 * (r2 + 2 * y * y),
        )


NO_DISTORTION = Distortion()


@dataclass(frozen=True, slots=True)
class Lens:
    """Intrinsics and distortion of a photograph of ``width`` x ``height`` pixels; all lengths in pixels."""

    fx: float
    fy: float
    cx: float
    cy: float
    width: int
    height: int
    distortion: Distortion = NO_DISTORTION

    @property
    def K(self) -> Float64[np.ndarray, "3 3"]:
        """``(3, 3)`` float64 intrinsics of the pinhole without distortion."""
        return np.array([[self.fx, 0.0, self.cx], [0.0, self.fy, self.cy], [0.0, 0.0, 1.0]])


@dataclass(frozen=True, slots=True)
class Window:
    """Part of the undistorted image that is kept, in pixels of the photograph; ``left``, ``top`` is its first pixel."""

    left: int
    top: int
    width: int
    height: int

    def K(self, lens: Lens) -> Float64[np.ndarray, "3 3"]:
        """Return the ``(3, 3)`` pinhole intrinsics of the cropped image: only the principal point moves."""
        return lens.K - [[0, 0, self.left], [0, 0, self.top], [0, 0, 0]]


@lru_cache(maxsize=256)  # most captures have hundreds of photographs of one lens
def full_window(lens: Lens) -> Window:
    """Return the largest window that the photograph covers completely, so that no border is black.

    The window is the photograph's rectangle shrunk towards the principal point, so its aspect ratio stays, and barrel
    distortion loses nothing.

    Raises:
        InvalidViewsError: the principal point is outside the photograph, or less than :data:`MIN_AREA` would remain.
    """
    if not (0 < lens.cx < lens.width and 0 < lens.cy < lens.height):
        raise InvalidViewsError(
            f"the principal point ({lens.cx:.6g}, {lens.cy:.6g}) of a distorting lens is outside its "
            f"{lens.width}x{lens.height} photograph; calibrate again"
        )
    low, high = 0.0, 1.0
    if _is_covered(lens, _shrunk(lens, 1.0)):
        return _shrunk(lens, 1.0)
    while high - low > 1e-5:  # windows are nested: if one is covered, all smaller ones are
        middle = (low + high) / 2
        low, high = (middle, high) if _is_covered(lens, _shrunk(lens, middle)) else (low, middle)
    window = _shrunk(lens, low)
    if window.width * window.height < MIN_AREA * lens.width * lens.height:
        raise InvalidViewsError(
            "the lens distortion leaves less than a tenth of the photograph; calibrate again, or undistort with "
            "'colmap image_undistorter'"
        )
    return window


def undistort(
    photo: UInt8[np.ndarray, "H W 3"], lens: Lens, window: Window, stride: int = 1, first: tuple[int, int] = (0, 0)
) -> UInt8[np.ndarray, "h w 3"]:
    """Return the image that a pinhole with the focal lengths and principal point of ``lens`` would take of ``window``.

    Each pixel's ray is projected through the lens, and the photograph is sampled there, bicubically (Catmull-Rom).
    Of that image, every ``stride``-th pixel of every ``stride``-th row is returned, from column and row ``first``.
    """
    planes = np.ascontiguousarray(photo.transpose(2, 0, 1))
    x = (window.left + np.arange(first[0], window.width, stride) + 0.5 - lens.cx) / lens.fx
    y = (window.top + np.arange(first[1], window.height, stride) + 0.5 - lens.cy) / lens.fy
    result = np.empty((len(y), len(x), 3), dtype=np.uint8)
    step = max(1, _BLOCK_PIXELS // len(x))
    for start in range(0, len(y), step):
        u, v = _project(lens, *np.meshgrid(x, y[start : start + step]))
        result[start : start + step] = _sample(planes, u - 0.5, v - 0.5)
    return result


def _shrunk(lens: Lens, share: float) -> Window:
    left, right = np.ceil(lens.cx - share * lens.cx), np.floor(lens.cx + share * (lens.width - lens.cx))
    top, bottom = np.ceil(lens.cy - share * lens.cy), np.floor(lens.cy + share * (lens.height - lens.cy))
    return Window(int(left), int(top), max(0, int(right - left)), max(0, int(bottom - top)))


def _is_covered(lens: Lens, window: Window) -> bool:
    """Whether the rays of all pixels hit the photograph, in the range in which the distortion is invertible."""
    if window.width == 0 or window.height == 0:
        return True
    first_x, first_y = window.left + 0.5, window.top + 0.5
    last_x, last_y = first_x + window.width - 1, first_y + window.height - 1
    xs, ys = np.arange(first_x, last_x + 1), np.arange(first_y, last_y + 1)
    inside = np.meshgrid(np.linspace(first_x, last_x, _GRID), np.linspace(first_y, last_y, _GRID))
    u = np.concatenate([xs, xs, np.full_like(ys, first_x), np.full_like(ys, last_x), inside[0].ravel()])
    v = np.concatenate([np.full_like(xs, first_y), np.full_like(xs, last_y), ys, ys, inside[1].ravel()])
    return bool(_is_imaged(lens, (u - lens.cx) / lens.fx, (v - lens.cy) / lens.fy).all())


def _is_imaged(lens: Lens, x: Float64[np.ndarray, " n"], y: Float64[np.ndarray, " n"]) -> Bool[np.ndarray, " n"]:
    h = 1e-5
    with np.errstate(all="ignore"):  # coefficients may be arbitrary; rays that overflow miss the photograph
        u, v = _project(lens, x, y)
        (ux1, vx1), (ux0, vx0) = lens.distortion.apply(x + h, y), lens.distortion.apply(x - h, y)
        (uy1, vy1), (uy0, vy0) = lens.distortion.apply(x, y + h), lens.distortion.apply(x, y - h)
        invertible = (ux1 - ux0) * (vy1 - vy0) - (uy1 - uy0) * (vx1 - vx0) > 0  # the mapping's Jacobian determinant
        return np.asarray(invertible & (u >= 0) & (u <= lens.width) & (v >= 0) & (v <= lens.height))


def _project(
    lens: Lens, x: Float64[np.ndarray, "*shape"], y: Float64[np.ndarray, "*shape"]
) -> tuple[Float64[np.ndarray, "*shape"], Float64[np.ndarray, "*shape"]]:
    u, v = lens.distortion.apply(x, y)
    return lens.fx * u + lens.cx, lens.fy * v + lens.cy


def _sample(
    planes: UInt8[np.ndarray, "3 H W"], u: Float64[np.ndarray, "h w"], v: Float64[np.ndarray, "h w"]
) -> UInt8[np.ndarray, "h w 3"]:
    """Sample a photograph bicubically; (0, 0) is the centre of the first pixel, and border pixels are repeated.

    The planes are separate, because numpy gathers single bytes several times faster than triples.
    """
    height, width = planes.shape[1:]
    flat = planes.reshape(3, height * width)
    column, row = np.floor(u).astype(np.int32), np.floor(v).astype(np.int32)
    across, down = _weights((u - column).astype(np.float32)), _weights((v - row).astype(np.float32))
    columns = [np.clip(column + i, 0, width - 1) for i in range(-1, 3)]
    total = np.zeros((3, *u.shape), dtype=np.float32)
    for j in range(4):
        start = np.clip(row + j - 1, 0, height - 1) * width
        for i in range(4):
            index, weight = start + columns[i], down[j] * across[i]
            for channel in range(3):
                total[channel] += flat[channel].take(index) * weight
    return np.clip(np.rint(total), 0, 255).astype(np.uint8).transpose(1, 2, 0)


def _weights(t: Float32[np.ndarray, "h w"]) -> list[Float32[np.ndarray, "h w"]]:
    """Return the Catmull-Rom weights of four pixels, for a position ``t`` (0 to 1) after the second."""
    half = np.float32(0.5)
    return [
        ((-half * t + 1) * t - half) * t,
        (3 * half * t - 5 * half) * t * t + 1,
        ((-3 * half * t + 2) * t + half) * t,
        (half * t - half) * t * t,
    ]
