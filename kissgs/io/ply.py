"""The ``.ply`` format of 3DGS, and the compressed one of other tools."""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from kissgs.core.array_types import Float, Float32, Float64, Int64, Shaped, UInt32
from kissgs.core.context import Progress, silent
from kissgs.core.errors import InvalidSceneError, UnsupportedError
from kissgs.core.positions import WORLD, Origin, from_world, in_world, origin_for, world_positions
from kissgs.core.splats import BLOCK, SH_C0, SH_REST_COUNTS, Splats, blocks, concatenate, empty_splats, sampled_rows
from kissgs.io.conventions import (
    clamped,
    colors_of,
    insert_largest,
    morton_order,
    opacities_of,
    split_largest,
    to_codes,
)
from kissgs.io.files import BinaryWriter, listed, refuse_more_than
from kissgs.io.ply_rows import (
    BLOCK_ALIGNMENT,
    Element,
    Encoding,
    Header,
    PlyFile,
    check_complete,
    header_bytes,
    open_ply,
    rows,
    sh_degree,
)
from kissgs.io.scene_format import DEFAULT_READ_OPTIONS, Codec, Facts, Match, Notes, ReadOptions, titled

# PlayCanvas' compressed ``.ply``: Gaussians quantised to 16 bytes within chunks of 256, SH coefficients to one byte.
#
# Element ``chunk`` holds the bounds of each 256 Gaussians, ``vertex`` four packed words per Gaussian, and the optional
# ``sh`` their ``f_rest_*``. Older files have no colour bounds: their colours span 0 to 1.

_CHUNK = BLOCK_ALIGNMENT  # Gaussians per row of element chunk, given by the format; blocks of rows are multiples of it

PACKED = ("packed_position", "packed_rotation", "packed_scale", "packed_color")
"""Properties of element ``vertex``: one word each."""

_MAX_SCALE = 20.0  # bound of log-scales that a file holds, as the format's own tool has it


def check_compressed(ply: PlyFile) -> int:
    """Check everything except the values, without reading them, and return the scene's SH degree."""
    elements = ply.header.elements
    if ply.header.encoding == "ascii":
        raise UnsupportedError(f"{ply.name} is a compressed .ply in ascii; export it as binary")
    if "chunk" not in elements:
        raise ply.invalid("is a compressed .ply without element 'chunk'")
    vertex, chunk = elements["vertex"], elements["chunk"]
    _require(ply, vertex, PACKED, "u4")
    _require(ply, chunk, _bounds("", "xyz") + _bounds("scale_", "xyz"), "f4")
    if _has_colour_bounds(chunk):
        _require(ply, chunk, _bounds("", "rgb"), "f4")
    if chunk.count * _CHUNK < vertex.count:
        raise ply.invalid(f"has {chunk.count:,} chunks of {_CHUNK} for {vertex.count:,} Gaussians")
    degree = 0
    if "sh" in elements:
        degree = sh_degree(elements["sh"], ply.name)
        _require(ply, elements["sh"], tuple(f"f_rest_{i}" for i in range(3 * SH_REST_COUNTS[degree])), "u1")
        if elements["sh"].count != vertex.count:
            raise ply.invalid(f"has SH of {elements['sh'].count:,} for {vertex.count:,} Gaussians")
    for element in (chunk, vertex, *([elements["sh"]] if degree else [])):
        check_complete(ply, element)
    return degree


def read_compressed(ply: PlyFile, degree: int, progress: Progress) -> Splats:
    """Decode all Gaussians; ``degree`` is the result of :func:`check_compressed`. Opacities 0 and 1, which the packing
    can represent, become logits -inf and +inf."""
    vertex = ply.header.elements["vertex"]
    n, k = vertex.count, SH_REST_COUNTS[degree]
    splats = empty_splats(n, k)
    with np.errstate(all="ignore"):  # bounds may be any floats; values are not cleaned, as for any .ply
        _decode_vertices(ply, splats)
        progress("read", 1.0 if k == 0 else 0.5)
        if k:
            _decode_sh(ply, splats.shN)
            progress("read", 1.0)
    return replace(splats, antialiased=ply.header.antialiased)


def _decode_vertices(ply: PlyFile, splats: Splats) -> None:
    chunk = ply.header.elements["chunk"]
    none = np.empty(0, chunk.dtype(ply.header.encoding))  # so that a scene without chunks can be concatenated
    ranges = np.concatenate([none, *(block.copy() for block in rows(ply, chunk))])
    alpha = np.arange(256) / 255
    logits = -np.log(1 / alpha - 1)
    start = 0
    for block in rows(ply, ply.header.elements["vertex"]):
        part = slice(start, start + len(block))
        own = np.repeat(ranges[start // _CHUNK : -(-part.stop // _CHUNK)], _CHUNK)[: len(block)]
        splats.means[part] = _lerp(own, "", "xyz", _unpack_11_10_11(block["packed_position"]))
        splats.scales[part] = _lerp(own, "scale_", "xyz", _unpack_11_10_11(block["packed_scale"]))
        rotation = block["packed_rotation"]  # two bits: the largest component; ten bits for each of the others
        small = (np.stack([rotation >> shift & 1023 for shift in (20, 10, 0)], axis=1) / 1023 - 0.5) * np.sqrt(2)
        splats.quats[part] = insert_largest(small, (rotation >> 30).astype(np.int64))
        colour = np.stack([block["packed_color"] >> shift & 255 for shift in (24, 16, 8)], axis=1) / 255
        if _has_colour_bounds(chunk):
            colour = _lerp(own, "", "rgb", colour)
        splats.sh0[part] = (colour - 0.5) / SH_C0
        splats.opacities[part] = logits[block["packed_color"] & 255]
        start = part.stop


def _decode_sh(ply: PlyFile, shN: Float32[np.ndarray, "N K 3"]) -> None:
    k = shN.shape[1]
    # The encoder truncates (value / 8 + 0.5) * 256: decode to the middle of the step, except at both ends.
    values = ((np.arange(256) + 0.5) / 256 - 0.5) * 8
    values[[0, 255]] = -4, 4
    table = values.astype(np.float32)
    start = 0
    for block in rows(ply, ply.header.elements["sh"]):
        for i in range(3 * k):
            shN[start : start + len(block), i % k, i // k] = table[block[f"f_rest_{i}"]]
        start += len(block)


def _unpack_11_10_11(packed: UInt32[np.ndarray, " B"]) -> Float64[np.ndarray, "B 3"]:
    return np.stack([(packed >> 21) / 2047, (packed >> 11 & 1023) / 1023, (packed & 2047) / 2047], axis=1)


def _lerp(
    ranges: Shaped[np.ndarray, " B"], prefix: str, axes: str, t: Float64[np.ndarray, "B 3"]
) -> Float64[np.ndarray, "B 3"]:
    """Interpolate between the minima (at 0) and the maxima (at 1) of each row's chunk."""
    ends = np.stack([ranges[name] for name in _bounds(prefix, axes)], axis=1).astype(np.float64)
    return np.asarray(ends[:, :3] * (1 - t) + ends[:, 3:] * t)


def _bounds(prefix: str, axes: str) -> tuple[str, ...]:
    return tuple(f"{end}_{prefix}{axis}" for end in ("min", "max") for axis in axes)


def _has_colour_bounds(chunk: Element) -> bool:
    return any(p.name == "min_r" for p in chunk.properties)


def _require(ply: PlyFile, element: Element, names: tuple[str, ...], code: str) -> None:
    """Raise InvalidSceneError unless ``element`` has the properties ``names``, all of type ``code``."""
    codes = {p.name: p.code for p in element.properties}
    for name in names:
        if codes.get(name) != code:
            found = "none" if name not in codes else f"one of type {np.dtype(codes[name]).name}"
            raise ply.invalid(
                f"is a compressed .ply whose element {element.name!r} needs a property {name!r} of type "
                f"{np.dtype(code).name}, but has {found}"
            )


def write_compressed(file: BinaryWriter, splats: Splats, raw_axes: bool = False, progress: Progress = silent) -> Notes:
    """Write a scene in Morton order, so that the 256 Gaussians of a chunk are close to one another."""
    n, k = len(splats), splats.shN.shape[1]
    order = morton_order(splats.means)
    chunks = np.empty((-(-n // _CHUNK), 18), "<f4")
    words = np.empty((n, 4), "<u4")
    for part in blocks(n):  # each but the last has whole chunks
        own = slice(part.start // _CHUNK, -(-part.stop // _CHUNK))
        _encode_vertices(splats.select(order[part]), chunks[own], words[part])
        progress("write", part.stop / n / (2 if k else 1))
    bounds = [name for prefix, axes in (("", "xyz"), ("scale_", "xyz"), ("", "rgb")) for name in _bounds(prefix, axes)]
    lines = [f"element chunk {len(chunks)}", *(f"property float {name}" for name in bounds)]
    lines += [f"element vertex {n}", *(f"property uint {name}" for name in PACKED)]
    if k:
        lines += [f"element sh {n}", *(f"property uchar f_rest_{i}" for i in range(3 * k))]
    file.write(header_bytes(lines, splats.antialiased))
    file.write(chunks.tobytes())
    file.write(words.data if n else b"")
    for part in blocks(n if k else 0):
        # Truncated, not rounded: readers decode to the middle of a step.
        codes = np.floor((splats.shN[order[part]].transpose(0, 2, 1).astype(np.float64) / 8 + 0.5) * 256)
        file.write(np.clip(codes, 0, 255).astype(np.uint8).tobytes())
        progress("write", 0.5 + part.stop / n / 2)
    notes = clamped("scales", splats.scales, -_MAX_SCALE, _MAX_SCALE, f"e^±{_MAX_SCALE:.0f}")
    return (*notes, *clamped("view-dependent colours", splats.shN, -4, 4, "coefficients of ±4"))


def _encode_vertices(
    splats: Splats, chunks: Float32[np.ndarray, "chunks 18"], words: UInt32[np.ndarray, "B 4"]
) -> None:
    """Write the bounds of each chunk of these Gaussians, and their words."""
    scales = np.clip(splats.scales, -_MAX_SCALE, _MAX_SCALE)
    colors = colors_of(splats.sh0).astype(np.float32)
    positions, sizes, rgb = (
        _fractions(values, chunks[:, first : first + 6])
        for values, first in ((splats.means, 0), (scales, 6), (colors, 12))
    )
    words[:, 0] = _pack_11_10_11(positions)
    index, small = split_largest(splats.quats)
    fields = to_codes((small * np.sqrt(0.5) + 0.5) * 1023, 1023)
    words[:, 1] = index << 30 | fields[:, 0] << 20 | fields[:, 1] << 10 | fields[:, 2]
    words[:, 2] = _pack_11_10_11(sizes)
    alpha = to_codes(255 * opacities_of(splats.opacities))
    r, g, b = to_codes(255 * rgb).T
    words[:, 3] = r << 24 | g << 16 | b << 8 | alpha


def _fractions(
    values: Float32[np.ndarray, "B 3"], bounds: Float32[np.ndarray, "chunks 6"]
) -> Float64[np.ndarray, "B 3"]:
    """Write minima and maxima of each chunk to ``bounds``; return the values as fractions between them."""
    starts = np.arange(0, len(values), _CHUNK)
    bounds[:, :3] = np.minimum.reduceat(values, starts, axis=0)
    bounds[:, 3:] = np.maximum.reduceat(values, starts, axis=0)
    ends = np.repeat(bounds.astype(np.float64), _CHUNK, axis=0)[: len(values)]
    low, high = ends[:, :3], ends[:, 3:]
    return (values - low) / np.where(high > low, high - low, 1)


def _pack_11_10_11(fractions: Float[np.ndarray, "B 3"]) -> Int64[np.ndarray, " B"]:
    x, y, z = to_codes(fractions * (2047, 1023, 2047), 2047).T
    return x << 21 | y << 11 | z


# The 3DGS ``.ply``: read scenes of INRIA's trainer and other tools, write INRIA's layout.

_POSITION = ("x", "y", "z")
_NORMAL = ("nx", "ny", "nz")
_ROTATION = ("rot_0", "rot_1", "rot_2", "rot_3")
_SCALE = ("scale_0", "scale_1", "scale_2")
_OPACITY = ("opacity",)
_COLOUR = ("f_dc_0", "f_dc_1", "f_dc_2")
_RGB = ("red", "green", "blue")
_FILTER = "filter_3d"  # name of Mip-Splatting's property in lower case; its own spelling is filter_3D

_KNOWN = {*_POSITION, *_NORMAL, *_ROTATION, *_SCALE, *_OPACITY, *_COLOUR, *_RGB, "alpha", *PACKED}
"""Properties that are read or repeat what others say, as ``red`` does beside ``f_dc_0``; INRIA's normals are zero."""

_KNOWN_ELEMENTS = {
    *("vertex", "chunk", "sh", "camera", "extrinsic", "intrinsic", "image_size", "frame", "disparity", "color_space"),
    "version",
}
"""Elements that are read or say how the scene was taken, as those of PCL and SHARP do."""

_IN_TIME = re.compile(
    r"(\w+_)?(t|dt|tscale|time|temporal|trbf|motion|omega|vel|velocity|speed|dynamics|duration|lifespan|birth|death)(_\w+)?"
    r"|delta_([xyz]|rot)(_\w+)?|rot_[rl](_\w+)?|v[xyz]|scale_3|rot_[4-7]",
    re.IGNORECASE,
)
"""Properties that move or change Gaussians in time, of SpacetimeGaussians, 4DGS, 4D-Rotor and FreeTimeGS."""


@dataclass(frozen=True, slots=True, kw_only=True)
class PlyInfo:
    """Properties of a scene that the header of its file states."""

    count: int  # number of Gaussians
    sh_degree: int  # SH degree, 0 to 3
    encoding: Encoding  # encoding of the body, as the header names it
    compressed: bool  # whether it is PlayCanvas' compressed .ply
    antialiased: bool = False  # whether a comment of Brush or Postshot says that it was trained with antialiasing


def read_ply_info(source: Path | bytes, *, size: int | None = None) -> PlyInfo:
    """Read the header of a ``.ply`` and check it against the file's size, without reading the body.

    Args:
        source: A file, or the bytes of one; the beginning with the whole header is enough.
        size: Bytes of the whole file if ``source`` is only its beginning.

    Raises:
        InvalidSceneError: as for :func:`read_ply`, except for errors in the body.
        UnsupportedError: as for :func:`read_ply`.
    """
    with open_ply(source, size=size) as ply:
        return _check(ply)


def read_ply(
    source: Path | bytes, reading: ReadOptions = DEFAULT_READ_OPTIONS, threads: int = 0, progress: Progress = silent
) -> Splats:
    """Read a scene without cleaning it: NaN, infinities and quaternions of any length are kept. Reads binary and ascii
    files, with properties in any order and of any type, and PlayCanvas' compressed ``.ply``. 8-bit ``red``, ``green``,
    ``blue``, which nerfstudio may write instead of ``f_dc_*``, become the constant SH coefficients. The filters of
    Mip-Splatting, ``filter_3D``, are applied to scales and opacities. Elements and properties that are unknown are left
    out and named in ``notes``; bytes after the end are ignored. Needs some megabytes of memory besides the scene
    itself."""
    with open_ply(source) as ply:
        info = _check(ply)
        refuse_more_than(reading.max_gaussians, info.count, ply.name)
        progress("read", 0.0)
        read = read_compressed if info.compressed else _read_columns
        splats = read(ply, info.sh_degree, progress)
        return replace(splats, antialiased=info.antialiased, notes=(*_notes(ply.header), *splats.notes))


def read_ply_blocks(source: Path) -> Iterator[Splats]:
    """Yield a scene as :func:`read_ply` reads it, some 65,536 Gaussians at a time. PlayCanvas' compressed ``.ply``
    comes as one block. Errors are those of :func:`read_ply`; those of the body are raised when its block is reached."""
    with open_ply(source) as ply:
        info = _check(ply)
        if info.compressed:
            yield replace(read_compressed(ply, info.sh_degree, silent), notes=_notes(ply.header))
            return
        columns, waiting, done = _Columns(ply.header.elements["vertex"], info.encoding, info.sh_degree), [], 0
        origin = columns.origin(rows(ply, columns.vertex)) if columns.wide else WORLD
        for block in rows(ply, columns.vertex):
            waiting.append(columns.splats(block, origin))
            done += len(block)
            if sum(map(len, waiting)) >= 4 * BLOCK or done == info.count:
                notes = dict.fromkeys([*_notes(ply.header), *(note for each in waiting for note in each.notes)])
                yield replace(concatenate(waiting), antialiased=info.antialiased, notes=tuple(notes))
                waiting = []


def write_ply(
    file: BinaryWriter, splats: Splats, raw_axes: bool = False, progress: Progress = silent, comment: str = ""
) -> Notes:
    """Write ``splats`` in INRIA's layout: float32, little-endian, normals zero, the ``f_rest_*`` of the SH degree.
    Positions are those of the world: float64 (``property double``) where float32 cannot hold them. An antialiased scene
    is marked by a comment (:func:`kissgs.io.ply_rows.header_bytes`); ``comment`` is a further one."""
    splats = in_world(splats)
    wide = _POSITION if splats.origin != WORLD else ()
    n, k = len(splats), splats.shN.shape[1]
    rest_names = (f"f_rest_{i}" for i in range(3 * k))
    names = (*_POSITION, *_NORMAL, *_COLOUR, *rest_names, *_OPACITY, *_SCALE, *_ROTATION)
    properties = [f"property {'double' if name in wide else 'float'} {name}" for name in names]
    comments = [comment] * bool(comment)
    file.write(header_bytes([*comments, f"element vertex {n}", *properties], splats.antialiased))
    for step in blocks(n):
        part = splats.select(step)
        rest = part.shN.transpose(0, 2, 1).reshape(len(part), 3 * k)  # all of R, then G, then B
        normals, opacities = np.zeros_like(part.means), part.opacities[:, None]
        table = np.concatenate([part.means, normals, part.sh0, rest, opacities, part.scales, part.quats], axis=1)
        if wide:
            rows = np.empty(len(table), np.dtype([("positions", "<f8", 3), ("others", "<f4", table.shape[1] - 3)]))
            rows["positions"], rows["others"] = world_positions(part), table[:, 3:]
            table = rows
        file.write(table.astype(table.dtype.newbyteorder("<"), copy=False).data)
        progress("write", step.stop / n)
    return ()


def _check(ply: PlyFile) -> PlyInfo:
    """Check everything that does not need the body."""
    vertex = ply.header.elements.get("vertex")
    if vertex is None:
        raise InvalidSceneError(f"{ply.name} has no element 'vertex', so no Gaussians; name a trained 3DGS scene")
    compressed = any(p.name == PACKED[0] for p in vertex.properties)
    if compressed:
        degree = check_compressed(ply)
    else:
        _require_gaussians(ply.header, ply.name)
        degree = sh_degree(vertex, ply.name)
        check_complete(ply, vertex)
    encoding, antialiased = ply.header.encoding, ply.header.antialiased
    return PlyInfo(
        count=vertex.count, sh_degree=degree, encoding=encoding, compressed=compressed, antialiased=antialiased
    )


def _require_gaussians(header: Header, name: str) -> None:
    vertex = header.elements["vertex"]
    present = {p.name for p in vertex.properties}
    colour = () if _has_rgb(vertex) else _COLOUR
    missing = [p for p in (*_POSITION, *_OPACITY, *_SCALE, *_ROTATION, *colour) if p not in present]
    if present.isdisjoint({*_OPACITY, *_SCALE, *_ROTATION}):
        raise InvalidSceneError(
            f"{name} is a point cloud or a mesh, not a trained 3DGS scene: it has no {', '.join(missing)}; "
            "name the output of a 3DGS trainer"
        )
    moving = [p.name for p in vertex.properties if _IN_TIME.fullmatch(p.name) and p.name != "gps_time"]
    moving += [element for element in header.elements if element.startswith("delta_vertex")]
    if moving:
        raise UnsupportedError(
            f"{name} holds Gaussians that move or change in time ({listed(moving)}), which are not supported; export "
            "one moment of the scene as 3D Gaussians"
        )
    if missing == ["scale_2"]:
        raise UnsupportedError(f"{name} holds 2D Gaussians (no scale_2), which are not supported; train 3D Gaussians")
    if missing:
        raise InvalidSceneError(f"{name} has no {', '.join(missing)}; export the scene with all its properties")


def _notes(header: Header) -> tuple[str, ...]:
    """Return what becomes of properties and elements beyond those of 3D Gaussians."""
    names = [p.name for p in header.elements["vertex"].properties]
    known = re.compile(rf"f_rest_[0-9]+|(?i:{_FILTER})")
    unknown = [name for name in names if name not in _KNOWN and not known.fullmatch(name)]
    unknown += [f"element {e.name}" for e in header.elements.values() if e.count and e.name not in _KNOWN_ELEMENTS]
    notes = []
    if (name := _filter_of(header.elements["vertex"])) is not None:
        notes.append(f"the filters of Mip-Splatting ({name}) are applied to scales and opacities")
    if unknown:
        notes.append(f"left out: {listed(unknown)}")
    return tuple(notes)


def _filter_of(vertex: Element) -> str | None:
    """Return the name of the property with Mip-Splatting's filters, in any case; None without one."""
    return next((p.name for p in vertex.properties if p.name.lower() == _FILTER), None)


def _has_rgb(vertex: Element) -> bool:
    """Whether the colour is given only by 8-bit red, green, blue."""
    codes = {p.name: p.code for p in vertex.properties}
    return codes.keys().isdisjoint(_COLOUR) and all(codes.get(name) == "u1" for name in _RGB)


def _read_columns(ply: PlyFile, degree: int, progress: Progress) -> Splats:
    columns = _Columns(ply.header.elements["vertex"], ply.header.encoding, degree)
    count, start, positions = columns.vertex.count, 0, list[np.ndarray]()
    splats = empty_splats(count, SH_REST_COUNTS[degree])
    for block in rows(ply, columns.vertex):
        columns.copy(block, splats.select(slice(start, start + len(block))))
        if columns.wide:
            positions.append(_positions(block))
        start += len(block)
        progress("read", start / count)
    return from_world(splats, np.concatenate(positions)) if positions else splats


class _Columns:
    """The properties of a ``.ply`` that each array of a scene is read from."""

    def __init__(self, vertex: Element, encoding: Encoding, degree: int) -> None:
        self.vertex = vertex
        self._k = SH_REST_COUNTS[degree]
        self._rgb = _has_rgb(vertex)
        self._filter = _filter_of(vertex)
        types = {p.code for p in vertex.properties if p.name in _POSITION}
        self.wide = encoding == "ascii" or not types <= {"f4", "f2", "i1", "u1", "i2", "u2"}

    def origin(self, blocks: Iterable[np.ndarray]) -> Origin:
        """Return the origin of a scene whose positions may have more digits than float32."""
        if not self.vertex.count:
            return WORLD
        each = (np.column_stack([_positions(block), self.splats(block, WORLD).scales]) for block in blocks)
        some = sampled_rows(each, self.vertex.count)
        return origin_for(some[:, :3], some[:, 3:6].astype(np.float32))

    def splats(self, block: np.ndarray, origin: Origin) -> Splats:
        """Return the Gaussians of some rows, relative to ``origin``."""
        splats = empty_splats(len(block), self._k)
        self.copy(block, splats)
        return from_world(splats, _positions(block), origin) if self.wide else splats

    def copy(self, block: np.ndarray, out: Splats) -> None:
        """Copy rows to the arrays of ``out``, of the same length."""
        k, n = self._k, len(block)
        # f_rest_* has all coefficients of R, then G, then B; shN has R, G, B of the first, then of the second…
        rest = tuple(f"f_rest_{channel * k + i}" for i in range(k) for channel in range(3))
        groups = {
            _POSITION: out.means,
            _ROTATION: out.quats,
            _SCALE: out.scales,
            _OPACITY: out.opacities[:, None],
            (_RGB if self._rgb else _COLOUR): out.sh0,
            rest: out.shN.reshape(n, 3 * k),
        }
        with np.errstate(over="ignore", invalid="ignore"):  # float64 beyond float32 becomes infinite, as it should
            for names, array in groups.items():
                for i, name in enumerate(names):
                    array[:, i] = block[name]
        if self._rgb:
            colour = out.sh0
            colour /= 255
            colour -= 0.5
            colour /= np.float32(SH_C0)
        if self._filter is not None:
            _apply_filters(block[self._filter], out)


@np.errstate(all="ignore")  # values may be any floats; they are not cleaned here
def _apply_filters(filters: Shaped[np.ndarray, " N"], out: Splats) -> None:
    """Widen Gaussians by the standard deviations of their filters, and fade them as their volumes grow, in place. Only
    squares of the filters count: 0 changes nothing, and NaN makes a Gaussian NaN, which cleaning removes."""
    rows = np.flatnonzero(filters != 0)
    log_filters = np.log(np.abs(filters[rows].astype(np.float64)))[:, None]
    scales, logits = out.scales[rows].astype(np.float64), out.opacities[rows].astype(np.float64)
    out.scales[rows] = np.logaddexp(2 * scales, 2 * log_filters) / 2
    # the scale over the wider one is (1 + (filter / scale)²)^(-1/2), for any numbers without overflow
    log_opacities = -np.logaddexp(0, -logits) - np.logaddexp(0, 2 * (log_filters - scales)).sum(axis=1) / 2
    out.opacities[rows] = log_opacities - np.log(-np.expm1(log_opacities))


@np.errstate(invalid="ignore")  # signalling NaN
def _positions(block: np.ndarray) -> Float64[np.ndarray, "B 3"]:
    return np.stack([block[axis].astype(np.float64) for axis in _POSITION], axis=1)


def _sniff(head: bytes, size: int) -> Match:
    return Match.SURE if head[:3] == b"ply" and head[3:4].isspace() else Match.NO


def _describe(path: Path | bytes, level: int) -> Facts:
    found = read_ply_info(path)
    kinds = (found.encoding, "compressed" if found.compressed else "", "antialiased" if found.antialiased else "")
    details = {"encoding": found.encoding, "compressed": found.compressed, "antialiased": found.antialiased}
    return Facts(title=titled("3DGS scene", *kinds), count=found.count, sh_degree=found.sh_degree, details=details)


_WRITERS = {".ply": write_ply, ".compressed.ply": write_compressed}
FORMAT = Codec(sniff=_sniff, info=_describe, read=read_ply, write=_WRITERS)
