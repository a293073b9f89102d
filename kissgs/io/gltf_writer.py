"""Writing of ``.glb``: one primitive with ``KHR_gaussian_splatting``, all attributes as floats or as ``.spz`` inside.

In the form of floats, colours and opacities are also there as ``COLOR_0``, so that programs without the extension show
coloured points.
"""

from __future__ import annotations

import io
import json
import struct
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np

from kissgs.core.array_types import Float32, Float64, Shaped
from kissgs.core.errors import UnsupportedError
from kissgs.core.origin import WORLD, Origin
from kissgs.core.progress import Progress, silent
from kissgs.core.splats import Splats
from kissgs.io.conventions import colors_of, note_mark, opacities_of, sh_signs, steps, to_bytes
from kissgs.io.files import BinaryWriter
from kissgs.io.gltf_document import EXTENSION, GLB_MAGIC, SPZ_EXTENSIONS, TO_PLY
from kissgs.io.spz import decode_positions, encode_positions, fractional_bits_for, write_spz

_FLOAT, _BYTE, _ARRAY_BUFFER, _POINTS = 5126, 5121, 34962, 0
_TYPES = {1: "SCALAR", 3: "VEC3", 4: "VEC4"}
_MAX_BYTES = (1 << 32) - 1
"""Largest GLB: its header has 32 bits for the size."""

_NOT_IN_SPZ = (f"{EXTENSION}:OPACITY", f"{EXTENSION}:SH_DEGREE_0_COEF_0")
"""Attributes that the extension for ``.spz`` gives no source: there, ``COLOR_0`` is colour and opacity."""


@dataclass(frozen=True, slots=True)
class _Attribute:
    """Attribute of the primitive: its columns, and the values of some rows."""

    name: str
    width: int
    values: Callable[[slice], Shaped[np.ndarray, "B width"]]
    is_byte: bool = False

    @property
    def row_bytes(self) -> int:
        return self.width if self.is_byte else 4 * self.width


def write_glb(file: BinaryWriter, splats: Splats, *, progress: Progress = silent) -> tuple[str, ...]:
    """Write a clean scene in glTF's axes (x left, y up, z forward); return what the format cannot hold."""
    count = _count(splats, ".glb")
    attributes = list(_attributes(splats))
    body = count * sum(attribute.row_bytes for attribute in attributes)
    ends = np.stack([splats.means.min(axis=0), splats.means.max(axis=0)]) * np.array(TO_PLY, np.float32)
    views, start = list[dict[str, Any]](), 0
    for attribute in attributes:
        length = count * attribute.row_bytes
        views.append({"buffer": 0, "byteOffset": start, "byteLength": length, "target": _ARRAY_BUFFER})
        start += length
    accessors = _accessors(count, attributes, ends)
    for i, accessor in enumerate(accessors):
        accessor["bufferView"] = i
    _write_head(file, count, _json(attributes, accessors, views, {}, splats.origin), body)
    for done, attribute in enumerate(attributes, 1):
        dtype = np.uint8 if attribute.is_byte else "<f4"
        for part in steps(count):
            file.write(attribute.values(part).astype(dtype).tobytes())
        progress("write", done / len(attributes))
    notes: list[str] = []
    note_mark(notes, splats.antialiased)
    return tuple(notes)


def write_spz_glb(file: BinaryWriter, splats: Splats, *, progress: Progress = silent) -> tuple[str, ...]:
    """Write a clean scene as ``.spz`` inside ``.glb``; return what the format cannot hold, one phrase each.

    The ``.spz`` has its own axes (x right, y up, z back), as the extension wants it, whose text has the library of
    ``.spz`` turn them from and to those of glTF. Accessors have types and counts, and no data.
    """
    count = _count(splats, ".glb")
    packed = io.BytesIO()  # its size stands before it
    notes = write_spz(packed, splats, progress=progress)
    body = packed.getbuffer()
    bits = fractional_bits_for(float(np.abs(splats.means).max()))
    ends = np.empty((2, 3), np.float32)  # as they are read: in steps
    decode_positions(encode_positions(np.stack([splats.means.min(axis=0), splats.means.max(axis=0)]), bits), bits, ends)
    attributes = [attribute for attribute in _attributes(splats) if attribute.name not in _NOT_IN_SPZ]
    view = {"buffer": 0, "byteOffset": 0, "byteLength": len(body)}
    accessors = _accessors(count, attributes, ends * np.array(TO_PLY, np.float32))
    compression = {SPZ_EXTENSIONS[0]: {"bufferView": 0}}
    _write_head(file, count, _json(attributes, accessors, [view], compression, splats.origin), len(body))
    file.write(body)
    file.write(bytes(-len(body) % 4))
    return notes


def _in_gltf(origin: Origin) -> list[float]:
    return [sign * value + 0.0 for sign, value in zip(TO_PLY, origin, strict=True)]


def _count(splats: Splats, ending: str) -> int:
    """Return the number of Gaussians."""
    if not len(splats):
        raise UnsupportedError(f"a scene without Gaussians cannot be written as {ending}; write it as .ply")
    return len(splats)


def _write_head(file: BinaryWriter, count: int, text: bytes, body: int) -> None:
    """Write all that stands before the ``body`` bytes of the buffer."""
    body += -body % 4
    size = 12 + 8 + len(text) + 8 + body
    if size > _MAX_BYTES:
        raise UnsupportedError(f"{count:,} Gaussians take {size:,} bytes, and .glb ends at 4 GiB; write .spz or .ply")
    file.write(struct.pack("<4sII", GLB_MAGIC, 2, size) + struct.pack("<I4s", len(text), b"JSON") + text)
    file.write(struct.pack("<I4s", body, b"BIN\0"))


def _attributes(splats: Splats) -> Iterator[_Attribute]:
    """Yield all attributes in glTF's axes, half a turn about z from those of a ``.ply``."""
    axes = np.array(TO_PLY, np.float32)
    yield _Attribute("POSITION", 3, lambda part: splats.means[part] * axes)
    yield _Attribute("COLOR_0", 4, lambda part: _linear_colors(splats, part), is_byte=True)
    # Half a turn of the Gaussian about its own axis precedes: the reader has the reason.
    turned = np.array([-1, 1, 1, -1], np.float32)
    yield _Attribute(f"{EXTENSION}:ROTATION", 4, lambda part: splats.quats[part][:, [2, 1, 0, 3]] * turned)
    yield _Attribute(f"{EXTENSION}:SCALE", 3, lambda part: np.exp(splats.scales[part].astype(np.float64)))
    yield _Attribute(f"{EXTENSION}:OPACITY", 1, lambda part: opacities_of(splats.opacities[part])[:, None])
    yield _Attribute(f"{EXTENSION}:SH_DEGREE_0_COEF_0", 3, lambda part: splats.sh0[part])
    bands = [(band, i) for band in range(1, splats.sh_degree + 1) for i in range(2 * band + 1)]
    for k, (band, i) in enumerate(bands):
        name = f"{EXTENSION}:SH_DEGREE_{band}_COEF_{i}"
        yield _Attribute(name, 3, partial(_sh_values, splats, k))


def _sh_values(splats: Splats, k: int, part: slice) -> Float32[np.ndarray, "B 3"]:
    """Return one coefficient beyond the constant one."""
    values: Float32[np.ndarray, "B 3"] = splats.shN[part, k] * sh_signs(TO_PLY, k + 1)[k]
    return values


def _linear_colors(splats: Splats, part: slice) -> Float64[np.ndarray, "B 4"]:
    """Return linear colours and opacities as bytes; glTF's vertex colours are linear."""
    srgb = np.clip(colors_of(splats.sh0[part]), 0, 1)
    linear = np.where(srgb <= 0.04045, srgb / 12.92, ((srgb + 0.055) / 1.055) ** 2.4)
    rgba = np.concatenate([linear, opacities_of(splats.opacities[part])[:, None]], axis=1)
    return to_bytes(255 * rgba).astype(np.float64)


def _accessors(count: int, attributes: list[_Attribute], ends: Float32[np.ndarray, "2 3"]) -> list[dict[str, Any]]:
    """Return the accessors without their buffer views; ``ends`` are opposite corners of all positions."""
    accessors: list[dict[str, Any]] = []
    for attribute in attributes:
        component = {"componentType": _BYTE, "normalized": True} if attribute.is_byte else {"componentType": _FLOAT}
        accessors.append({**component, "count": count, "type": _TYPES[attribute.width]})
    accessors[0] |= {"min": ends.min(axis=0).tolist(), "max": ends.max(axis=0).tolist()}
    return accessors


def _json(
    attributes: list[_Attribute],
    accessors: list[dict[str, Any]],
    views: list[dict[str, Any]],
    compression: dict[str, Any],
    origin: Origin,
) -> bytes:
    """Return the JSON, filled up with spaces to a multiple of four bytes.

    ``compression`` holds the extension without which the accessors have no data; it is empty where they have it. The
    node moves positions to the world from ``origin``.
    """
    splatting: dict[str, Any] = {
        "kernel": "ellipse",
        "colorSpace": "srgb_rec709_display",
        "projection": "perspective",
        "sortingMethod": "cameraDistance",
    }
    required: dict[str, Any] = {}
    if compression:
        splatting["extensions"] = compression
        required["extensionsRequired"] = [EXTENSION, *compression]
    primitive = {
        "mode": _POINTS,
        "attributes": {attribute.name: i for i, attribute in enumerate(attributes)},
        "extensions": {EXTENSION: splatting},
    }
    root = {
        "asset": {"version": "2.0", "generator": "kissgs"},
        "extensionsUsed": [EXTENSION, *compression],
        **required,
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0, **({} if origin == WORLD else {"translation": _in_gltf(origin)})}],
        "meshes": [{"primitives": [primitive]}],
        "accessors": accessors,
        "bufferViews": views,
        "buffers": [{"byteLength": sum(view["byteLength"] for view in views)}],
    }
    text = json.dumps(root, separators=(",", ":")).encode("ascii")
    return text + b" " * (-len(text) % 4)
