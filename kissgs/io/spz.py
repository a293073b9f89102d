"""The ``.spz`` format, versions 1 to 4: quantised attributes, one stream each, compressed with gzip or (4) zstd.

Axes are x right, y up, z back, unless a file's extension names others. Some tools store those of a ``.ply`` without
saying so; ``raw_axes`` reads their files.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from kissgs.core.array_types import UInt8
from kissgs.core.errors import InvalidSceneError, UnsupportedError
from kissgs.core.progress import Progress, silent
from kissgs.core.splats import SH_REST_COUNTS, Splats, empty_splats
from kissgs.io import spz_values
from kissgs.io.activations import OPACITY_OF_BYTE, look_up
from kissgs.io.frames import axis_signs, mirror
from kissgs.io.scene_file import SceneFile, listed, open_scene_file, refuse_more_than
from kissgs.io.spz_streams import inflate, inflate_start, unpack_frame

MAGIC = b"NGSP"
GZIP_MAGIC = b"\x1f\x8b"

_HEADER = struct.Struct("<4sIIBBBB")
_TABLE_ENTRY = struct.Struct("<QQ")
_HEADER_BYTES_V4 = 32
_EXTENSION = struct.Struct("<II")

_ANTIALIASED, _HAS_EXTENSIONS, _SPARK_TREE = 1, 2, 0x80

_COEFFICIENTS = (*SH_REST_COUNTS, 24)
"""Number of SH coefficients beyond the constant one in a file of degree 0 to 4."""

_COORDINATES = 0xADBE0003
_EXTENSION_NAMES = {0xADBE0002: "the limits of the camera"}
"""Contents of other known extension records."""

_FRAMES = ("", "LDB", "RDB", "LUB", "RUB", "LDF", "RDF", "LUF", "RUF")
"""Frame of each value of the extension for coordinate systems; the first is unspecified.

Values 9 to 16, with z up or down, are refused: version 0.2.3 of the format's library turns the positions of RFU and the
rotations of its Gaussians in opposite directions, so that it is unknown how files with them are meant.
"""

DEFAULT_FRAME, PLY_FRAME = "RUB", "RDF"

_LARGEST_ROW = 20 + 3 * _COEFFICIENTS[-1]
"""Bytes of a Gaussian before compression, with all SH coefficients."""

_MAX_FRACTIONAL_BITS = 31

MAX_EXTENSION_BYTES = 1 << 20
"""Largest size of all extension records: the known ones take 12 and 20 bytes."""


@dataclass(frozen=True, slots=True, kw_only=True)
class SpzInfo:
    """Properties of a scene that the header of its file states."""

    version: int
    """1 to 4."""
    count: int
    """Number of Gaussians."""
    sh_degree: int
    """SH degree of the scene as it is read, 0 to 3."""
    stored_degree: int
    """SH degree of the file, up to 4; the highest band is left out when it is read."""
    fractional_bits: int
    """Bits of positions after the binary point."""
    antialiased: bool
    """Whether the scene was trained with an antialiasing filter."""
    extensions: bool
    """Whether the file has extension records."""

    @property
    def widths(self) -> dict[str, int]:
        """Bytes per Gaussian of each stream, in the order of the file."""
        return {
            "positions": 6 if self.version == 1 else 9,
            "alphas": 1,
            "colors": 3,
            "scales": 3,
            "rotations": 3 if self.version < 3 else 4,
            "sh": 3 * _COEFFICIENTS[self.stored_degree],
        }


def header_bytes(count: int, sh_degree: int, fractional_bits: int, *, antialiased: bool) -> bytes:
    """Return the header of a version 3 file without extension records."""
    return _HEADER.pack(MAGIC, 3, count, sh_degree, fractional_bits, _ANTIALIASED * antialiased, 0)


def is_spz(head: bytes) -> bool:
    """Whether a file begins like ``.spz``; ``head`` are its first 512 bytes, which are unpacked if they are gzip."""
    return (inflate_start(head) if head.startswith(GZIP_MAGIC) else head)[:4] == MAGIC


def read_spz_info(source: Path | bytes) -> SpzInfo:
    """Read the header.

    Raises:
        InvalidSceneError: the file cannot be read, is not ``.spz`` or is damaged.
        UnsupportedError: another version, an SH degree above 4, or Spark's levels of detail.
    """
    with open_scene_file(source) as opened:
        return _read_header(opened)


def read_spz(
    source: Path | bytes, *, max_gaussians: int | None = None, raw_axes: bool = False, progress: Progress = silent
) -> Splats:
    """Read a scene without cleaning it, and turn it to the axes of a ``.ply``.

    Of SH degree 4 the highest band is left out, as are unknown extension records, which ``notes`` says.

    Args:
        source: A file, or the bytes of one.
        max_gaussians: Largest number of Gaussians; more are refused before memory is allocated. None: no limit.
        raw_axes: Take the axes as those of a ``.ply``, whatever the file says.
        progress: Receives events of stage ``read``.

    Raises:
        InvalidSceneError: the file cannot be read, is damaged or cut short.
        UnsupportedError: another version, an SH degree above 4, Spark's levels of detail, or more Gaussians than
            ``max_gaussians``.
    """
    with open_scene_file(source) as opened:
        info = _read_header(opened)
        refuse_more_than(max_gaussians, info.count, opened.name)
        progress("read", 0.0)
        streams, extensions = _read_frames(opened, info) if info.version == 4 else _read_gzip(opened, info)
        progress("read", 0.5)
        splats = replace(_decode(streams, info), antialiased=info.antialiased)
        frame, unread = _read_extensions(extensions, opened.name)
        if not raw_axes:
            mirror(splats, axis_signs(frame))
        progress("read", 1.0)
        if info.stored_degree > info.sh_degree:
            unread.insert(0, f"the SH coefficients of degree {info.stored_degree}")
        return replace(splats, notes=(f"left out: {listed(unread)}",)) if unread else splats


def largest_spz(count: int) -> int:
    """Return a size in bytes that no file of ``count`` Gaussians exceeds."""
    return 2 * MAX_EXTENSION_BYTES + 2 * count * _LARGEST_ROW


def _read_header(opened: SceneFile) -> SpzInfo:
    head = opened.file.read(512)
    gzipped = head.startswith(GZIP_MAGIC)
    plain = inflate_start(head) if gzipped else head
    if len(plain) < _HEADER.size or not plain.startswith(MAGIC):
        raise InvalidSceneError(
            f"{opened.name} is not an .spz file: its header is missing; export or download it again"
        )
    _, version, count, degree, fractional_bits, flags, _ = _HEADER.unpack_from(plain)
    if not 1 <= version <= 4 or gzipped != (version < 4):
        raise UnsupportedError(
            f"{opened.name} is .spz of version {version}{' in gzip' if gzipped else ''}; versions 1 to 3 in gzip and 4 "
            "without are read"
        )
    if degree >= len(_COEFFICIENTS):
        raise UnsupportedError(f"{opened.name} has SH degree {degree}; export it with degree 3 or lower")
    if flags & _SPARK_TREE:
        raise UnsupportedError(
            f"{opened.name} holds Spark's levels of detail, coarse Gaussians among the fine ones; export it without"
        )
    if fractional_bits > _MAX_FRACTIONAL_BITS:
        raise InvalidSceneError(
            f"{opened.name} declares {fractional_bits} fractional bits of positions, where "
            f"{_MAX_FRACTIONAL_BITS} is the largest number; it is damaged"
        )
    return SpzInfo(
        version=version,
        count=count,
        sh_degree=min(degree, 3),
        stored_degree=degree,
        fractional_bits=fractional_bits,
        antialiased=bool(flags & _ANTIALIASED),
        extensions=bool(flags & _HAS_EXTENSIONS),
    )


def _read_gzip(opened: SceneFile, info: SpzInfo) -> tuple[dict[str, UInt8[np.ndarray, "N width"]], bytes]:
    """Return the streams of versions 1 to 3, and the bytes of their extension records."""
    raw = _HEADER.size + info.count * sum(info.widths.values())
    body, extensions = inflate(opened, raw, MAX_EXTENSION_BYTES)
    streams, start = {}, _HEADER.size
    for name, width in info.widths.items():
        streams[name] = body[start : start + info.count * width].reshape(info.count, width)
        start += info.count * width
    return streams, extensions if info.extensions else b""


def _read_frames(opened: SceneFile, info: SpzInfo) -> tuple[dict[str, UInt8[np.ndarray, "N width"]], bytes]:
    """Return the streams of version 4, and the bytes of its extension records."""
    head = opened.read(0, _HEADER_BYTES_V4)
    number, table = head[15], struct.unpack_from("<I", head, 16)[0]
    widths = {name: width for name, width in info.widths.items() if width}
    if number != len(widths):
        raise InvalidSceneError(
            f"{opened.name} has {number} streams; SH degree {info.stored_degree} needs {len(widths)}: export it again"
        )
    if not _HEADER_BYTES_V4 <= table <= _HEADER_BYTES_V4 + MAX_EXTENSION_BYTES:
        raise InvalidSceneError(f"{opened.name} has its table of streams at byte {table:,}; it is damaged")
    extensions = opened.read(_HEADER_BYTES_V4, table - _HEADER_BYTES_V4) if info.extensions else b""
    entries = list(_TABLE_ENTRY.iter_unpack(opened.read(table, number * _TABLE_ENTRY.size)))
    start = table + number * _TABLE_ENTRY.size
    if start + sum(packed for packed, _ in entries) != opened.size:
        raise InvalidSceneError(
            f"{opened.name} is cut short or damaged: its streams do not end at its last byte; download it again"
        )
    for (name, width), (_, raw) in zip(widths.items(), entries, strict=True):
        if raw != info.count * width:
            raise InvalidSceneError(
                f"{opened.name} declares {raw:,} bytes of {name} for {info.count:,} Gaussians; export it again"
            )
    streams = {"sh": np.empty((info.count, 0), np.uint8)}
    for (name, width), (packed, raw) in zip(widths.items(), entries, strict=True):
        data = unpack_frame(opened.read(start, packed), raw, f"{opened.name}: its stream of {name}")
        streams[name] = np.frombuffer(data, np.uint8).reshape(info.count, width)
        start += packed
    return streams, extensions


def _decode(streams: dict[str, UInt8[np.ndarray, "N width"]], info: SpzInfo) -> Splats:
    """Decode all streams; each is dropped when it is decoded."""
    coefficients = SH_REST_COUNTS[info.sh_degree]
    splats = empty_splats(info.count, coefficients)
    positions, rotations = streams.pop("positions"), streams.pop("rotations")
    if info.version == 1:
        spz_values.decode_half_positions(positions, splats.means)
    else:
        spz_values.decode_positions(positions, info.fractional_bits, splats.means)
    if info.version < 3:
        spz_values.decode_three_bytes(rotations, splats.quats)
    else:
        spz_values.decode_smallest_three(rotations, splats.quats)
    del positions, rotations
    look_up(OPACITY_OF_BYTE, streams.pop("alphas")[:, 0], splats.opacities)
    look_up(spz_values.COLOR_OF_BYTE, streams.pop("colors"), splats.sh0)
    look_up(spz_values.SCALE_OF_BYTE, streams.pop("scales"), splats.scales)
    rest = streams.pop("sh").reshape(info.count, _COEFFICIENTS[info.stored_degree], 3)
    look_up(spz_values.SH_OF_BYTE, rest[:, :coefficients], splats.shN)
    return splats


def _read_extensions(extensions: bytes, name: str) -> tuple[str, list[str]]:
    """Return the frame that an extension record names, or else the format's own, and what other records hold."""
    start, frame, unread = 0, DEFAULT_FRAME, dict[str, None]()
    while start + _EXTENSION.size <= len(extensions):
        kind, length = _EXTENSION.unpack_from(extensions, start)
        payload = extensions[start + _EXTENSION.size : start + _EXTENSION.size + length]
        if len(payload) < length:
            raise InvalidSceneError(f"{name} has an extension record that is cut short; export or download it again")
        if kind == _COORDINATES and length >= 4:
            value = int.from_bytes(payload[:4], "little")
            if value >= len(_FRAMES):
                raise UnsupportedError(
                    f"{name} names a coordinate system {value}, which is not read; export it with y up or down"
                )
            frame = _FRAMES[value] or DEFAULT_FRAME
        else:
            unread[_EXTENSION_NAMES.get(kind, f"the extension record 0x{kind:08X}")] = None
        start += _EXTENSION.size + length
    return frame, list(unread)
