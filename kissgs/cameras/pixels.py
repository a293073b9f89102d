"""Photographs as arrays of 8-bit red, green and blue.

EXIF orientation is ignored, as COLMAP and the trainers of the field do: cameras are those of the stored pixels.
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
"""Others are no photographs; Pillow's rarer readers are not let near unknown files."""

EXTENSIONS = frozenset({".jpg", ".jpeg", ".png", ".webp", ".tif", ".tiff", ".bmp"})
"""In lower case; what stands after another last dot belongs to the name."""

_ALPHA_MODES = frozenset({"RGBA", "LA", "PA", "RGBa", "La"})

# What Pillow raises for damaged files, by format and by what is damaged.
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
    """What the first bytes of a photograph tell."""

    width: int
    height: int
    transparent: bool


def read_photo_header(path: Path) -> PhotoHeader:
    """Size in pixels as stored, and whether pixels can be transparent. The pixels are not read.

    Raises:
        InvalidViewsError: it is no photograph, or one of more than some 100 megapixels.
    """
    with _opened(path) as image:
        return PhotoHeader(image.width, image.height, _is_transparent(image))


def read_photo(
    path: Path, width: int, height: int, background: Float32[np.ndarray, "3"]
) -> UInt8[np.ndarray, "height width 3"]:
    """A photograph of any size, resized bicubically where it has another; transparent pixels show ``background``.

    Raises:
        InvalidViewsError: it is no photograph, damaged or cut short, or has more than some 100 megapixels.
        UnsupportedError: its pixels are numbers of 32 bits.
    """
    with _opened(path) as image:
        if image.mode in ("I", "F"):
            raise UnsupportedError(f"{path} has pixels of 32 bits; save it with 8 or 16 bits per channel")
        picture = _to_rgb(image, background)
        if picture.size != (width, height):
            picture = picture.resize((width, height), Image.Resampling.BICUBIC)
        return np.array(picture, dtype=np.uint8)


@contextlib.contextmanager
def _opened(path: Path) -> Iterator[Image.Image]:
    try:
        if not path.is_file():  # asked first, because opening a named pipe would wait for its writer
            raise InvalidViewsError(f"cannot read {path}: there is no such photograph")
        with Image.open(path, formats=FORMATS) as image:
            yield image
    except (Image.DecompressionBombError, Image.DecompressionBombWarning) as error:
        raise InvalidViewsError(f"{path} has too many pixels to be read safely; save it smaller") from error
    except MemoryError as error:
        raise InvalidViewsError(f"{path} does not fit into memory; save it smaller") from error
    except _DAMAGED as error:
        if isinstance(error, OSError) and error.errno is not None:
            raise InvalidViewsError(f"cannot read {path}: {(error.strerror or str(error)).lower()}") from error
        raise InvalidViewsError(
            f"{path} is damaged, cut short, or no JPEG, PNG, WebP, TIFF or BMP file; copy or export it again"
        ) from error


def _is_transparent(image: Image.Image) -> bool:
    return image.mode in _ALPHA_MODES or "transparency" in image.info


def _to_rgb(image: Image.Image, background: Float32[np.ndarray, "3"]) -> Image.Image:
    if image.mode.startswith("I;16"):  # Pillow would cut off at 255
        grey = np.asarray(image).astype(np.uint32)
        return Image.fromarray(((grey + 128) // 257).astype(np.uint8)).convert("RGB")
    if not _is_transparent(image):
        return image.convert("RGB")
    pixels = np.asarray(image.convert("RGBA"))
    opacity = pixels[:, :, 3:] * np.float32(1 / 255)
    mixed = pixels[:, :, :3] * opacity + background * np.float32(255) * (1 - opacity)
    return Image.fromarray((mixed + np.float32(0.5)).astype(np.uint8))
