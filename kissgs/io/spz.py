"""The ``.spz`` format, versions 1 to 4: quantised attributes, one stream each, compressed with gzip or (4) zstd."""

from __future__ import annotations

import struct
import sys
import zlib
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from kissgs.core.array_types import Float, Float32, UInt8
from kissgs.core.context import Progress, silent
from kissgs.core.errors import InvalidSceneError, UnsupportedError
from kissgs.core.splats import SH_REST_COUNTS, Splats, blocks, empty_splats
from kissgs.io.conventions import (
    OPACITY_OF_BYTE,
    Signs,
    axis_signs,
    clamped,
    insert_largest,
    look_up,
    mirror,
    opacities_of,
    quat_signs,
    refuse_empty,
    sh_signs,
    split_largest,
    to_bytes,
    to_codes,
)
from kissgs.io.files import BinaryWriter, SceneFile, listed, open_scene_file, refuse_degree, refuse_more_than
from kissgs.io.scene_format import DEFAULT_READ_OPTIONS, Codec, Facts, Match, Notes, ReadOptions, titled

# Decompression: gzip and zstd, bounded by what the header needs.

_GZIP = 16 + zlib.MAX_WBITS

_BLOCK_BYTES = 1 << 20

_MAX_RATIO = 1032  # largest ratio of deflate: 258 bytes of two bits
_MIN_WINDOW_LOG = 27  # windows of zstd up to 128 MiB are always accepted: its command line makes no larger ones


def inflate_start(head: bytes) -> bytes:
    """Return what the beginning of a gzip file unpacks to, at most 64 bytes; nothing if it is damaged."""
    try:
        return zlib.decompressobj(_GZIP).decompress(head, 64)
    except zlib.error:
        return b""


def inflate(opened: SceneFile, size: int, most_behind: int) -> tuple[UInt8[np.ndarray, " size"], bytes]:
    """Unpack a gzip file of ``size`` bytes and up to ``most_behind`` more; return both parts."""
    if size > _MAX_RATIO * opened.size:
        raise opened.invalid(f"is cut short: {opened.size:,} bytes cannot hold what its header declares")
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
                raise opened.invalid("is damaged: it unpacks to more bytes than its header declares")
    except zlib.error as error:
        raise opened.invalid("is damaged: gzip cannot unpack it") from error
    if filled < size or not stream.eof:
        raise opened.invalid(f"is cut short: it unpacks to {filled + len(behind):,} bytes of {size:,}")
    return body, bytes(behind)


def unpack_frame(frame: bytes, size: int, what: str) -> bytes:
    """Unpack one zstd frame of exactly ``size`` bytes; ``what`` names it in errors."""
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


# Values: from the bytes of each stream to arrays, and back.

_BYTE = np.arange(256)

SCALE_OF_BYTE = (_BYTE / 16 - 10).astype(np.float32)  # natural logarithm of a standard deviation, in steps of 1/16
COLOR_OF_BYTE = ((_BYTE / 255 - 0.5) / 0.15).astype(np.float32)  # constant SH coefficient; 0.15 is the format's factor
SH_OF_BYTE = ((_BYTE - 128) / 128).astype(np.float32)  # other SH coefficients

SH_STEPS = (4, 8)
"""Steps of the codes that are written, in the first band and above: 6 and 5 bits. Readers need not know them.

The format's own library writes 5 and 4 bits by default, which take a fifth fewer bytes of fox and lose 1.5 decibels to
its photographs.
"""


def decode_positions(codes: UInt8[np.ndarray, "N 9"], fractional_bits: int, out: Float32[np.ndarray, "N 3"]) -> None:
    """Decode positions of versions 2 and later: 24-bit integers, little-endian, of steps of 2^-fractional_bits."""
    for part in blocks(len(codes)):
        low, middle, high = (codes[part, i::3].astype(np.int32) for i in range(3))
        signed = (low << 8 | middle << 16 | high << 24) >> 8
        out[part] = np.ldexp(signed.astype(np.float64), -fractional_bits)


def decode_three_bytes(codes: UInt8[np.ndarray, "N 3"], out: Float32[np.ndarray, "N 4"]) -> None:
    """Decode rotations of versions 1 and 2 to w, x, y, z: x, y, z in a byte each, w the rest of the unit length."""
    for part in blocks(len(codes)):
        small = codes[part] / 127.5 - 1
        out[part] = insert_largest(small, np.zeros(len(small), np.int64))


def decode_smallest_three(codes: UInt8[np.ndarray, "N 4"], out: Float32[np.ndarray, "N 4"]) -> None:
    """Decode rotations of versions 3 and later to w, x, y, z. Of a word's 32 bits the highest two name the largest of
    x, y, z, w; the others follow, the last in the lowest ten bits: nine of magnitude, one of sign."""
    words = codes.view("<u4")[:, 0]
    for part in blocks(len(codes)):
        word = words[part]
        fields = np.stack([word >> shift & 1023 for shift in (20, 10, 0)], axis=1)
        magnitude = (fields & 511) / 511 * np.sqrt(0.5)
        xyzw = insert_largest(np.where(fields & 512, -magnitude, magnitude), (word >> 30).astype(np.int64))
        out[part] = np.roll(xyzw, 1, axis=1)


def fractional_bits_for(reach: float) -> int:
    """Return the bits after the binary point of positions up to ``reach`` from the origin along an axis. They are 12,
    as the format's own library writes; fewer where a scene reaches beyond ±2048, and more where it is smaller than ±4,
    so that it has at least 2^14 steps; 23 are the most."""
    exponent = int(np.frexp(reach)[1])
    return max(0, min(23 - exponent, max(12, 15 - exponent), 23))


def encode_positions(means: Float[np.ndarray, "B 3"], fractional_bits: int) -> UInt8[np.ndarray, "B 9"]:
    """Encode positions as the nearest steps, clamped to 24 bits."""
    steps_of = np.floor(np.ldexp(means.astype(np.float64), fractional_bits) + 0.5)
    codes = np.clip(steps_of, -(1 << 23), (1 << 23) - 1).astype("<i4")
    return codes.view(np.uint8).reshape(len(means), 3, 4)[:, :, :3].reshape(len(means), 9)


def encode_scales(scales: Float32[np.ndarray, "B 3"]) -> UInt8[np.ndarray, "B 3"]:
    """Encode logarithms of standard deviations, clamped to -10 to 5.9375."""
    return to_bytes((scales.astype(np.float64) + 10) * 16)


def encode_colors(sh0: Float32[np.ndarray, "B 3"]) -> UInt8[np.ndarray, "B 3"]:
    """Encode constant SH coefficients, clamped to ±3.3333."""
    return to_bytes(255 * (0.15 * sh0.astype(np.float64) + 0.5))


def encode_sh(shN: Float[np.ndarray, "B K 3"]) -> UInt8[np.ndarray, "B bytes"]:
    """Encode other SH coefficients, each band in its own steps."""
    step = np.where(np.arange(shN.shape[1]) < 3, *SH_STEPS)[:, None]
    codes = np.floor(np.clip(shN.astype(np.float64), -2, 2) * 128 + 128.5).astype(np.int64)
    return np.clip((codes + step // 2) // step * step, 0, 255).astype(np.uint8).reshape(len(shN), 3 * shN.shape[1])


def encode_smallest_three(quats: Float32[np.ndarray, "B 4"]) -> UInt8[np.ndarray, "B 4"]:
    """Encode rotations w, x, y, z in the 32 bits of :func:`decode_smallest_three`."""
    index, small = split_largest(np.roll(quats, -1, axis=1))
    fields = to_codes(511 * np.sqrt(2) * np.abs(small), 511) | (small < 0).astype(np.int64) << 9
    words = index << 30 | fields[:, 0] << 20 | fields[:, 1] << 10 | fields[:, 2]
    return words.astype("<u4").view(np.uint8).reshape(len(quats), 4)


# Reading.
#
# Axes are x right, y up, z back, unless a file's extension names others. Some tools store those of a ``.ply`` without
# saying so; ``raw_axes`` reads their files.

MAGIC = b"NGSP"
GZIP_MAGIC = b"\x1f\x8b"

_HEADER = struct.Struct("<4sIIBBBB")
_TABLE_ENTRY = struct.Struct("<QQ")
_HEADER_BYTES_V4 = 32
_EXTENSION = struct.Struct("<II")

_ANTIALIASED, _HAS_EXTENSIONS, _SPARK_TREE = 1, 2, 0x80

_COEFFICIENTS = (*SH_REST_COUNTS, 24)  # number of SH coefficients beyond the constant one in a file of degree 0 to 4

_COORDINATES = 0xADBE0003
_EXTENSION_NAMES = {0xADBE0002: "the limits of the camera"}  # contents of other known extension records

_FRAMES = ("", "LDB", "RDB", "LUB", "RUB", "LDF", "RDF", "LUF", "RUF")
"""Frame of each value of the extension for coordinate systems; the first is unspecified.

Values 9 to 16, with z up or down, are refused: version 0.2.3 of the format's library turns the positions of RFU and the
rotations of its Gaussians in opposite directions, so that it is unknown how files with them are meant.
"""

DEFAULT_FRAME, PLY_FRAME = "RUB", "RDF"

LARGEST_ROW = 20 + 3 * _COEFFICIENTS[-1]  # bytes of a Gaussian before compression, with all SH coefficients

_MAX_FRACTIONAL_BITS = 31

MAX_EXTENSION_BYTES = 1 << 20  # largest size of all extension records: the known ones take 12 and 20 bytes


@dataclass(frozen=True, slots=True, kw_only=True)
class SpzInfo:
    """Properties of a scene that the header of its file states."""

    version: int  # 1 to 4
    count: int
    sh_degree: int  # as it is read, 0 to 3
    stored_degree: int  # up to 4; the highest band is left out when it is read
    fractional_bits: int  # of positions
    antialiased: bool
    extensions: bool  # whether the file has extension records

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


def read_spz_info(source: Path | bytes) -> SpzInfo:
    """Read the header."""
    with open_scene_file(source) as opened:
        return _read_header(opened)


def read_spz(
    source: Path | bytes, reading: ReadOptions = DEFAULT_READ_OPTIONS, threads: int = 0, progress: Progress = silent
) -> Splats:
    """Read a scene, and turn it to the axes of a ``.ply``. Of SH degree 4 the highest band is left out, as are unknown
    extension records, which ``notes`` says."""
    with open_scene_file(source) as opened:
        info = _read_header(opened)
        refuse_more_than(reading.max_compressed, info.count, opened.name)
        progress("read", 0.0)
        streams, extensions = _read_frames(opened, info) if info.version == 4 else _read_gzip(opened, info)
        progress("read", 0.5)
        splats = replace(_decode(streams, info), antialiased=info.antialiased)
        frame, unread = _read_extensions(extensions, opened.name)
        if not reading.raw_axes:
            mirror(splats, axis_signs(frame))
        progress("read", 1.0)
        if info.stored_degree > info.sh_degree:
            unread.insert(0, f"the SH coefficients of degree {info.stored_degree}")
        return replace(splats, notes=(f"left out: {listed(unread)}",)) if unread else splats


def _read_header(opened: SceneFile) -> SpzInfo:
    head = opened.file.read(512)
    gzipped = head.startswith(GZIP_MAGIC)
    plain = inflate_start(head) if gzipped else head
    if len(plain) < _HEADER.size or not plain.startswith(MAGIC):
        raise opened.invalid("is not an .spz file: its header is missing")
    _, version, count, degree, fractional_bits, flags, _ = _HEADER.unpack_from(plain)
    if not 1 <= version <= 4 or gzipped != (version < 4):
        raise UnsupportedError(
            f"{opened.name} is .spz of version {version}{' in gzip' if gzipped else ''}; versions 1 to 3 in gzip and 4 "
            "without are read"
        )
    if degree >= len(_COEFFICIENTS):  # 4 is read without its highest band
        refuse_degree(degree, opened.name)
    if flags & _SPARK_TREE:
        raise UnsupportedError(
            f"{opened.name} holds Spark's levels of detail, coarse Gaussians among the fine ones; export it without"
        )
    if fractional_bits > _MAX_FRACTIONAL_BITS:
        raise opened.invalid(f"has {fractional_bits} fractional bits of positions; {_MAX_FRACTIONAL_BITS} are the most")
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
        raise opened.invalid(f"has {number} streams, where SH degree {info.stored_degree} needs {len(widths)}")
    if not _HEADER_BYTES_V4 <= table <= _HEADER_BYTES_V4 + MAX_EXTENSION_BYTES:
        raise opened.invalid(f"is damaged: its table of streams is at byte {table:,}")
    extensions = opened.read(_HEADER_BYTES_V4, table - _HEADER_BYTES_V4) if info.extensions else b""
    entries = list(_TABLE_ENTRY.iter_unpack(opened.read(table, number * _TABLE_ENTRY.size)))
    start = table + number * _TABLE_ENTRY.size
    if start + sum(packed for packed, _ in entries) != opened.size:
        raise opened.invalid("is cut short or damaged: its streams do not end at its last byte")
    for (name, width), (_, raw) in zip(widths.items(), entries, strict=True):
        if raw != info.count * width:
            raise opened.invalid(f"declares {raw:,} bytes of {name} for {info.count:,} Gaussians")
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
    if info.version == 1:
        with np.errstate(all="ignore"):  # half floats; values may be any floats and are not cleaned here
            splats.means[:] = streams.pop("positions").view("<f2")
    else:
        decode_positions(streams.pop("positions"), info.fractional_bits, splats.means)
    (decode_three_bytes if info.version < 3 else decode_smallest_three)(streams.pop("rotations"), splats.quats)
    look_up(OPACITY_OF_BYTE, streams.pop("alphas")[:, 0], splats.opacities)
    look_up(COLOR_OF_BYTE, streams.pop("colors"), splats.sh0)
    look_up(SCALE_OF_BYTE, streams.pop("scales"), splats.scales)
    rest = streams.pop("sh").reshape(info.count, _COEFFICIENTS[info.stored_degree], 3)
    look_up(SH_OF_BYTE, rest[:, :coefficients], splats.shN)
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


# Writing: version 3, one gzip member without extension records, which the most readers take.


def write_spz(file: BinaryWriter, splats: Splats, raw_axes: bool = False, progress: Progress = silent) -> Notes:
    """Write a scene."""
    count = len(splats)
    refuse_empty(splats, ".spz")
    reach = float(np.abs(splats.means).max())
    bits = fractional_bits_for(reach)
    encoders = _encoders(splats, bits, axis_signs(PLY_FRAME if raw_axes else DEFAULT_FRAME))
    packer = zlib.compressobj(wbits=_GZIP)  # writes no time into the file
    header = _HEADER.pack(MAGIC, 3, count, splats.sh_degree, bits, _ANTIALIASED * splats.antialiased, 0)
    file.write(packer.compress(header))
    for done, encode in enumerate(encoders, 1):
        for part in blocks(count):
            file.write(packer.compress(encode(part).tobytes()))
        progress("write", done / len(encoders))
    file.write(packer.flush())
    return _notes(splats, reach, bits)


def _encoders(splats: Splats, bits: int, signs: Signs) -> list[Callable[[slice], UInt8[np.ndarray, "B width"]]]:
    """Return the encoder of each stream, in the order of the file."""
    of_axes = np.array(signs, np.float32)
    of_quats = np.array(quat_signs(signs), np.float32)
    of_sh = sh_signs(signs, splats.shN.shape[1])[:, None]
    return [
        lambda part: encode_positions(splats.means[part] * of_axes, bits),
        lambda part: to_bytes(255 * opacities_of(splats.opacities[part]))[:, None],
        lambda part: encode_colors(splats.sh0[part]),
        lambda part: encode_scales(splats.scales[part]),
        lambda part: encode_smallest_three(splats.quats[part] * of_quats),
        lambda part: encode_sh(splats.shN[part] * of_sh),  # nothing, without view-dependent colour
    ]


def _notes(splats: Splats, reach: float, bits: int) -> tuple[str, ...]:
    """Return what is lost beyond the steps that the format always has."""
    steps_of = f"positions have steps of {2.0**-bits:g}, because the scene reaches {reach:,.0f} from the origin"
    limit, edge = (1 << 23) - 1, (0.5 + 0.5 / 255) / 0.15
    return (
        *[steps_of] * (bits < 12),
        *clamped("positions", splats.means, -limit - 1, limit + 0.5, f"±{limit:,}"),
        *clamped("scales", splats.scales, -10 - 1 / 32, 5.9375 + 1 / 32, "e^-10 to e^5.94"),
        *clamped("colours", splats.sh0, -edge, edge, "coefficients of ±3.33"),
        *clamped("view-dependent colours", splats.shN, -1 - 1 / 32, 1 + 1 / 32, "coefficients of ±1"),
    )


def _sniff(head: bytes, size: int) -> Match:
    plain = inflate_start(head) if head.startswith(GZIP_MAGIC) else head
    return Match.SURE if plain[:4] == MAGIC else Match.NO


def _describe(path: Path | bytes, level: int) -> Facts:
    found = read_spz_info(path)
    antialiased = "antialiased" if found.antialiased else ""
    return Facts(
        title=titled("SPZ scene", f"version {found.version}", antialiased),
        count=found.count,
        sh_degree=found.sh_degree,
        details={name: getattr(found, name) for name in ("version", "antialiased", "fractional_bits")},
    )


FORMAT = Codec(sniff=_sniff, info=_describe, read=read_spz, write={".spz": write_spz})
