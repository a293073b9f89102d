"""Image planes from PNG, and to and from lossless WebP, all of a container in parallel."""

from __future__ import annotations

import io
import struct
import zlib
from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING

import numpy as np
from PIL import Image, PngImagePlugin, WebPImagePlugin

from kissgs.core.array_types import UInt8
from kissgs.core.context import Workers
from kissgs.core.errors import InvalidContainerError

if TYPE_CHECKING:
    from kissgs.settings import EncodeSettings

# PNG bytes -> image planes, for containers of tools that write no WebP.

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
    """Decompress one image, whose size has been checked, to rows of pixels of its first 3 or 4 channels. Grey images
    and those with a palette, to which tools for smaller PNG turn others, become what they stand for."""
    try:
        with PngImagePlugin.PngImageFile(io.BytesIO(data)) as image_file:
            pixels = np.asarray(image_file.convert("RGBA"))
    except Exception as error:  # Pillow raises errors of many kinds for damaged chunks
        raise InvalidContainerError(f"{name} is damaged: its PNG data cannot be decoded; download it again") from error
    return pixels.reshape(-1, 4)[:, :channels]


# Image planes <-> lossless WebP bytes.


def encode_plane(image: UInt8[np.ndarray, "H W C"], *, quality: int, method: int) -> bytes:
    """Compress one image of 1, 3 or 4 channels losslessly; ``quality`` and ``method`` set libwebp's effort. Without
    ``exact``, libwebp would blacken the colour of pixels whose fourth channel is 0."""
    image_file = Image.fromarray(image[:, :, 0] if image.shape[2] == 1 else image)
    buffer = io.BytesIO()
    image_file.save(buffer, "WEBP", lossless=True, exact=True, quality=quality, method=method)
    return buffer.getvalue()


def pixels_crc32(image: UInt8[np.ndarray, "H W C"]) -> int:
    """Return the CRC-32 of an image of 1, 3 or 4 channels as a browser decodes it, to RGBA. Some browsers' decoders are
    fast but not exact, or add noise; with this checksum the web decoder detects it."""
    rgba = np.full((*image.shape[:2], 4), 255, dtype=np.uint8)
    rgba[:, :, : max(image.shape[2], 3)] = image
    return zlib.crc32(rgba.data)


def decode_plane(
    data: bytes, name: str, *, width: int, height: int, channels: int, crc32: int | None = None
) -> UInt8[np.ndarray, "pixels C"]:
    """Decompress one image to rows of pixels: of the first channel, of 3, or of 4 (the fourth is 255 if there is none).
    The size is checked before memory is allocated; ``crc32`` is that of :func:`pixels_crc32`, None if it is unknown."""
    found = probe_webp(data, name)
    if found != (width, height):
        raise InvalidContainerError(
            f"{name} is {found[0]} x {found[1]} pixels; the metadata asks for {width} x {height}"
        )
    try:
        # Image.open would first import the plugins of all other formats.
        with WebPImagePlugin.WebPImageFile(io.BytesIO(data)) as image_file:
            image_file.load()
            pixels = np.asarray(image_file)
            found_crc32 = None if crc32 is None else zlib.crc32(image_file.convert("RGBA").tobytes())
    except (OSError, ValueError, SyntaxError, EOFError, MemoryError) as error:
        raise InvalidContainerError(f"{name} is damaged: its WebP data cannot be decoded") from error
    if found_crc32 != crc32:
        raise InvalidContainerError(f"{name} is damaged: its pixels are not those that were stored")
    if channels == 4 and pixels.shape[2] == 3:
        pixels = np.concatenate([pixels, np.full((height, width, 1), 255, dtype=np.uint8)], axis=2)
    return pixels.reshape(width * height, -1)[:, :channels]


def probe_webp(data: bytes, name: str) -> tuple[int, int]:
    """Return width and height in pixels, from the header alone."""
    if len(data) < 20 or data[:4] != b"RIFF" or data[8:12] != b"WEBP":
        raise InvalidContainerError(f"{name} is not a WebP image")
    if struct.unpack_from("<I", data, 4)[0] + 8 > len(data):
        raise InvalidContainerError(f"{name} is cut off: its header announces more bytes than there are")
    position, size = 12, None
    while position + 8 <= len(data):
        kind, length = data[position : position + 4], struct.unpack_from("<I", data, position + 4)[0]
        body = position + 8
        if kind == b"VP8L" and body + 5 <= len(data) and data[body] == 0x2F:
            bits = struct.unpack_from("<I", data, body + 1)[0]
            found = (bits & 0x3FFF) + 1, (bits >> 14 & 0x3FFF) + 1
            if size not in (None, found):
                break
            return found
        if kind == b"VP8X" and body + 10 <= len(data):
            wide, high = data[body + 4 : body + 7] + b"\0", data[body + 7 : body + 10] + b"\0"
            size = struct.unpack("<I", wide)[0] + 1, struct.unpack("<I", high)[0] + 1
        if kind in (b"VP8 ", b"ANIM", b"ANMF"):
            raise InvalidContainerError(f"{name} is a lossy or animated WebP; planes must be lossless")
        position = body + length + (length & 1)
    raise InvalidContainerError(f"{name} is damaged: it has no lossless WebP image inside")


# Compression of all planes of a container, in parallel.

# libwebp's quality and method for the codebook, and for small images. With the first it tries all transforms: codebooks
# are 5 to 9 % smaller. That takes up to ten seconds for large ones, which get the second.
HIGHEST_EFFORT, HIGH_EFFORT = (100, 6), (100, 5)
NO_GAIN = ("mask", "means", "labels")  # parts of the names of images that no effort makes smaller
USUAL_EFFORT = (75, 4)  # quality and method up to which large images take less effort
LARGE = 500_000  # pixels from which an image is large: more effort than effort_of gives saves 0.1 % in twice the time


def compress_images(
    images: Mapping[str, UInt8[np.ndarray, "_ _ _"]],
    settings: EncodeSettings,
    pool: Workers,
    report: Callable[[float], None],
    *,
    codebook: str = "f_rest_centroids.webp",
) -> dict[str, bytes]:
    """Compress all images of a container in parallel, the slowest first: the one called ``codebook``."""

    def work(name: str) -> bytes:
        height, width, _ = shape = images[name].shape
        quality, method = effort_of(shape, settings.webp_quality, settings.webp_method)
        gains = not any(part in name for part in NO_GAIN)
        if settings.codebook_max_effort and name == codebook:
            quality, method = HIGHEST_EFFORT if height * width < LARGE else HIGH_EFFORT
        elif gains and height * width <= settings.high_effort_pixels:
            quality, method = max(quality, HIGH_EFFORT[0]), max(method, HIGH_EFFORT[1])
        return encode_plane(images[name], quality=quality, method=method)

    names = sorted(images, key=lambda name: (name != codebook, -images[name].size))
    made = pool.map(work, names, lambda done: report(done**0.25))  # the first one takes most of the time
    files = dict(zip(names, made, strict=True))
    return {name: files[name] for name in images}


def effort_of(shape: tuple[int, ...], quality: int, method: int) -> tuple[int, int]:
    """Return libwebp's quality and method for an image, given those of the settings. Large images take less effort
    where it saves next to nothing (docs/benchmarks.md), unless the settings ask for more than :data:`USUAL_EFFORT`.
    Those of one channel even become smaller with a lower quality."""
    height, width, channels = shape
    if height * width < LARGE or quality > USUAL_EFFORT[0] or method > USUAL_EFFORT[1]:
        return quality, method
    return (min(quality, 25), method) if channels == 1 else (min(quality, 50), min(method, 2))
