"""PlayCanvas' compressed ``.ply``: Gaussians quantised to 16 bytes within chunks of 256, SH coefficients to one byte.

Element ``chunk`` holds the bounds of each 256 Gaussians, ``vertex`` four packed words per Gaussian, and the optional
``sh`` their ``f_rest_*``. Older files have no colour bounds: their colours span 0 to 1.
"""

from __future__ import annotations

import numpy as np

from kissgs.core.array_types import Float32, Float64, Shaped, UInt32
from kissgs.core.errors import InvalidSceneError, UnsupportedError
from kissgs.core.progress import Progress
from kissgs.core.splats import SH_C0, SH_REST_COUNTS, Splats, empty_splats
from kissgs.io.activations import insert_largest
from kissgs.io.ply_body import BLOCK_ALIGNMENT, check_complete, rows
from kissgs.io.ply_header import Element, Header, PlyFile, sh_degree

_CHUNK = BLOCK_ALIGNMENT
"""Gaussians per row of element ``chunk``, given by the format; blocks of rows are multiples of it."""

_PACKED = ("packed_position", "packed_rotation", "packed_scale", "packed_color")


def is_compressed(header: Header) -> bool:
    """Whether the file is a PlayCanvas compressed ``.ply``."""
    vertex = header.elements.get("vertex")
    return vertex is not None and any(p.name == "packed_position" for p in vertex.properties)


def check_compressed(ply: PlyFile) -> int:
    """Check everything except the values, without reading them, and return the scene's SH degree.

    Raises:
        InvalidSceneError: an element or property is missing or of another type, the elements' counts are inconsistent,
            or the file is cut short.
        UnsupportedError: the file is ascii, which no tool writes.
    """
    elements = ply.header.elements
    if ply.header.encoding == "ascii":
        raise UnsupportedError(f"{ply.name} is a compressed .ply in ascii; export it as binary")
    if "chunk" not in elements:
        raise InvalidSceneError(f"{ply.name} is a compressed .ply without element 'chunk'; export it again")
    vertex, chunk = elements["vertex"], elements["chunk"]
    _require(ply, vertex, _PACKED, "u4")
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
    return splats


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
