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

import numpy as np
from PIL import Image

from kissgs.core.array_types import Float32, UInt8
from kissgs.core.errors import InvalidViewsError, UnsupportedError

FORMATS = ("JPEG", "PNG", "WEBP", "TIFF", "BMP")
"""Formats that are read; Pillow's rarely used readers are kept away from untrusted files."""

EXTENSIONS = frozenset({".jpg", ".jpeg", ".png", ".webp", ".tif", ".tiff", ".bmp"})
"""Extensions of photographs, in lower case; any other suffix is part of the name."""

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
        InvalidViewsError: the file cannot be read, has another format, or has too many pixels for Pillow's limit
            against decompression bombs (about 90 megapixels).
    """
    with _opened(path) as image:
        return PhotoHeader(image.width, image.height, _is_transparent(image))


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
        rgb = _to_rgb(image, background)
        if rgb.size != (width, height):
            rgb = rgb.resize((width, height), Image.Resampling.BICUBIC)
        return np.array(rgb, dtype=np.uint8)


@contextlib.contextmanager
def _opened(path: Path) -> Iterator[Image.Image]:
    try:
        if not path.is_file():  # opening a named pipe would wait for its writer
            raise InvalidViewsError(f"cannot read {path}: there is no such file")
        with Image.open(path, formats=FORMATS) as image:
            yield image
    except (Image.DecompressionBombError, Image.DecompressionBombWarning) as error:
        raise InvalidViewsError(f"{path} has more pixels than can be read safely; reduce it") from error
    except MemoryError as error:
        raise InvalidViewsError(f"{path} does not fit into memory; reduce it") from error
    except _DAMAGED as error:
        if isinstance(error, OSError) and error.errno is not None:
            raise InvalidViewsError(f"cannot read {path}: {(error.strerror or str(error)).lower()}") from error
        raise InvalidViewsError(
            f"{path} is damaged, truncated, or not a JPEG, PNG, WebP, TIFF or BMP file; copy or export it again"
        ) from error


def _is_transparent(image: Image.Image) -> bool:
    return image.mode in _ALPHA_MODES or "transparency" in image.info


def _to_rgb(image: Image.Image, background: Float32[np.ndarray, "3"]) -> Image.Image:
    if image.mode.startswith("I;16"):  # Pillow would clip at 255
        grey = np.asarray(image).astype(np.uint32)
        return Image.fromarray(((grey + 128) // 257).astype(np.uint8)).convert("RGB")
    if not _is_transparent(image):
        return image.convert("RGB")
    pixels = np.asarray(image.convert("RGBA"))
    opacity = pixels[:, :, 3:] * np.float32(1 / 255)
    mixed = pixels[:, :, :3] * opacity + background * np.float32(255) * (1 - opacity)
    return Image.fromarray((mixed + np.float32(0.5)).astype(np.uint8))
