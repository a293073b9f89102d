"""The ``.ksplat`` format: a header of 4096 bytes, one of 1024 for each section, then the sections' records. The
compression level decides what a record holds: 0 floats, 1 and 2 positions relative to the centre of a bucket of some
hundred Gaussians and half floats, 2 the view-dependent colour in bytes. The axes are those of a ``.ply``."""

from __future__ import annotations

import struct
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from kissgs.core.array_types import Float32, Float64, Int, Int64, Shaped
from kissgs.core.context import Progress, silent
from kissgs.core.errors import InvalidSceneError, UnsupportedError
from kissgs.core.splats import SH_REST_COUNTS, Splats, empty_splats
from kissgs.io.conventions import OPACITY_OF_BYTE, SH0_OF_BYTE, log_scales
from kissgs.io.files import SceneFile, open_scene_file, refuse_degree, refuse_more_than
from kissgs.io.scene_format import DEFAULT_READ_OPTIONS, Codec, Facts, Match, ReadOptions, titled

MAIN_BYTES, SECTION_BYTES = 4096, 1024

MAX_SECTIONS = 1 << 14  # sections, whose headers are read at once; a scene has one for each level or part of it

_MAIN = struct.Struct("<BBxxIIIIHxx3f2f")
_SECTION = struct.Struct("<IIIIfHxxIIIIH")

_CENTRE_BYTES = 12
_FLOATS = ("<f4", "<f2", "<f2")
_POSITIONS = ("<f4", "<u2", "<u2")
_SH = ("<f4", "<f2", "u1")  # NumPy's types of scales and rotations, positions, SH coefficients, by compression level

_DEFAULT_RANGE = (1, 32767, 32767)
_DEFAULT_SH_RANGE = (-1.5, 1.5)


@dataclass(frozen=True, slots=True)
class _Section:
    """Section: its records are ``count`` times ``dtype`` at ``offset``, after the buckets' lengths and centres."""

    count: int
    degree: int
    dtype: np.dtype
    offset: int
    buckets: int
    full_buckets: int
    bucket_size: int
    table_offset: int
    step: float
    middle: int


@dataclass(frozen=True, slots=True)
class _Headers:
    level: int
    sh_range: tuple[float, float]
    sections: tuple[_Section, ...]

    @property
    def count(self) -> int:
        return sum(section.count for section in self.sections)

    @property
    def degree(self) -> int:
        return max((section.degree for section in self.sections), default=0)


def _sniff(head: bytes, size: int) -> Match:
    """Compare the first 24 bytes with what a header, which has no magic number, may hold."""
    if size < MAIN_BYTES or len(head) < 24 or head[:4] != b"\0\1\0\0":
        return Match.NO
    most, sections, most_splats, splats, level = struct.unpack_from("<IIIIH", head, 4)
    fits = 0 < sections <= most <= size // SECTION_BYTES and splats <= most_splats <= size // 24 and level <= 2
    return Match.LIKELY if fits else Match.NO


def describe(path: Path | bytes, level: int = 0) -> Facts:
    """Read the headers and check them against the file's size."""
    with open_scene_file(path) as opened:
        headers = _read_headers(opened)
    return Facts(
        title=titled(".ksplat scene", f"compression level {headers.level}"),
        count=headers.count,
        sh_degree=headers.degree,
        details={"compression_level": headers.level, "sections": len(headers.sections)},
    )


def read_ksplat(
    source: Path | bytes, reading: ReadOptions = DEFAULT_READ_OPTIONS, threads: int = 0, progress: Progress = silent
) -> Splats:
    """Read a scene; sections of a lower SH degree get zeros for the coefficients above it."""
    with open_scene_file(source) as opened:
        headers = _read_headers(opened)
        count = headers.count
        refuse_more_than(reading.max_gaussians, count, opened.name)
        progress("read", 0.0)
        splats = empty_splats(count, SH_REST_COUNTS[headers.degree])
        start = 0
        for section in headers.sections:
            _read_section(opened, headers, section, splats.select(slice(start, start + section.count)))
            start += section.count
            progress("read", start / max(count, 1))
        return splats


def _read_headers(opened: SceneFile) -> _Headers:
    head = opened.read(0, MAIN_BYTES)
    major, minor, most, sections, _, splats, level, *_, sh_low, sh_high = _MAIN.unpack_from(head)
    if (major, minor) != (0, 1):
        raise UnsupportedError(f"{opened.name} is .ksplat of version {major}.{minor}; 0.1 is read: export it again")
    if level > 2:
        raise UnsupportedError(f"{opened.name} has compression level {level}; levels 0 to 2 are read")
    if sections > most:
        raise opened.invalid(f"declares {sections} sections with room for {most}")
    if sections > MAX_SECTIONS:
        raise UnsupportedError(f"{opened.name} has {sections:,} sections; at most {MAX_SECTIONS:,} are read")
    offset = MAIN_BYTES + most * SECTION_BYTES
    if offset > opened.size:
        raise opened.cut_short(offset)
    found = []
    for i in range(sections):
        section, offset = _read_section_header(opened, level, i, offset)
        found.append(section)
    if (total := sum(section.count for section in found)) != splats:
        raise opened.invalid(f"declares {splats:,} Gaussians, but its sections have {total:,}")
    low, high = (sh_low or _DEFAULT_SH_RANGE[0]), (sh_high or _DEFAULT_SH_RANGE[1])
    if not np.isfinite([low, high]).all():
        raise opened.invalid("has a range of SH coefficients that is not finite")
    return _Headers(level, (low, high), tuple(found))


def _read_section_header(opened: SceneFile, level: int, index: int, offset: int) -> tuple[_Section, int]:
    """Return a section whose data begins at ``offset``, and where its data ends."""
    where = f"{opened.name}, section {index + 1}"
    header = opened.read(MAIN_BYTES + index * SECTION_BYTES, SECTION_BYTES)
    count, most, bucket_size, buckets, block_size, centre_bytes, middle, _, full, partial, degree = (
        _SECTION.unpack_from(header)
    )
    refuse_degree(degree, where)
    if count > most:
        raise InvalidSceneError(f"{where}: it declares {count:,} Gaussians with room for {most:,}; export it again")
    if level == 0:
        buckets = partial = 0
    elif full + partial != buckets or (count and (centre_bytes != _CENTRE_BYTES or not np.isfinite(block_size))):
        raise InvalidSceneError(f"{where}: its buckets contradict each other; export or download the scene again")
    fields = [("means", _POSITIONS[level], 3), ("scales", _FLOATS[level], 3), ("quats", _FLOATS[level], 4)]
    dtype = np.dtype([*fields, ("rgba", "u1", 4), ("rest", _SH[level], 3 * SH_REST_COUNTS[degree])])
    records = offset + 4 * partial + _CENTRE_BYTES * buckets
    end = records + most * dtype.itemsize
    if end > opened.size:
        raise opened.cut_short(end)
    middle = middle or _DEFAULT_RANGE[level]
    step = block_size / 2 / middle
    return _Section(count, degree, dtype, records, buckets, full, bucket_size, offset, step, middle), end


@np.errstate(all="ignore")  # values may be any floats; they are not cleaned here
def _read_section(opened: SceneFile, headers: _Headers, section: _Section, out: Splats) -> None:
    """Decode the records of a section, some thousand at a time, into ``out``."""
    ends, centres = _read_buckets(opened, section) if headers.level and section.count else (None, None)
    order = _rest_order(section.degree)
    for step, rows in opened.rows(section.offset, section.dtype, section.count):
        part = out.select(step)
        if ends is None or centres is None:
            part.means[:] = rows["means"]
        else:
            bucket = np.searchsorted(ends, np.arange(step.start, step.stop), side="right")
            part.means[:] = (rows["means"].astype(np.float64) - section.middle) * section.step + centres[bucket]
        part.quats[:] = rows["quats"]
        part.scales[:] = log_scales(rows["scales"])
        _decode_rest(rows, order, headers, part.shN)
        part.sh0[:] = SH0_OF_BYTE[rows["rgba"][:, :3]]
        part.opacities[:] = OPACITY_OF_BYTE[rows["rgba"][:, 3]]


def _read_buckets(opened: SceneFile, section: _Section) -> tuple[Int64[np.ndarray, " B"], Float64[np.ndarray, "B 3"]]:
    """Return after which Gaussian of the section each bucket ends, and its centre; full buckets stand first."""
    partial = section.buckets - section.full_buckets
    lengths = np.frombuffer(opened.read(section.table_offset, 4 * partial), "<u4").astype(np.int64)
    data = opened.read(section.table_offset + 4 * partial, _CENTRE_BYTES * section.buckets)
    centres = np.frombuffer(data, "<f4").reshape(section.buckets, 3)
    ends = np.cumsum(np.concatenate([np.full(section.full_buckets, section.bucket_size, np.int64), lengths]))
    if section.count and (not len(ends) or ends[-1] < section.count):
        raise opened.invalid("has a section whose buckets hold fewer Gaussians than it")
    return ends, centres.astype(np.float64)


def _rest_order(degree: int) -> Int[np.ndarray, " D"]:
    """Return the place in a record of each value of (coefficient, channel): a band has all of R, then G, then B."""
    places, first = [], 0
    for band in range(1, degree + 1):
        width = 2 * band + 1
        places += [first + channel * width + i for i in range(width) for channel in range(3)]
        first += 3 * width
    return np.array(places, dtype=np.int64)


def _decode_rest(
    rows: Shaped[np.ndarray, " B"], order: Int[np.ndarray, " D"], headers: _Headers, out: Float32[np.ndarray, "B K 3"]
) -> None:
    width = len(order) // 3
    if not width:
        return
    values = rows["rest"][:, order].astype(np.float32)  # per coefficient, R, G, B
    if headers.level == 2:
        low, high = headers.sh_range
        values *= np.float32((high - low) / 255)
        values += np.float32(low)
    out[:, :width] = values.reshape(len(rows), width, 3)


FORMAT = Codec(sniff=_sniff, info=describe, read=read_ksplat)
