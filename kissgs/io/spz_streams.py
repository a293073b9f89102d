"""Decompression of ``.spz``: gzip and zstd, bounded by what the header needs."""

from __future__ import annotations

import sys
import zlib

import numpy as np

from kissgs.core.array_types import UInt8
from kissgs.core.errors import InvalidSceneError
from kissgs.io.scene_file import SceneFile

_GZIP = 16 + zlib.MAX_WBITS

_BLOCK_BYTES = 1 << 20

_MAX_RATIO = 1032
"""Largest ratio of deflate: 258 bytes of two bits."""

_MIN_WINDOW_LOG = 27
"""Windows of zstd up to 128 MiB are accepted in any case: its command line makes no larger ones unless asked to."""


def inflate_start(head: bytes) -> bytes:
    """Return what the beginning of a gzip file unpacks to, at most 64 bytes; nothing if it is damaged."""
    try:
        return zlib.decompressobj(_GZIP).decompress(head, 64)
    except zlib.error:
        return b""


def inflate(opened: SceneFile, size: int, most_behind: int) -> tuple[UInt8[np.ndarray, " size"], bytes]:
    """Unpack a gzip file of ``size`` bytes and up to ``most_behind`` more; return both parts.

    Raises:
        InvalidSceneError: the file is damaged, or has fewer or more bytes.
    """
    if size > _MAX_RATIO * opened.size:
        raise InvalidSceneError(
            f"{opened.name} is cut short: {opened.size:,} bytes cannot hold what its header declares; download it again"
        )
    body = np.empty(size, np.uint8)
    behind = bytearray()
    filled = 0
    stream = zlib.decompressobj(_GZIP)
    opened.file.seek(0)
    try:
        while not stream.eof:
            packed = stream.unconsumed_tail or opened.file.read(_BLOCK_BYTES)
            if not packed:
                break
            block = stream.decompress(packed, _BLOCK_BYTES)
            part = block[: size - filled]
            body[filled : filled + len(part)] = np.frombuffer(part, np.uint8)
            filled += len(part)
            behind += block[len(part) :]
            if len(behind) > most_behind:
                raise InvalidSceneError(f"{opened.name} unpacks to more bytes than its header declares; it is damaged")
    except zlib.error as error:
        raise InvalidSceneError(f"{opened.name} is damaged: gzip cannot unpack it; download it again") from error
    if filled < size or not stream.eof:
        raise InvalidSceneError(
            f"{opened.name} is cut short: it unpacks to {filled + len(behind):,} bytes of {size:,}; download it again"
        )
    return body, bytes(behind)


def unpack_frame(frame: bytes, size: int, what: str) -> bytes:
    """Unpack one zstd frame of exactly ``size`` bytes; ``what`` names it in errors.

    Raises:
        InvalidSceneError: the frame is damaged, or has fewer or more bytes.
    """
    if sys.version_info >= (3, 14):
        from compression import zstd
    else:
        from backports import zstd

    window = min(31, max(_MIN_WINDOW_LOG, size.bit_length()))
    try:
        stream = zstd.ZstdDecompressor(options={zstd.DecompressionParameter.window_log_max: window})
        parts = [stream.decompress(frame, max_length=size + 1)]
        while not stream.eof and parts[-1] and sum(map(len, parts)) <= size:
            parts.append(stream.decompress(b"", max_length=size + 1))
    except zstd.ZstdError as error:
        raise InvalidSceneError(f"{what} is damaged: zstd cannot unpack it; download the file again") from error
    data = parts[0] if len(parts) == 1 else b"".join(parts)
    if len(data) != size or not stream.eof or stream.unused_data:
        raise InvalidSceneError(f"{what} is damaged: it does not unpack to {size:,} bytes; download the file again")
    return data
