"""glTF files as documents, checked before memory is taken; and ``.glb`` files with one primitive of Gaussians."""

from __future__ import annotations

import base64
import binascii
import io
import json
import struct
import unicodedata
import urllib.parse
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from kissgs.core.array_types import Float32, Float64, Shaped
from kissgs.core.errors import InvalidSceneError, UnsupportedError
from kissgs.core.positions import WORLD, Origin
from kissgs.core.progress import Progress, silent
from kissgs.core.splats import Splats
from kissgs.io.containers import is_below
from kissgs.io.conventions import Signs, colors_of, note_mark, opacities_of, sh_signs, steps, to_bytes
from kissgs.io.files import BinaryWriter, SceneFile, open_scene_file, parse_json, whole_number
from kissgs.io.spz import decode_positions, encode_positions, fractional_bits_for, write_spz

# glTF files as documents: GLB and JSON, their buffers, and accessors as arrays, checked before memory is taken.

GLB_MAGIC = b"glTF"

EXTENSION = "KHR_gaussian_splatting"
SPZ_EXTENSIONS = ("KHR_gaussian_splatting_compression_spz_2", "KHR_gaussian_splatting_compression_spz")

TO_PLY: Signs = (-1, -1, 1)
"""Signs from glTF's axes to those of a ``.ply``."""

MAX_JSON_BYTES = 1 << 22
"""Largest size of the JSON in a GLB; a primitive of a scene takes some kilobytes."""

MAX_GLTF_BYTES = 1 << 30
"""Largest size of a ``.gltf``, whose buffers may be text inside it."""

_GLB_HEADER = struct.Struct("<4sII")
_CHUNK_HEADER = struct.Struct("<I4s")

_DTYPES = {5120: "<i1", 5121: "<u1", 5122: "<i2", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
_MAX_STRIDE = 252
"""Largest distance of rows, given by the format."""

_WIDTHS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4}


class Document:
    """Parsed glTF file. Its methods raise InvalidSceneError for whatever contradicts the format.

    The binary part of a GLB is read when it is needed, one buffer view at a time: the file must still be open.
    """

    def __init__(self, opened: SceneFile, folder: Path | None) -> None:
        self.name, self._folder = opened.name, folder
        text, self._binary = _split(opened)
        self._opened = opened
        self.root = parse_json(text, f"{self.name}, read as glTF,", error=InvalidSceneError)
        if not isinstance(self.root, dict):
            raise self.invalid("its JSON is no object")
        self._buffers: dict[int, bytes] = {}
        self._lists: dict[str, list[dict[str, Any]]] = {}

    def invalid(self, problem: str) -> InvalidSceneError:
        """Return the error of a file that contradicts the format."""
        return InvalidSceneError(f"{self.name} is not valid glTF: {problem}; export it again")

    def items(self, key: str, parent: dict[str, Any] | None = None) -> list[dict[str, Any]]:
        """Return a list of objects, empty if the document has none."""
        if parent is None and key in self._lists:  # checked before; nodes and accessors are asked for one by one
            return self._lists[key]
        found = (self.root if parent is None else parent).get(key, [])
        if not isinstance(found, list) or not all(isinstance(item, dict) for item in found):
            raise self.invalid(f"{key} is not a list of objects")
        if parent is None:
            self._lists[key] = found
        return found

    def item(self, key: str, index: object) -> dict[str, Any]:
        """Return one object of a list by its index."""
        found = self.items(key)
        if not isinstance(index, int) or isinstance(index, bool) or not 0 <= index < len(found):
            raise self.invalid(f"it names {key}[{str(index)[:20]!r}] of {len(found)}")
        return found[index]

    def child(self, parent: dict[str, Any], key: str) -> dict[str, Any]:
        """Return an object inside an object, empty if there is none."""
        found = parent.get(key, {})
        if not isinstance(found, dict):
            raise self.invalid(f"{key} is not an object")
        return found

    def whole(self, parent: dict[str, Any], key: str, default: int = 0) -> int:
        """Return a whole number that is not negative."""
        found = whole_number(parent.get(key, default), 0, (1 << 53) - 1)
        if found is None:
            raise self.invalid(f"{key} is not a whole number")
        return found

    def count(self, index: object) -> int:
        """Return the number of elements of an accessor."""
        return self.whole(self.item("accessors", index), "count", -1)

    def accessor(self, index: object, width: int, what: str) -> Shaped[np.ndarray, "N C"]:
        """Return an accessor as a view of its buffer, ``width`` columns of the type in the file."""
        accessor = self.item("accessors", index)
        if "sparse" in accessor or "bufferView" not in accessor:
            raise UnsupportedError(f"{self.name} has sparse or empty data for {what}; export it without")
        kind, code = accessor.get("type"), accessor.get("componentType")
        if not isinstance(kind, str) or _WIDTHS.get(kind) != width or not isinstance(code, int) or code not in _DTYPES:
            raise self.invalid(f"{what} is {str(kind)[:20]!r} of component type {str(code)[:20]!r}")
        dtype, count = np.dtype(_DTYPES[code]), self.whole(accessor, "count", -1)
        offset, row = self.whole(accessor, "byteOffset"), dtype.itemsize * width
        stride = self.whole(self.item("bufferViews", accessor["bufferView"]), "byteStride") or row
        if count and not row <= stride <= max(row, _MAX_STRIDE):
            raise self.invalid(f"{what} has rows of {row} bytes every {stride:,}")
        if not count:
            return np.empty((0, width), dtype)
        data = self.view(accessor["bufferView"], offset, stride * (count - 1) + row)
        return np.ndarray((count, width), dtype, data, 0, (stride, dtype.itemsize))

    def numbers(self, index: object, width: int, what: str) -> Shaped[np.ndarray, "N C"]:
        """Return an accessor as floats; normalised integers become fractions of their largest value."""
        values = self.accessor(index, width, what)
        if values.dtype.kind == "f" or not self.item("accessors", index).get("normalized", False):
            return values
        if values.dtype.itemsize > 2:
            raise self.invalid(f"{what} is normalised, but not of 8 or 16 bits")
        return np.maximum(values.astype(np.float32) / np.float32(np.iinfo(values.dtype).max), np.float32(-1))

    def view(self, index: object, first: int = 0, length: int | None = None, *, most: int | None = None) -> memoryview:
        """Return bytes of a buffer view: ``length`` from ``first``, or all, but at most ``most``."""
        view = self.item("bufferViews", index)
        offset, size = self.whole(view, "byteOffset"), self.whole(view, "byteLength", -1)
        wanted = size - first if length is None else length
        if not 0 <= wanted <= size - first:
            raise self.invalid("an accessor needs more bytes than its buffer view has")
        wanted = wanted if most is None else min(wanted, most)
        buffer, number = self.item("buffers", view.get("buffer")), int(str(view.get("buffer")))
        uri = buffer.get("uri")
        inside = self._binary if uri is None and number == 0 else None
        if inside is None and number not in self._buffers:
            self._buffers[number] = self._load(
                uri, number, self.child(buffer, "extensions") | self.child(view, "extensions")
            )
        if offset + size > (len(self._buffers[number]) if inside is None else inside[1]):
            raise self.invalid("a buffer view reaches beyond its buffer")
        if inside is None:
            return memoryview(self._buffers[number])[offset + first :][:wanted]
        return memoryview(self._opened.read(inside[0] + offset + first, wanted))

    def _load(self, uri: object, index: int, extensions: dict[str, Any]) -> bytes:
        """Return the bytes of a buffer: text in the JSON, or a file beside the scene."""
        if uri is None and extensions:  # the buffer stands for one that has to be decompressed
            raise UnsupportedError(f"{self.name} is compressed by {next(iter(extensions))[:60]!r}; export it without")
        if not isinstance(uri, str):
            raise self.invalid(f"buffers[{index}] has no data")
        if uri.startswith("data:"):
            head, _, body = uri.partition(",")
            try:
                encoded = head.endswith(";base64")
                return base64.b64decode(body, validate=True) if encoded else urllib.parse.unquote_to_bytes(body)
            except (binascii.Error, ValueError) as error:
                raise self.invalid(f"buffers[{index}].uri is not base64") from error
        path = urllib.parse.unquote(uri)
        if not is_below(path) or not path.isprintable():
            raise UnsupportedError(f"{self.name} names a buffer outside its folder; put the file beside it")
        if self._folder is None:
            raise UnsupportedError(f"{self.name} needs the file {path[:80]!r} beside it; give the path, or a .glb")
        with open_scene_file(_beside(self._folder / path), "put the buffer there") as opened:
            return opened.read(0, opened.size)


def _beside(path: Path) -> Path:
    """Return the file of this name, or else the one whose name differs in its Unicode form only."""
    if path.exists() or not path.parent.is_dir():
        return path
    name = unicodedata.normalize("NFC", path.name)
    return next((entry for entry in path.parent.iterdir() if unicodedata.normalize("NFC", entry.name) == name), path)


def _split(opened: SceneFile) -> tuple[bytes, tuple[int, int] | None]:
    """Return the JSON, and where the binary part of a GLB begins and how long it is."""
    if opened.size < _GLB_HEADER.size or opened.read(0, 4) != GLB_MAGIC:
        if opened.size > MAX_GLTF_BYTES:
            raise UnsupportedError(f"{opened.name} has {opened.size:,} bytes of text; export it as .glb")
        return opened.read(0, opened.size), None
    _, version, length = _GLB_HEADER.unpack(opened.read(0, _GLB_HEADER.size))
    if version != 2:
        raise UnsupportedError(f"{opened.name} is GLB of version {version}; version 2 is read")
    if length > opened.size:
        raise opened.cut_short(length)
    text, offset = None, _GLB_HEADER.size
    while offset + _CHUNK_HEADER.size <= length:
        size, kind = _CHUNK_HEADER.unpack(opened.read(offset, _CHUNK_HEADER.size))
        offset += _CHUNK_HEADER.size
        if text is None:
            if kind != b"JSON" or size > MAX_JSON_BYTES:
                raise InvalidSceneError(f"{opened.name} is not valid GLB: its first chunk is not JSON; export it again")
            text = opened.read(offset, size)
        elif kind == b"BIN\0":
            if offset + size > opened.size:
                raise opened.cut_short(offset + size)
            return text, (offset, size)
        offset += size
    if text is None:
        raise opened.cut_short(offset + _CHUNK_HEADER.size)
    return text, None


def node_matrix(document: Document, node: dict[str, Any]) -> Float64[np.ndarray, "4 4"]:
    """Return the transform of a node, from its matrix or its translation, rotation and scale."""
    if "matrix" in node:
        return _vector(document, node, "matrix", 16, None).reshape(4, 4).T
    shift = _vector(document, node, "translation", 3, (0, 0, 0))
    x, y, z, w = _vector(document, node, "rotation", 4, (0, 0, 0, 1))
    matrix = np.eye(4)
    matrix[:3, :3] = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    matrix[:3, :3] *= _vector(document, node, "scale", 3, (1, 1, 1))
    matrix[:3, 3] = shift
    return matrix


def _vector(
    document: Document, node: dict[str, Any], key: str, count: int, default: tuple[int, ...] | None
) -> Float64[np.ndarray, " count"]:
    values = node.get(key, default)
    valid = isinstance(values, list | tuple) and len(values) == count
    if not valid or not all(
        isinstance(v, int | float) and not isinstance(v, bool) and abs(v) < 1e30 for v in values or ()
    ):
        raise document.invalid(f"a node's {key} is not {count} numbers")
    return np.array(values, dtype=np.float64)


# Writing of ``.glb``: one primitive with ``KHR_gaussian_splatting``, all attributes as floats or as ``.spz`` inside.
#
# In the form of floats, colours and opacities are also there as ``COLOR_0``, so that programs without the extension
# show coloured points.

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
