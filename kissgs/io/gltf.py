"""glTF with ``KHR_gaussian_splatting``: GLB or JSON; also with the attributes in ``.spz`` inside it. All primitives of
the scene's nodes are read, moved by the nodes' transforms and turned from glTF's axes (x left, y up, z forward) to
those of a ``.ply``; ``.glb`` is written with one primitive."""

from __future__ import annotations

import base64
import io
import json
import struct
import urllib.parse
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from kissgs.core.array_types import Float32, Float64, Shaped, UInt8
from kissgs.core.context import Progress, silent
from kissgs.core.errors import InvalidSceneError, UnsupportedError
from kissgs.core.positions import WORLD, from_world, origin_for
from kissgs.core.splats import ATTRIBUTES, SH_REST_COUNTS, Splats, blocks, empty_splats
from kissgs.io import spz as spz_format
from kissgs.io.containers import is_file_name
from kissgs.io.conventions import (
    Signs,
    colors_of,
    log_scales,
    marks_left_out,
    mirror,
    move,
    opacities_of,
    opacity_logits,
    refuse_empty,
    sh_signs,
    to_bytes,
)
from kissgs.io.files import (
    BinaryWriter,
    SceneFile,
    is_number,
    listed,
    marked,
    open_scene_file,
    parse_json,
    refuse_degree,
    refuse_more_than,
    whole_number,
)
from kissgs.io.scene_format import DEFAULT_READ_OPTIONS, Codec, Facts, Match, Notes, ReadOptions, titled

EXTENSION = "KHR_gaussian_splatting"
SPZ_EXTENSIONS = ("KHR_gaussian_splatting_compression_spz_2", "KHR_gaussian_splatting_compression_spz")

_READ = {EXTENSION, *SPZ_EXTENSIONS, "KHR_mesh_quantization"}
"""Extensions that are read. Quantised meshes have integers where others have floats, which need nothing special."""

_OF_SURFACES = ("KHR_materials", "KHR_texture", "EXT_texture", "MSFT_texture", "KHR_lights")
"""Beginnings of the names of extensions that say nothing about Gaussians."""

_NEEDED = {
    *("EXT_mesh_gpu_instancing", "KHR_node_visibility"),
    *("EXT_meshopt_compression", "KHR_meshopt_compression", "KHR_draco_mesh_compression"),
}
"""Extensions that are not read, and without which the Gaussians are others, even in files that do not require them."""

_NEEDED_VALUES = {"kernel": "ellipse", "colorSpace": "srgb_rec709_display"}
"""The only Gaussians that are read, by key of the extension."""

_USUAL = {"projection": "perspective", "sortingMethod": "cameraDistance"}
"""How they are drawn here, by key of the extension; other ways are left out, with a note."""

TO_PLY: Signs = (-1, -1, 1)  # signs from glTF's axes to those of a .ply
MAX_JSON_BYTES, MAX_GLTF_BYTES = 1 << 22, 1 << 30  # of the JSON in a GLB; of a .gltf, whose buffers may be in it

MAX_SHOWN, MAX_ATTRIBUTES = 1000, 100
"""Largest number of nodes, and of primitives, each counted at every node that shows it; and of attributes of one, of
which a scene of SH degree 3 has 21."""

_MAGIC = b"glTF"
_BANDS = [[f"{EXTENSION}:SH_DEGREE_{band}_COEF_{i}" for i in range(2 * band + 1)] for band in range(5)]
"""Names of the attributes of SH coefficients, by band; those of the last are not read."""

_ATTRIBUTES = {
    *("POSITION", "NORMAL", "COLOR_0"),
    *(f"{EXTENSION}:{name}" for name in ("ROTATION", "SCALE", "OPACITY")),
    *(name for band in _BANDS for name in band),
}
"""Attributes that are read or repeat what others say, as ``COLOR_0`` does."""

_DTYPES = {5120: "<i1", 5121: "<u1", 5122: "<i2", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
_TYPES = {1: "SCALAR", 3: "VEC3", 4: "VEC4"}

_KINDS = {list: "a list", dict: "an object", int: "a whole number"}


class _Document:
    """Parsed glTF file, whose data is read when it is needed, one buffer view at a time: the file must still be open.
    Methods raise InvalidSceneError for whatever contradicts the format."""

    def __init__(self, opened: SceneFile, folder: Path | None) -> None:
        self.name, self._opened, self._folder = opened.name, opened, folder
        text, self._binary = _split(opened)
        self.root = parse_json(text, f"{self.name}, read as glTF,", error=InvalidSceneError)
        if not isinstance(self.root, dict):
            raise self.invalid("its JSON is no object")
        self._buffers: dict[int, bytes] = {}
        asset = self.value(self.root, "asset", dict)
        version, least = (str(asset.get(key, "2.0")) for key in ("version", "minVersion"))
        if not version.startswith("2.") or least != "2.0":
            wanted = least if version.startswith("2.") else version
            raise UnsupportedError(f"{self.name} is glTF of version {wanted[:20]!r}; export it as glTF 2.0")
        for name in map(str, self.value(self.root, "extensionsRequired", list)):
            if name not in _READ and not name.startswith(_OF_SURFACES):
                raise self.unread(name)

    def invalid(self, problem: str) -> InvalidSceneError:
        """Return the error of a file that contradicts the format."""
        return InvalidSceneError(f"{self.name} is not valid glTF: {problem}; export it again")

    def unread(self, name: str) -> UnsupportedError:
        """Return the error of a file with an extension without which the Gaussians would be others."""
        return UnsupportedError(f"{self.name} needs the extension {name[:60]!r}, which is not read; export it without")

    def value(self, parent: dict[str, Any], key: str, kind: type, default: int | None = None) -> Any:  # noqa: ANN401
        """Return a list, an object, both empty by default, or a whole number of an object."""
        found = parent.get(key, default if kind is int else kind())
        found = whole_number(found, 0, 1 << 53) if kind is int else found
        if not isinstance(found, kind):
            raise self.invalid(f"{key} is not {_KINDS[kind]}")
        return found

    def item(self, key: str, index: object) -> dict[str, Any]:
        """Return an object of one of the document's lists."""
        items = self.value(self.root, key, list)
        number = whole_number(index, 0, len(items) - 1)
        if number is None or not isinstance(items[number], dict):
            raise self.invalid(f"it names {key}[{str(index)[:20]!r}] of {len(items)}")
        return items[number]

    def extensions(self, parent: dict[str, Any]) -> dict[str, Any]:
        """Return the extensions of an object; refuse those without which the Gaussians would be others."""
        found: dict[str, Any] = self.value(parent, "extensions", dict)
        if needed := _NEEDED.intersection(found):
            raise self.unread(min(needed))
        return found

    def meshes(self) -> Iterator[tuple[dict[str, Any], Float64[np.ndarray, "4 4"]]]:
        """Yield every mesh that the scene's nodes show, with its transform; without scenes, all meshes as they are."""
        if not self.value(self.root, "scenes", list):
            for index in range(len(self.value(self.root, "meshes", list))):
                yield self.item("meshes", index), np.eye(4)
            return
        scene = self.item("scenes", self.root.get("scene", 0))
        waiting = [(index, np.eye(4)) for index in self.value(scene, "nodes", list)]
        for visited in range(MAX_SHOWN):
            if not waiting:
                return
            index, above = waiting.pop(0)
            node = self.item("nodes", index)
            self.extensions(node)
            with np.errstate(all="ignore"):  # numbers that overflow are refused where they are used
                matrix = above @ self.matrix(node)
            if "mesh" in node:
                yield self.item("meshes", node["mesh"]), matrix
            waiting += [(child, matrix) for child in self.value(node, "children", list)]
            if len(waiting) > MAX_SHOWN - visited:
                break
        raise self.invalid(f"its nodes form a circle or are more than {MAX_SHOWN:,}")

    def matrix(self, node: dict[str, Any]) -> Float64[np.ndarray, "4 4"]:
        """Return the transform of a node, from its matrix, by columns, or its translation, rotation and scale."""

        def vector(key: str, *default: float) -> list[float]:
            values = node.get(key, list(default))
            numbers = isinstance(values, list) and all(is_number(value, 1e30) for value in values)
            if not numbers or len(values) != len(default):
                raise self.invalid(f"a node's {key} is not {len(default)} numbers")
            return [float(value) for value in values]

        if "matrix" in node:
            return np.reshape(vector("matrix", *np.eye(4).ravel()), (4, 4)).T
        x, y, z, w = vector("rotation", 0, 0, 0, 1)
        matrix = np.eye(4)
        matrix[:3, :3] = [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
        matrix[:3, :3] *= vector("scale", 1, 1, 1)
        matrix[:3, 3] = vector("translation", 0, 0, 0)
        return matrix

    def count(self, index: object) -> int:
        """Return the number of elements of an accessor."""
        return self.value(self.item("accessors", index), "count", int)

    def numbers(self, index: object, width: int, what: str) -> Shaped[np.ndarray, "N C"]:
        """Return an accessor of ``width`` columns; normalised integers become fractions of their largest value."""
        accessor = self.item("accessors", index)
        if "bufferView" not in accessor or "sparse" in accessor:
            raise UnsupportedError(f"{self.name} has sparse or empty data for {what}; export it without")
        kind, code = accessor.get("type"), self.value(accessor, "componentType", int)
        if kind != _TYPES[width] or code not in _DTYPES:
            raise self.invalid(f"{what} is {str(kind)[:20]!r} of component type {code}")
        dtype, count = np.dtype(_DTYPES[code]), self.value(accessor, "count", int)
        row = dtype.itemsize * width
        stride = self.value(self.item("bufferViews", accessor["bufferView"]), "byteStride", int, 0) or row
        if not row <= stride <= 252:  # the largest of the format
            raise self.invalid(f"{what} has rows of {row} bytes every {stride:,}")
        if not count:
            return np.empty((0, width), dtype)
        offset = self.value(accessor, "byteOffset", int, 0)
        data = self.view(accessor["bufferView"], offset, stride * (count - 1) + row)
        values: np.ndarray = np.ndarray((count, width), dtype, data, 0, (stride, dtype.itemsize))
        if dtype.kind == "f" or not accessor.get("normalized", False):
            return values
        if dtype.itemsize > 2:
            raise self.invalid(f"{what} is normalised, but not of 8 or 16 bits")
        return np.maximum(values.astype(np.float32) / np.float32(np.iinfo(dtype).max), np.float32(-1))

    def view(self, index: object, first: int = 0, length: int | None = None, *, most: int = 1 << 53) -> memoryview:
        """Return bytes of a buffer view: ``length`` from ``first``, or all, but at most ``most``."""
        view = self.item("bufferViews", index)
        self.extensions(view)
        offset, size = self.value(view, "byteOffset", int, 0), self.value(view, "byteLength", int)
        number = self.value(view, "buffer", int)
        uri = self.item("buffers", number).get("uri")
        wanted = size - first if length is None else length
        if not 0 <= wanted <= size - first:
            raise self.invalid("an accessor needs more bytes than its buffer view has")
        inside = self._binary if uri is None and number == 0 else None
        if inside is None and number not in self._buffers:
            self._buffers[number] = self._load(uri, number)
        if offset + size > (len(self._buffers[number]) if inside is None else inside[1]):
            raise self.invalid("a buffer view reaches beyond its buffer")
        start, wanted = offset + first, min(wanted, most)
        if inside is None:
            return memoryview(self._buffers[number])[start : start + wanted]
        return memoryview(self._opened.read(inside[0] + start, wanted))

    def _load(self, uri: object, number: int) -> bytes:
        """Return the bytes of a buffer: base64 in the JSON, or a file beside the scene."""
        if not isinstance(uri, str):
            raise self.invalid(f"buffers[{number}] has no data")
        if uri.startswith("data:"):
            try:
                return base64.b64decode(uri.partition(";base64,")[2], validate=True)
            except ValueError as error:
                raise self.invalid(f"buffers[{number}].uri is not base64") from error
        path = urllib.parse.unquote(uri)
        if not is_file_name(path):
            raise UnsupportedError(f"{self.name} names a buffer outside its folder; put the file beside it")
        if self._folder is None:
            raise UnsupportedError(f"{self.name} needs the file {path[:80]!r} beside it; give the path, or a .glb")
        with open_scene_file(self._folder / path, "; put the buffer there") as opened:
            return opened.read(0, opened.size)


def _split(opened: SceneFile) -> tuple[bytes, tuple[int, int] | None]:
    """Return the JSON, and where the binary part of a GLB begins and how long it is."""
    if opened.size < 20 or opened.read(0, 4) != _MAGIC:
        if opened.size > MAX_GLTF_BYTES:
            raise UnsupportedError(f"{opened.name} has {opened.size:,} bytes of text; export it as .glb")
        return opened.read(0, opened.size), None
    _, version, length, size, kind = struct.unpack("<4sIII4s", opened.read(0, 20))
    if version != 2:
        raise UnsupportedError(f"{opened.name} is GLB of version {version}; version 2 is read")
    if kind != b"JSON" or size > MAX_JSON_BYTES:
        raise InvalidSceneError(f"{opened.name} is not valid GLB: its first chunk is not JSON; export it again")
    if length > opened.size:
        raise opened.cut_short(length)
    text, start = opened.read(20, size), 28 + size  # of the second chunk's data
    if start > length:
        return text, None
    size, kind = struct.unpack("<I4s", opened.read(start - 8, 8))
    if start + size > opened.size:
        raise opened.cut_short(start + size)
    return text, (start, size) if kind == b"BIN\0" else None


# Reading.


@dataclass(frozen=True, slots=True)
class _Part:
    """Primitive with Gaussians, and the transform of its node; ``spz`` is the buffer view of its ``.spz``."""

    attributes: dict[str, Any]
    matrix: Float64[np.ndarray, "4 4"]
    count: int
    degree: int
    spz: int | None = None
    antialiased: bool = False


def _sniff(head: bytes, size: int) -> Match:
    start = head.removeprefix(b"\xef\xbb\xbf").lstrip()
    is_text = start.startswith(b"{") and not any(byte < 32 and byte not in b"\t\r\n" for byte in start)
    return Match.SURE if head.startswith(_MAGIC) else Match.POSSIBLE if is_text else Match.NO


def describe(source: Path | bytes, level: int = 0) -> Facts:
    """Read the JSON, and the headers of ``.spz`` inside."""
    with open_scene_file(source) as opened:
        binary = opened.file.read(4) == _MAGIC
        parts, _ = _parts(_Document(opened, None if isinstance(source, bytes) else source.parent))
    spz = any(part.spz is not None for part in parts)
    antialiased = all(part.antialiased for part in parts)
    kinds = ("GLB" if binary else "JSON", "compressed as SPZ" if spz else "", "antialiased" if antialiased else "")
    return Facts(
        title=titled("glTF scene", *kinds),
        count=sum(part.count for part in parts),
        sh_degree=max(part.degree for part in parts),
        details={"binary": binary, "primitives": len(parts), "spz": spz, "antialiased": antialiased},
    )


def read_gltf(
    source: Path | bytes, reading: ReadOptions = DEFAULT_READ_OPTIONS, threads: int = 0, progress: Progress = silent
) -> Splats:
    """Read a scene; primitives of a lower SH degree get zeros for the coefficients above it. What the scene has beyond
    Gaussians is named in ``notes``. Buffers in other files must be below its folder."""
    with open_scene_file(source) as opened:
        document = _Document(opened, None if isinstance(source, bytes) else source.parent)
        parts, left_out = _parts(document)
        notes = dict.fromkeys([f"left out: {listed(left_out)}"] if left_out else [])
        count = sum(part.count for part in parts)
        refuse_more_than(reading.max_compressed, count, document.name)
        progress("read", 0.0)
        splats = empty_splats(count, SH_REST_COUNTS[max(part.degree for part in parts)])
        start, placed = 0, np.empty((count, 3))
        for part in parts:
            rows = slice(start, start + part.count)
            own = splats.select(rows)
            if part.spz is None:
                _read_attributes(document, part, own)
            else:
                notes |= dict.fromkeys(_read_spz(document, part.spz, own))
            with np.errstate(all="ignore"):  # numbers that overflow are refused
                placed[rows] = own.means.astype(np.float64) @ part.matrix[:3, :3].T + part.matrix[:3, 3]
            _apply(document, part.matrix, own)
            start += part.count
            progress("read", start / max(count, 1))
    mirror(splats, TO_PLY)
    # Half a turn of each Gaussian about its own axis, which its ellipsoid does not show: a .ply written as floats gets
    # back the same numbers.
    w, x, y, z = (splats.quats[:, i].copy() for i in range(4))
    for i, values in enumerate((z, -y, x, -w)):
        splats.quats[:, i] = values
    whole = replace(splats, notes=tuple(notes))
    if (world := placed * TO_PLY).size and origin_for(world, whole.scales) != WORLD:
        whole = from_world(whole, world)
    return marked(whole, [part.antialiased for part in parts])


def _parts(document: _Document) -> tuple[list[_Part], list[str]]:
    """Return the primitives that hold Gaussians, and what else the scene has."""
    parts, shown = list[_Part](), 0
    left_out = dict.fromkeys(key for key in ("animations", "skins") if document.value(document.root, key, list))
    for name in map(str, document.value(document.root, "extensionsUsed", list)):
        if name not in _READ and not name.startswith(_OF_SURFACES):
            left_out[f"extension {name[:60]}"] = None
    if len(document.value(document.root, "scenes", list)) > 1:
        left_out["other scenes"] = None
    for mesh, matrix in document.meshes():
        primitives = document.value(mesh, "primitives", list)
        shown += len(primitives) or 1
        if shown > MAX_SHOWN:
            raise document.invalid(f"its nodes show more than {MAX_SHOWN:,} primitives")
        for primitive in primitives:
            if not isinstance(primitive, dict):
                raise document.invalid("a primitive is not an object")
            if EXTENSION not in document.extensions(primitive):
                left_out["meshes without Gaussians"] = None
                continue
            parts.append(part := _part(document, primitive, matrix))
            splatting = document.value(document.extensions(primitive), EXTENSION, dict)
            left_out |= dict.fromkeys(key for key in ("indices", "targets") if key in primitive)
            orders = {key: splatting.get(key, usual) for key, usual in _USUAL.items()}
            left_out |= {f"{key} {str(found)[:40]!r}": None for key, found in orders.items() if found != _USUAL[key]}
            if part.spz is None:
                left_out |= dict.fromkeys(name for name in part.attributes if name not in _ATTRIBUTES)
    if not parts:
        raise InvalidSceneError(
            f"{document.name} has no Gaussians: no mesh that its scene shows uses {EXTENSION}; name a 3DGS scene, or "
            "export it with a node for each mesh"
        )
    return parts, list(left_out)


def _part(document: _Document, primitive: dict[str, Any], matrix: Float64[np.ndarray, "4 4"]) -> _Part:
    """Check a primitive's extensions and attributes."""
    splatting = document.value(document.extensions(primitive), EXTENSION, dict)
    for key, usual in _NEEDED_VALUES.items():
        if (found := splatting.get(key, usual)) != usual:
            raise UnsupportedError(f"{document.name} has the {key} {str(found)[:40]!r}; export it with {usual!r}")
    attributes = document.value(primitive, "attributes", dict)
    if len(attributes) > MAX_ATTRIBUTES:
        raise document.invalid(f"a primitive has {len(attributes):,} attributes")
    count = document.count(attributes["POSITION"]) if "POSITION" in attributes else None
    compressions = document.extensions(splatting)
    for name in compressions:
        if name not in SPZ_EXTENSIONS:
            raise document.unread(name)
        view = document.value(document.value(compressions, name, dict), "bufferView", int)
        header = spz_format.read_spz_info(bytes(document.view(view, most=512)))
        if count not in (None, header.count):
            raise document.invalid(f"its .spz has {header.count:,} Gaussians, its accessors another number")
        return _Part(attributes, matrix, header.count, header.sh_degree, view, header.antialiased)
    if count is None:
        raise document.invalid("a primitive has no POSITION")
    degree = max((band for band, names in enumerate(_BANDS) if not attributes.keys().isdisjoint(names)), default=0)
    refuse_degree(degree, document.name)
    return _Part(attributes, matrix, count, degree)


def _read_attributes(document: _Document, part: _Part, out: Splats) -> None:
    """Read the accessors of a primitive into ``out``, in glTF's axes."""

    def column(name: str, width: int) -> np.ndarray:
        if name not in part.attributes:
            raise document.invalid(f"a primitive has no {name}")
        values = document.numbers(part.attributes[name], width, name)
        if len(values) != len(out):
            raise document.invalid(f"{name} has {len(values):,} values for {len(out):,} Gaussians")
        return values

    with np.errstate(all="ignore"):  # values may be any floats; they are not cleaned here
        out.means[:] = column("POSITION", 3)
        out.quats[:] = np.roll(column(f"{EXTENSION}:ROTATION", 4), 1, axis=1)  # x, y, z, w
        scales = column(f"{EXTENSION}:SCALE", 3)
        if scales.size and float(scales.min()) < 0:
            raise document.invalid("it has negative scales, as drafts of the extension had them")
        opacities = column(f"{EXTENSION}:OPACITY", 1)[:, 0]
        for rows in blocks(len(out)):
            out.scales[rows] = log_scales(scales[rows].astype(np.float64))
            out.opacities[rows] = opacity_logits(opacities[rows].astype(np.float64))
        out.sh0[:] = column(_BANDS[0][0], 3)
        for i, name in enumerate(name for band in _BANDS[1 : part.degree + 1] for name in band):
            out.shN[:, i] = column(name, 3)


def _read_spz(document: _Document, view: int, out: Splats) -> tuple[str, ...]:
    """Read a ``.spz`` inside the file into ``out``, in glTF's axes; return its notes."""
    most = 2 * spz_format.MAX_EXTENSION_BYTES + 2 * len(out) * spz_format.LARGEST_ROW  # which no such file exceeds
    data = bytes(document.view(view, most=most))
    stored = spz_format.read_spz(data, ReadOptions(max_gaussians=len(out)))
    mirror(stored, TO_PLY)
    for name in ATTRIBUTES:
        if name != "shN":
            getattr(out, name)[:] = getattr(stored, name)
    out.shN[:, : stored.shN.shape[1]] = stored.shN
    return stored.notes


@np.errstate(all="ignore")  # numbers that overflow are refused
def _apply(document: _Document, matrix: Float64[np.ndarray, "4 4"], out: Splats) -> None:
    """Move Gaussians by the transform of their node."""
    if np.array_equal(matrix, np.eye(4)):
        return
    linear = matrix[:3, :3]
    determinant = float(np.linalg.det(linear))
    scale = abs(determinant) ** (1 / 3)
    rotation = linear / scale if scale > 0 else linear
    if not determinant > 0 or not np.allclose(rotation @ rotation.T, np.eye(3), atol=1e-4):
        raise UnsupportedError(
            f"{document.name} has a node that mirrors or stretches its Gaussians; apply the transform before the export"
        )
    move(out, rotation, scale, matrix[:3, 3])


# Writing of ``.glb``: one primitive, all attributes as floats or as ``.spz`` inside.
#
# In the form of floats, colours and opacities are also there as ``COLOR_0``, so that programs without the extension
# show coloured points.

MAX_GLB_BYTES = (1 << 32) - 1  # largest GLB: its header has 32 bits for the size

_NOT_IN_SPZ = (f"{EXTENSION}:OPACITY", _BANDS[0][0])
"""Attributes that the extension for ``.spz`` gives no source: there, ``COLOR_0`` is colour and opacity."""


@dataclass(frozen=True, slots=True)
class _Column:
    """Attribute of the primitive: its width, and the values of some rows as they are stored."""

    name: str
    width: int
    values: Callable[[slice], Shaped[np.ndarray, "B width"]]
    dtype: str = "<f4"


def write_glb(file: BinaryWriter, splats: Splats, raw_axes: bool = False, progress: Progress = silent) -> Notes:
    """Write a scene in glTF's axes."""
    ends = _ends(splats)
    columns, views, start = list(_columns(splats)), list[dict[str, int]](), 0
    for column in columns:
        length = len(splats) * column.width * np.dtype(column.dtype).itemsize
        views.append({"buffer": 0, "byteOffset": start, "byteLength": length, "target": 34962})  # ARRAY_BUFFER
        start += length
    _write_head(file, splats, columns, ends, views)
    for done, column in enumerate(columns, 1):
        for rows in blocks(len(splats)):
            file.write(column.values(rows).astype(column.dtype).tobytes())
        progress("write", done / len(columns))
    return tuple(marks_left_out(splats))


def write_spz_glb(file: BinaryWriter, splats: Splats, raw_axes: bool = False, progress: Progress = silent) -> Notes:
    """Write a scene as ``.spz`` inside ``.glb``. The ``.spz`` has its own axes (x right, y up, z back), as the
    extension wants it, whose text has the library of ``.spz`` turn them from and to those of glTF. Accessors have types
    and counts, and no data."""
    ends = _ends(splats)
    packed = io.BytesIO()  # its size stands before it
    notes = spz_format.write_spz(packed, splats, progress=progress)
    bits = spz_format.fractional_bits_for(float(np.abs(splats.means).max()))
    spz_format.decode_positions(spz_format.encode_positions(ends, bits), bits, ends)  # as they are read: in steps
    columns = [column for column in _columns(splats) if column.name not in _NOT_IN_SPZ]
    body = packed.getbuffer()
    view = {"buffer": 0, "byteOffset": 0, "byteLength": len(body)}
    _write_head(file, splats, columns, ends, [view], {SPZ_EXTENSIONS[0]: {"bufferView": 0}})
    file.write(body)
    file.write(bytes(-len(body) % 4))
    return notes


def _ends(splats: Splats) -> Float32[np.ndarray, "2 3"]:
    """Return the smallest and the largest coordinates of a scene, which must have Gaussians."""
    refuse_empty(splats, ".glb")
    return np.stack([splats.means.min(axis=0), splats.means.max(axis=0)])


def _columns(splats: Splats) -> Iterator[_Column]:
    """Yield all attributes in glTF's axes, half a turn about z from those of a ``.ply``."""
    axes = np.array(TO_PLY, np.float32)
    yield _Column("POSITION", 3, lambda rows: splats.means[rows] * axes)
    yield _Column("COLOR_0", 4, lambda rows: _linear_colors(splats.select(rows)), "u1")
    # Half a turn of the Gaussian about its own axis precedes: the reader has the reason.
    turned = np.array([-1, 1, 1, -1], np.float32)
    yield _Column(f"{EXTENSION}:ROTATION", 4, lambda rows: splats.quats[rows][:, [2, 1, 0, 3]] * turned)
    yield _Column(f"{EXTENSION}:SCALE", 3, lambda rows: np.exp(splats.scales[rows].astype(np.float64)))
    yield _Column(f"{EXTENSION}:OPACITY", 1, lambda rows: opacities_of(splats.opacities[rows])[:, None])
    yield _Column(_BANDS[0][0], 3, lambda rows: splats.sh0[rows])
    signs = sh_signs(TO_PLY, splats.shN.shape[1])

    def coefficient(k: int) -> Callable[[slice], Shaped[np.ndarray, "B 3"]]:
        return lambda rows: splats.shN[rows, k] * signs[k]

    for k, name in enumerate(name for band in _BANDS[1 : splats.sh_degree + 1] for name in band):
        yield _Column(name, 3, coefficient(k))


def _linear_colors(splats: Splats) -> UInt8[np.ndarray, "B 4"]:
    """Return linear colours, as glTF's vertex colours are, and opacities."""
    srgb = np.clip(colors_of(splats.sh0), 0, 1)
    linear = np.where(srgb <= 0.04045, srgb / 12.92, ((srgb + 0.055) / 1.055) ** 2.4)
    return to_bytes(255 * np.concatenate([linear, opacities_of(splats.opacities)[:, None]], axis=1))


def _write_head(
    file: BinaryWriter,
    splats: Splats,
    columns: list[_Column],
    ends: Float32[np.ndarray, "2 3"],
    views: list[dict[str, int]],
    compression: dict[str, Any] | None = None,
) -> None:
    """Write all that stands before the buffer; ``compression`` is the extension that gives accessors their data. The
    JSON is filled up with spaces to a multiple of four bytes; its node moves positions to the world."""
    compression, accessors = compression or {}, list[dict[str, Any]]()
    for column in columns:
        component = {"componentType": 5126} if column.dtype == "<f4" else {"componentType": 5121, "normalized": True}
        accessors.append({**component, "count": len(splats), "type": _TYPES[column.width]})
    corners = ends * np.array(TO_PLY, np.float32)
    accessors[0] |= {"min": corners.min(axis=0).tolist(), "max": corners.max(axis=0).tolist()}
    if not compression:
        for i, accessor in enumerate(accessors):
            accessor["bufferView"] = i
    body = sum(view["byteLength"] for view in views)
    translation = [sign * value + 0.0 for sign, value in zip(TO_PLY, splats.origin, strict=True)]
    primitive = {
        "mode": 0,  # points
        "attributes": {column.name: i for i, column in enumerate(columns)},
        "extensions": {EXTENSION: {**_NEEDED_VALUES, **_USUAL, **({"extensions": compression} if compression else {})}},
    }
    root = {
        "asset": {"version": "2.0", "generator": "kissgs"},
        "extensionsUsed": [EXTENSION, *compression],
        **({"extensionsRequired": [EXTENSION, *compression]} if compression else {}),
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0, **({} if splats.origin == WORLD else {"translation": translation})}],
        "meshes": [{"primitives": [primitive]}],
        "accessors": accessors,
        "bufferViews": views,
        "buffers": [{"byteLength": body}],
    }
    text = json.dumps(root, separators=(",", ":")).encode("ascii")
    text += b" " * (-len(text) % 4)
    body += -body % 4
    size = 12 + 8 + len(text) + 8 + body
    if size > MAX_GLB_BYTES:
        count = f"{len(splats):,} Gaussians"
        raise UnsupportedError(f"{count} take {size:,} bytes, and .glb ends at 4 GiB; write .spz or .ply")
    file.write(struct.pack("<4sIII4s", _MAGIC, 2, size, len(text), b"JSON") + text)
    file.write(struct.pack("<I4s", body, b"BIN\0"))


FORMAT = Codec(
    sniff=_sniff,
    info=describe,
    read=read_gltf,
    write={".glb": write_glb, ".spz.glb": write_spz_glb},
    records_origin=True,
)
