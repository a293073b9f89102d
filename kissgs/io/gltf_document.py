"""glTF files as documents: GLB and JSON, their buffers, and accessors as arrays, checked before memory is taken."""

from __future__ import annotations

import base64
import binascii
import struct
import unicodedata
import urllib.parse
from pathlib import Path
from typing import Any

import numpy as np

from kissgs.core.array_types import Float64, Shaped
from kissgs.core.errors import InvalidSceneError, UnsupportedError
from kissgs.io.containers import is_below
from kissgs.io.conventions import Signs
from kissgs.io.files import SceneFile, open_scene_file, parse_json, whole_number

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
