"""PlayCanvas' compressed ``.ply``: Gaussians quantised to 16 bytes within chunks of 256, SH coefficients to one byte.

Element ``chunk`` holds the bounds of each 256 Gaussians, ``vertex`` four packed words per Gaussian, and the optional
``sh`` their ``f_rest_*``. Older files have no colour bounds: their colours span 0 to 1.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from kissgs.core.array_types import Float, Float32, Float64, Int64, Shaped, UInt32
from kissgs.core.errors import InvalidSceneError, UnsupportedError
from kissgs.core.progress import Progress, silent
from kissgs.core.splats import SH_C0, SH_REST_COUNTS, Splats, empty_splats
from kissgs.io.conventions import (
    colors_of,
    insert_largest,
    morton_order,
    note_clamped,
    opacities_of,
    split_largest,
    steps,
    to_codes,
)
from kissgs.io.files import BinaryWriter
from kissgs.io.ply_rows import BLOCK_ALIGNMENT, MIP_COMMENT, Element, Header, PlyFile, check_complete, rows, sh_degree

_CHUNK = BLOCK_ALIGNMENT
"""Gaussians per row of element ``chunk``, given by the format; blocks of rows are multiples of it."""

PACKED = ("packed_position", "packed_rotation", "packed_scale", "packed_color")
"""Properties of element ``vertex``: one word each."""

_HALVES = (slice(0, 3), slice(3, 6))
"""Columns of minima and of maxima among the six bounds of an attribute."""

_MAX_SCALE = 20.0
"""Bound of log-scales that a file holds, as the format's own tool has it."""


def is_compressed(header: Header) -> bool:
    """Whether the file is a PlayCanvas compressed ``.ply``."""
    vertex = header.elements.get("vertex")
    return vertex is not None and any(p.name == "packed_position" for p in vertex.properties)


def check_compressed(ply: PlyFile) -> int:
    """Check everything except the values, without reading them, and return the scene's SH degree."""
    elements = ply.header.elements
    if ply.header.encoding == "ascii":
        raise UnsupportedError(f"{ply.name} is a compressed .ply in ascii; export it as binary")
    if "chunk" not in elements:
        raise InvalidSceneError(f"{ply.name} is a compressed .ply without element 'chunk'; export it again")
    vertex, chunk = elements["vertex"], elements["chunk"]
    _require(ply, vertex, PACKED, "u4")
    _require(ply, chunk, _bounds("", "xyz") + _bounds("scale_", "xyz"), "f4")
    if _has_colour_bounds(chunk):
        _require(ply, chunk, _bounds("", "rgb"), "f4")
    if chunk.count * _CHUNK < vertex.count:
        raise InvalidSceneError(
            f"{ply.name} has {chunk.count:,} chunks of {_CHUNK} for {vertex.count:,} Gaussians; export it again"
        )
    degree = 0
    if "sh" in elements:
        degree = sh_degree(elements["sh"], ply.name)
        _require(ply, elements["sh"], tuple(f"f_rest_{i}" for i in range(3 * SH_REST_COUNTS[degree])), "u1")
        if elements["sh"].count != vertex.count:
            raise InvalidSceneError(
                f"{ply.name} has SH of {elements['sh'].count:,} for {vertex.count:,} Gaussians; export it again"
            )
    for element in (chunk, vertex, *([elements["sh"]] if degree else [])):
        check_complete(ply, element)
    return degree


def read_compressed(ply: PlyFile, degree: int, progress: Progress) -> Splats:
    """Decode all Gaussians; ``degree`` is the result of :func:`check_compressed`.

    Opacities 0 and 1, which the packing can represent, become logits -inf and +inf.
    """
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
        splats.quats[part] = _unpack_quats(block["packed_rotation"])
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


def _unpack_quats(packed: UInt32[np.ndarray, " B"]) -> Float64[np.ndarray, "B 4"]:
    """Unpack smallest-three quaternions: two bits for the index of the largest component, 10 for each of the others."""
    small = (np.stack([packed >> shift & 1023 for shift in (20, 10, 0)], axis=1) / 1023 - 0.5) * np.sqrt(2)
    return insert_largest(small, (packed >> 30).astype(np.int64))


def _lerp(
    ranges: Shaped[np.ndarray, " B"], prefix: str, axes: str, t: Float64[np.ndarray, "B 3"]
) -> Float64[np.ndarray, "B 3"]:
    """Interpolate between the minima (at 0) and the maxima (at 1) of each row's chunk."""
    names = _bounds(prefix, axes)
    low = np.stack([ranges[name] for name in names[:3]], axis=1).astype(np.float64)
    high = np.stack([ranges[name] for name in names[3:]], axis=1).astype(np.float64)
    values: Float64[np.ndarray, "B 3"] = low * (1 - t) + high * t
    return values


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
            raise InvalidSceneError(
                f"{ply.name} is a compressed .ply whose element {element.name!r} needs a property {name!r} of type "
                f"{np.dtype(code).name}, but has {found}; export it again"
            )


def write_compressed(file: BinaryWriter, splats: Splats, *, progress: Progress = silent) -> tuple[str, ...]:
    """Write a clean scene in Morton order, so that the 256 Gaussians of a chunk are close to one another."""
    n, k = len(splats), splats.shN.shape[1]
    order = morton_order(splats.means)
    chunks = np.empty((-(-n // _CHUNK), 18), "<f4")
    words = np.empty((n, 4), "<u4")
    for part in steps(n):  # each but the last has whole chunks
        own = slice(part.start // _CHUNK, -(-part.stop // _CHUNK))
        _encode_vertices(splats.select(order[part]), chunks[own], words[part])
        progress("write", part.stop / n / (2 if k else 1))
    file.write(_header(n, len(chunks), 3 * k, splats.antialiased))
    file.write(chunks.tobytes())
    file.write(words.data if n else b"")
    for part in steps(n if k else 0):
        # Truncated, not rounded: readers decode to the middle of a step.
        codes = np.floor((splats.shN[order[part]].transpose(0, 2, 1).astype(np.float64) / 8 + 0.5) * 256)
        file.write(np.clip(codes, 0, 255).astype(np.uint8).tobytes())
        progress("write", 0.5 + part.stop / n / 2)
    notes: list[str] = []
    note_clamped(notes, "scales", splats.scales, -_MAX_SCALE, _MAX_SCALE, f"e^±{_MAX_SCALE:.0f}")
    note_clamped(notes, "view-dependent colours", splats.shN, -4, 4, "coefficients of ±4")
    return tuple(notes)


def _header(count: int, chunks: int, rest: int, antialiased: bool) -> bytes:
    bounds = [name for prefix, axes in (("", "xyz"), ("scale_", "xyz"), ("", "rgb")) for name in _bounds(prefix, axes)]
    lines = ["ply", "format binary_little_endian 1.0", *[MIP_COMMENT] * antialiased, f"element chunk {chunks}"]
    lines += [f"property float {name}" for name in bounds]
    lines += [f"element vertex {count}", *(f"property uint {name}" for name in PACKED)]
    if rest:
        lines += [f"element sh {count}", *(f"property uchar f_rest_{i}" for i in range(rest))]
    return "\n".join([*lines, "end_header\n"]).encode("ascii")


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
    low, high = (np.repeat(bounds[:, half].astype(np.float64), _CHUNK, axis=0)[: len(values)] for half in _HALVES)
    return (values - low) / np.where(high > low, high - low, 1)


def _pack_11_10_11(fractions: Float[np.ndarray, "B 3"]) -> Int64[np.ndarray, " B"]:
    x, y, z = to_codes(fractions * (2047, 1023, 2047), 2047).T
    return x << 21 | y << 11 | z
