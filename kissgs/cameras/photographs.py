"""Photographs as 8-bit RGB arrays, also as a pinhole camera would have taken them."""

from __future__ import annotations

import contextlib
import struct
import zlib
from collections.abc import Iterator
from dataclasses import astuple, dataclass
from functools import lru_cache
from pathlib import Path
from typing import BinaryIO

import numpy as np
from PIL import BmpImagePlugin, Image, JpegImagePlugin, PngImagePlugin, TiffImagePlugin, WebPImagePlugin
from PIL.ExifTags import Base

from kissgs.core.array_types import Bool, Float32, Float64, UInt8
from kissgs.core.errors import InvalidViewsError, UnsupportedError

# EXIF orientation is ignored, as by COLMAP and 3DGS trainers: cameras refer to the pixels as stored.

_PLUGINS = (
    *(JpegImagePlugin.JpegImageFile, PngImagePlugin.PngImageFile, WebPImagePlugin.WebPImageFile),
    *(TiffImagePlugin.TiffImageFile, BmpImagePlugin.BmpImageFile),
)
FORMATS = tuple(plugin.format for plugin in _PLUGINS)  # Pillow's other readers get no untrusted files

MAX_PIXELS = 1 << 28
"""Maximum number of pixels, 268 million: phones have up to 200 million. Decoded, they take 1.1 GB; a transparent image,
which is composited, twice that."""

DRAFT_PIXELS = 89_478_485
"""A JPEG with more pixels is decoded at a half, a quarter or an eighth of its size where the requested one is smaller;
others are decoded whole. Pillow warns above this number."""

BAND_PIXELS = 1 << 22  # converted to RGB at a time where that needs numbers larger than a byte
QUARTER_TURNS = (5, 6, 7, 8)  # values of EXIF's orientation that exchange width and height

_ALPHA_MODES = frozenset({"RGBA", "LA", "PA", "RGBa", "La"})

# Exceptions that Pillow raises for damaged files, depending on the format and the damage.
_DAMAGED = (
    OSError,
    SyntaxError,
    ValueError,
    TypeError,
    LookupError,
    EOFError,
    ArithmeticError,
    struct.error,
    zlib.error,
)


@dataclass(frozen=True, slots=True)
class PhotoHeader:
    """Header of a photograph: width and height in pixels as stored, and whether pixels can be transparent."""

    width: int
    height: int
    transparent: bool


def read_photo_header(path: Path) -> PhotoHeader:
    """Read the header of a photograph, without its pixels."""
    with _opened(path) as image:
        return PhotoHeader(image.width, image.height, _is_transparent(image))


def orientation(path: Path) -> int:
    """Return the photograph's EXIF orientation, which is ignored, 1 to 8; 1 is upright."""
    with _opened(path) as image:
        found = image.getexif().get(Base.Orientation)
        return found if isinstance(found, int) and 1 <= found <= 8 else 1


def read_photo(
    path: Path, width: int, height: int, background: Float32[np.ndarray, "3"]
) -> UInt8[np.ndarray, "height width 3"]:
    """Read a photograph, resize it bicubically to this size, and composite it over ``background`` (RGB, 0 to 1)."""
    with _opened(path) as image:
        if image.mode in ("I", "F"):
            raise UnsupportedError(f"{path} has 32 bits per channel, which is not supported; save it with 8 or 16")
        box = None
        if image.width * image.height > DRAFT_PIXELS and (draft := image.draft(None, (width, height))) is not None:
            box = draft[1]  # of the whole photograph: the last pixels of a draft may reach beyond it
        rgb = _to_rgb(image, background)
        if rgb.size != (width, height):
            rgb = rgb.resize((width, height), Image.Resampling.BICUBIC, box)
        return np.array(rgb, dtype=np.uint8)


@contextlib.contextmanager
def _opened(path: Path) -> Iterator[Image.Image]:
    try:
        if not path.is_file():  # opening a named pipe would wait for its writer
            raise InvalidViewsError(f"cannot read {path}: there is no such file")
        with path.open("rb") as file, _image_of(file) as image:
            if image.width * image.height > MAX_PIXELS:
                raise InvalidViewsError(
                    f"{path} has {image.width}x{image.height} pixels; at most {MAX_PIXELS // 10**6} megapixels are "
                    "read; reduce it"
                )
            yield image
    except Image.DecompressionBombError as error:  # Pillow's own limit for WebP
        raise InvalidViewsError(f"{path} has too many pixels for a photograph of its format; reduce it") from error
    except MemoryError as error:
        raise InvalidViewsError(f"{path} does not fit into memory; reduce it") from error
    except _DAMAGED as error:
        if isinstance(error, OSError) and error.errno is not None:
            raise InvalidViewsError(f"cannot read {path}: {(error.strerror or str(error)).lower()}") from error
        raise InvalidViewsError(
            f"{path} is damaged, truncated, or not a JPEG, PNG, WebP, TIFF or BMP file; copy or export it again"
        ) from error


def _image_of(file: BinaryIO) -> Image.Image:
    """Open an image as ``Image.open`` does, whose limit is too low for phones and warns on standard error."""
    prefix = file.read(16)
    for name in FORMATS:
        factory, accept = Image.OPEN[name]
        if accept is not None and accept(prefix) is True:
            file.seek(0)
            return factory(file, "")
    raise SyntaxError("of no format that is read")


def _is_transparent(image: Image.Image) -> bool:
    return image.mode in _ALPHA_MODES or "transparency" in image.info


def _to_rgb(image: Image.Image, background: Float32[np.ndarray, "3"]) -> Image.Image:
    if image.mode == "RGB" and not _is_transparent(image):
        return image
    if not (image.mode.startswith("I;16") or _is_transparent(image)):
        return image.convert("RGB")
    rgb, rows = Image.new("RGB", image.size), max(1, BAND_PIXELS // image.width)
    for top in range(0, image.height, rows):
        band = image.crop((0, top, image.width, min(top + rows, image.height)))
        rgb.paste(Image.fromarray(_band_to_rgb(band, background)), (0, top))
    return rgb


def _band_to_rgb(band: Image.Image, background: Float32[np.ndarray, "3"]) -> UInt8[np.ndarray, "h w 3"]:
    if band.mode.startswith("I;16"):  # Pillow would clip at 255
        grey = np.asarray(band).astype(np.uint32)
        return np.repeat(((grey + 128) // 257).astype(np.uint8)[:, :, None], 3, axis=2)
    pixels = np.asarray(band.convert("RGBA"))
    opacity = pixels[:, :, 3:] * np.float32(1 / 255)
    mixed = pixels[:, :, :3] * opacity + background * np.float32(255) * (1 - opacity)
    return np.asarray((mixed + np.float32(0.5)).astype(np.uint8))


# Undistortion: conversion of photographs of a distorting lens to those of a pinhole camera.
#
# The distortion model is Brown's with OpenCV's coefficients, which COLMAP's SIMPLE_RADIAL, RADIAL, OPENCV and
# FULL_OPENCV and nerfstudio share. Fisheye lenses have other models, which the readers of camera files reject.

MIN_AREA = 0.1  # minimum share of the photograph's area that must remain; real lenses keep more than half
_BLOCK_PIXELS = 1 << 14  # undistorted at a time: temporaries of about 2 MB stay in the processor's cache
_GRID = 33  # points per side at which the interior of a window is checked; its border is checked at every pixel


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

    lens: Lens
    left: int
    top: int
    width: int
    height: int

    @property
    def K(self) -> Float64[np.ndarray, "3 3"]:
        """``(3, 3)`` pinhole intrinsics of the cropped image: only the principal point moves."""
        return self.lens.K - [[0, 0, self.left], [0, 0, self.top], [0, 0, 0]]


@lru_cache(maxsize=256)  # most captures have hundreds of photographs of one lens
def full_window(lens: Lens) -> Window:
    """Return the largest window that the photograph covers completely: it is shrunk towards the principal point."""
    if not (0 < lens.cx < lens.width and 0 < lens.cy < lens.height):
        raise InvalidViewsError(
            f"the principal point ({lens.cx:.6g}, {lens.cy:.6g}) of a distorting lens is outside its "
            f"{lens.width}x{lens.height} photograph; calibrate again"
        )
    low, high = 0.0, 1.0
    if _is_covered(_shrunk(lens, 1.0)):
        return _shrunk(lens, 1.0)
    while high - low > 1e-5:  # windows are nested: if one is covered, all smaller ones are
        middle = (low + high) / 2
        low, high = (middle, high) if _is_covered(_shrunk(lens, middle)) else (low, middle)
    window = _shrunk(lens, low)
    if window.width * window.height < MIN_AREA * lens.width * lens.height:
        raise InvalidViewsError(
            "the lens distortion leaves less than a tenth of the photograph; calibrate again, or undistort with "
            "'colmap image_undistorter'"
        )
    return window


def undistort(
    photo: UInt8[np.ndarray, "H W 3"], window: Window, stride: int = 1, first: tuple[int, int] = (0, 0)
) -> UInt8[np.ndarray, "h w 3"]:
    """Return every ``stride``-th pixel of every ``stride``-th row of the image that a pinhole would take of ``window``.
    Each pixel's ray is projected through the lens, and the photograph is sampled there, bicubically (Catmull-Rom)."""
    lens = window.lens
    planes = np.ascontiguousarray(photo.transpose(2, 0, 1))  # NumPy gathers single bytes faster than triples
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
    return Window(lens, int(left), int(top), max(0, int(right - left)), max(0, int(bottom - top)))


def _is_covered(window: Window) -> bool:
    """Whether the rays of all pixels hit the photograph, in the range in which the distortion is invertible."""
    if window.width == 0 or window.height == 0:
        return True
    lens, first_x, first_y = window.lens, window.left + 0.5, window.top + 0.5
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
    """Sample a photograph bicubically; (0, 0) is the centre of the first pixel, and border pixels are repeated."""
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
