"""PNG bytes -> image planes, for containers of tools that write no WebP."""

from __future__ import annotations

import io
import struct

import numpy as np
from PIL import PngImagePlugin

from kissgs.core.array_types import UInt8
from kissgs.core.errors import InvalidContainerError

_MAGIC = b"\x89PNG\r\n\x1a\n"
_HEADER = struct.Struct(">I4sIIB")


def is_png(data: bytes) -> bool:
    """Whether bytes begin like PNG."""
    return data.startswith(_MAGIC)


def probe_png(data: bytes, name: str) -> tuple[int, int]:
    """Return width and height in pixels, from the header alone."""
    if len(data) < len(_MAGIC) + _HEADER.size or data[12:16] != b"IHDR":
        raise InvalidContainerError(f"{name} is damaged: its PNG header is missing; export the scene again")
    _, _, width, height, depth = _HEADER.unpack_from(data, len(_MAGIC))
    if depth > 8:
        raise InvalidContainerError(f"{name} has {depth} bits per channel; planes have 8: export the scene again")
    return width, height


def decode_png(data: bytes, name: str, channels: int) -> UInt8[np.ndarray, "pixels C"]:
    """Decompress one image, whose size has been checked, to rows of pixels of its first 3 or 4 channels.

    Grey images and those with a palette, to which tools for smaller PNG turn others, become what they stand for.
    """
    try:
        with PngImagePlugin.PngImageFile(io.BytesIO(data)) as image_file:
            pixels = np.asarray(image_file.convert("RGBA"))
    except Exception as error:  # Pillow raises errors of many kinds for damaged chunks
        raise InvalidContainerError(f"{name} is damaged: its PNG data cannot be decoded; download it again") from error
    return pixels.reshape(-1, 4)[:, :channels]
