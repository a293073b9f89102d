"""Reader of photographs as 8-bit RGB arrays.

EXIF orientation is ignored, as by COLMAP and 3DGS trainers: cameras refer to the pixels as stored.
"""

from __future__ import annotations

import contextlib
import struct
import zlib
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

import numpy as np
from PIL import BmpImagePlugin, Image, JpegImagePlugin, PngImagePlugin, TiffImagePlugin, WebPImagePlugin
from PIL.ExifTags import Base

from kissgs.core.array_types import Float32, UInt8
from kissgs.core.errors import InvalidViewsError, UnsupportedError

FORMATS = tuple(
    plugin.format
    for plugin in (
        JpegImagePlugin.JpegImageFile,
        PngImagePlugin.PngImageFile,
        WebPImagePlugin.WebPImageFile,
        TiffImagePlugin.TiffImageFile,
        BmpImagePlugin.BmpImageFile,
    )
)
"""Formats that are read; Pillow's rarely used readers are kept away from untrusted files."""

EXTENSIONS = frozenset({".jpg", ".jpeg", ".png", ".webp", ".tif", ".tiff", ".bmp"})
"""Extensions of photographs, in lower case; any other suffix is part of the name."""

MAX_PIXELS = 1 << 28
"""Maximum number of pixels, 268 million: phones have up to 200 million. Decoded, they take 1.1 GB; a transparent image,
which is composited, twice that."""

DRAFT_PIXELS = 89_478_485
"""A JPEG with more pixels is decoded at a half, a quarter or an eighth of its size where the requested one is smaller;
others are decoded whole. Pillow warns above this number."""

BAND_PIXELS = 1 << 22
"""Number of pixels that are converted to RGB at a time where that needs numbers larger than a byte."""

QUARTER_TURNS = (5, 6, 7, 8)
"""Values of EXIF's orientation that exchange width and height."""

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
    """Read the header of a photograph, without its pixels.

    Raises:
        InvalidViewsError: the file cannot be read, has another format, or has more than :data:`MAX_PIXELS`.
    """
    with _opened(path) as image:
        return PhotoHeader(image.width, image.height, _is_transparent(image))


def orientation(path: Path) -> int:
    """Return the photograph's EXIF orientation, which is ignored, 1 to 8; 1 is upright.

    Raises:
        InvalidViewsError: as for :func:`read_photo_header`; a PNG file is read whole.
    """
    with _opened(path) as image:
        found = image.getexif().get(Base.Orientation)
        return found if isinstance(found, int) and 1 <= found <= 8 else 1


def read_photo(
    path: Path, width: int, height: int, background: Float32[np.ndarray, "3"]
) -> UInt8[np.ndarray, "height width 3"]:
    """Read a photograph, resize it bicubically to this size, and composite it over ``background`` (RGB, 0 to 1).

    Returns:
        uint8 array ``(height, width, 3)``.

    Raises:
        InvalidViewsError: the file cannot be read, has another format, is damaged or truncated, or has too many pixels.
        UnsupportedError: it has 32 bits per channel.
    """
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
