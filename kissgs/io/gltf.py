"""glTF with ``KHR_gaussian_splatting``: GLB or JSON; also with the attributes in ``.spz`` inside it.

All primitives of the scene's nodes are read, at each of their instances, moved by the transforms of both, and turned
from glTF's axes (x left, y up, z forward) to those of a ``.ply``.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from kissgs.core.array_types import Float64
from kissgs.core.errors import InvalidSceneError, UnsupportedError
from kissgs.core.positions import WORLD, from_world, origin_for
from kissgs.core.progress import Progress, silent
from kissgs.core.splats import ATTRIBUTES, SH_REST_COUNTS, Splats, empty_splats
from kissgs.io.conventions import log_scales, mirror, move, opacity_logits, steps
from kissgs.io.files import listed, marked, open_scene_file, refuse_more_than
from kissgs.io.gltf_document import (
    EXTENSION,
    GLB_MAGIC,
    SPZ_EXTENSIONS,
    TO_PLY,
    Document,
    node_matrix,
    write_glb,
    write_spz_glb,
)
from kissgs.io.scene_format import DEFAULT_READ_OPTIONS, Codec, Facts, Match, ReadOptions, titled
from kissgs.io.spz import largest_spz, read_spz, read_spz_info

INSTANCING, VISIBILITY = "EXT_mesh_gpu_instancing", "KHR_node_visibility"

_COMPRESSIONS = ("EXT_meshopt_compression", "KHR_meshopt_compression", "KHR_draco_mesh_compression")

_READ = {EXTENSION, *SPZ_EXTENSIONS, INSTANCING, VISIBILITY, "KHR_mesh_quantization"}
"""Extensions that are read. Quantised meshes have integers where others have floats, which need nothing special."""

_OF_SURFACES = re.compile(r"(KHR_materials|KHR_texture|EXT_texture|MSFT_texture|KHR_lights)_.*")
"""Extensions that say nothing about Gaussians."""

_KNOWN_ATTRIBUTES = re.compile(
    rf"POSITION|NORMAL|COLOR_0|{EXTENSION}:(ROTATION|SCALE|OPACITY|SH_DEGREE_[0-3]_COEF_[0-6])"
)
"""Attributes that are read or repeat what others say, as ``COLOR_0`` does."""

_USUAL = {"projection": "perspective", "sortingMethod": "cameraDistance"}
"""Ways to draw that kissgs has no other of, by key of the extension."""

_MAX_INSTANCES = 1000
"""Largest number of nodes, and of primitives, each counted at every node and instance that shows it."""

_MAX_ATTRIBUTES = 100
"""Largest number of attributes of a primitive; a scene of SH degree 3 has 21."""


@dataclass(frozen=True, slots=True)
class _Primitive:
    """Primitive and where it stands: ``matrix`` is its node's transform. ``spz`` is the buffer view of its ``.spz``."""

    attributes: dict[str, Any]
    matrix: Float64[np.ndarray, "4 4"]
    count: int
    degree: int
    spz: int | None
    antialiased: bool = False


def _sniff(head: bytes, size: int) -> Match:
    start = head.removeprefix(b"\xef\xbb\xbf").lstrip()
    is_text = start.startswith(b"{") and not any(byte < 32 and byte not in b"\t\r\n" for byte in start)
    return Match.SURE if head.startswith(GLB_MAGIC) else Match.POSSIBLE if is_text else Match.NO


def describe(source: Path | bytes, level: int = 0) -> Facts:
    """Read the JSON, and the headers of ``.spz`` inside."""
    with open_scene_file(source) as opened:
        binary = opened.file.read(4) == GLB_MAGIC
        document = Document(opened, None if isinstance(source, bytes) else source.parent)
        found = list(_primitives(document, {}))
    spz = any(primitive.spz is not None for primitive in found)
    antialiased = all(primitive.antialiased for primitive in found)
    kinds = ("GLB" if binary else "JSON", "compressed as SPZ" if spz else "", "antialiased" if antialiased else "")
    return Facts(
        title=titled("glTF scene", *kinds),
        count=sum(primitive.count for primitive in found),
        sh_degree=max(primitive.degree for primitive in found),
        details={"binary": binary, "primitives": len(found), "spz": spz, "antialiased": antialiased},
    )


def read_gltf(
    source: Path | bytes, reading: ReadOptions = DEFAULT_READ_OPTIONS, threads: int = 0, progress: Progress = silent
) -> Splats:
    """Read a scene; primitives of a lower SH degree get zeros for the coefficients above it.

    What the scene has beyond Gaussians is named in ``notes``; so are hidden nodes, which are left out too. Buffers in
    other files must be below the folder of the scene.
    """
    with open_scene_file(source) as opened:
        document = Document(opened, None if isinstance(source, bytes) else source.parent)
        left_out: dict[str, None] = {}
        found, notes = list(_primitives(document, left_out)), dict[str, None]()
        count = sum(primitive.count for primitive in found)
        refuse_more_than(reading.max_compressed, count, document.name)
        progress("read", 0.0)
        splats = empty_splats(count, SH_REST_COUNTS[max(primitive.degree for primitive in found)])
        start, placed = 0, np.empty((count, 3))
        for primitive in found:
            rows = slice(start, start + primitive.count)
            part = splats.select(rows)
            if primitive.spz is None:
                _read_attributes(document, primitive, part)
            else:
                notes |= dict.fromkeys(_read_spz(document, primitive.spz, part))
            with np.errstate(all="ignore"):  # numbers that overflow are refused
                placed[rows] = part.means.astype(np.float64) @ primitive.matrix[:3, :3].T + primitive.matrix[:3, 3]
            _apply(document, primitive.matrix, part)
            start += primitive.count
            progress("read", start / max(count, 1))
    _turn_to_ply(splats)
    if left_out:
        notes[f"left out: {listed(list(left_out))}"] = None
    whole = replace(splats, notes=tuple(notes))
    if (world := placed * TO_PLY).size and origin_for(world, whole.scales) != WORLD:
        whole = from_world(whole, world)
    return marked(whole, [primitive.antialiased for primitive in found])


def _primitives(document: Document, left_out: dict[str, None]) -> Iterator[_Primitive]:
    """Yield the primitives that hold Gaussians; add what else the scene has to the keys of ``left_out``."""
    _check_required(document)
    left_out |= dict.fromkeys(key for key in ("animations", "skins") if document.items(key))
    left_out |= dict.fromkeys(f"extension {name[:60]}" for name in _extensions(document, "extensionsUsed"))
    if len(document.items("scenes")) > 1:
        left_out["other scenes"] = None
    seen, number = 0, 0
    for mesh, matrix in _instances(document, left_out):
        primitives = document.items("primitives", mesh)
        seen += len(primitives) or 1
        if seen > _MAX_INSTANCES:
            raise document.invalid(f"its nodes show more than {_MAX_INSTANCES:,} primitives")
        for primitive in primitives:
            splatting = document.child(document.child(primitive, "extensions"), EXTENSION)
            if EXTENSION in document.child(primitive, "extensions"):
                number += 1
                found = _primitive(document, primitive, splatting, matrix)
                unread = [str(key) for key in ("indices", "targets") if key in primitive]
                unread += [
                    f"{key} {str(splatting[key])[:40]!r}"
                    for key, usual in _USUAL.items()
                    if splatting.get(key, usual) != usual
                ]
                unread += [
                    key for key in found.attributes if found.spz is None and not _KNOWN_ATTRIBUTES.fullmatch(key)
                ]
                left_out |= dict.fromkeys(unread)
                yield found
            else:
                left_out["meshes without Gaussians"] = None
    if number:
        return
    meshes = (primitive for mesh in document.items("meshes") for primitive in document.items("primitives", mesh))
    if any(EXTENSION in document.child(primitive, "extensions") for primitive in meshes):
        raise InvalidSceneError(
            f"{document.name} shows none of its Gaussians: no visible node of its scene has them; export them visible"
        )
    raise InvalidSceneError(f"{document.name} has no Gaussians: none of its meshes uses {EXTENSION}; name a 3DGS scene")


def _check_required(document: Document) -> None:
    asset = document.child(document.root, "asset")
    version, least = (str(asset.get(key, "2.0")) for key in ("version", "minVersion"))
    if not version.startswith("2.") or least != "2.0":
        wanted = least if version.startswith("2.") else version
        raise UnsupportedError(f"{document.name} is glTF of version {wanted[:20]!r}; export it as glTF 2.0")
    _refuse_compressions(
        document, [name for name in document.entries("extensionsRequired", document.root, str) if name in _COMPRESSIONS]
    )
    for name in _extensions(document, "extensionsRequired"):
        raise UnsupportedError(
            f"{document.name} requires the extension {name[:60]!r}, which is not read; export it without"
        )


def _refuse_compressions(document: Document, names: list[str]) -> None:
    for name in names:
        raise UnsupportedError(f"{document.name} is compressed by {name[:60]!r}; export it without or with .spz")


def _extensions(document: Document, key: str) -> list[str]:
    """Return the extensions in a list of the file that may matter to Gaussians and are not read."""
    return [
        name
        for name in document.entries(key, document.root, str)
        if name not in _READ and not _OF_SURFACES.fullmatch(name)
    ]


def _instances(
    document: Document, left_out: dict[str, None]
) -> Iterator[tuple[dict[str, Any], Float64[np.ndarray, "4 4"]]]:
    """Yield every mesh that the scene's nodes show, with its transform; without scenes, all meshes as they are."""
    scenes = document.items("scenes")
    if not scenes:
        yield from ((mesh, np.eye(4)) for mesh in document.items("meshes"))
        return
    scene = document.item("scenes", document.root.get("scene", 0))
    waiting = [(index, np.eye(4)) for index in document.entries("nodes", scene)]
    for visited in range(_MAX_INSTANCES):
        if not waiting:
            return
        index, above = waiting.pop(0)
        node = document.item("nodes", index)
        extensions = document.child(node, "extensions")
        if document.child(extensions, VISIBILITY).get("visible") is False:
            left_out["hidden nodes"] = None
            continue
        with np.errstate(all="ignore"):  # numbers that overflow are refused where they are used
            matrix = above @ node_matrix(document, node)
            placed = [matrix]
            if INSTANCING in extensions:
                placed = [matrix @ inner for inner in _placements(document, document.child(extensions, INSTANCING))]
        if "mesh" in node:
            mesh = document.item("meshes", node["mesh"])
            yield from ((mesh, place) for place in placed)
        waiting += [(child, matrix) for child in document.entries("children", node)]
        if len(waiting) > _MAX_INSTANCES - visited:
            break
    raise document.invalid(f"its nodes form a circle or are more than {_MAX_INSTANCES:,}")


def _placements(document: Document, instancing: dict[str, Any]) -> Iterator[Float64[np.ndarray, "4 4"]]:
    """Yield the transform of each instance within its node."""
    attributes = document.child(instancing, "attributes")
    counts = {document.count(index) for index in attributes.values()}
    if len(counts) != 1:
        raise document.invalid(f"the attributes of {INSTANCING} have different counts, or there are none")
    (count,) = counts
    if count > _MAX_INSTANCES:
        raise UnsupportedError(f"{document.name} shows a mesh {count:,} times; {_MAX_INSTANCES:,} instances are read")
    widths = {"TRANSLATION": 3, "ROTATION": 4, "SCALE": 3}
    columns = {
        name.lower(): document.numbers(index, widths[name], name).astype(np.float64)
        for name, index in attributes.items()
        if name in widths
    }
    if "rotation" in columns:  # of integers they are not quite of unit length
        lengths = np.linalg.norm(columns["rotation"], axis=1, keepdims=True)
        if not lengths.all():
            raise document.invalid("an instance has a rotation of length zero")
        columns["rotation"] /= lengths
    for row in range(count):
        yield node_matrix(document, {name: values[row].tolist() for name, values in columns.items()})


def _primitive(
    document: Document, primitive: dict[str, Any], splatting: dict[str, Any], matrix: Float64[np.ndarray, "4 4"]
) -> _Primitive:
    """Check a primitive's extension and attributes."""
    kernel, space = splatting.get("kernel", "ellipse"), splatting.get("colorSpace", "srgb_rec709_display")
    if kernel != "ellipse":
        raise UnsupportedError(f"{document.name} has the kernel {str(kernel)[:40]!r}; only 'ellipse' is read")
    if space != "srgb_rec709_display":
        raise UnsupportedError(
            f"{document.name} has the colour space {str(space)[:40]!r}; export it with 'srgb_rec709_display'"
        )
    attributes = document.child(primitive, "attributes")
    if len(attributes) > _MAX_ATTRIBUTES:
        raise document.invalid(f"a primitive has {len(attributes):,} attributes")
    compressions = document.child(splatting, "extensions")
    unread = []
    for name in compressions:
        if name in SPZ_EXTENSIONS:
            view = document.whole(document.child(compressions, name), "bufferView", -1)
            header = read_spz_info(bytes(document.view(view, most=512)))
            if "POSITION" in attributes and document.count(attributes["POSITION"]) != header.count:
                raise document.invalid(f"its .spz has {header.count:,} Gaussians, its accessors another number")
            return _Primitive(attributes, matrix, header.count, header.sh_degree, view, header.antialiased)
        unread.append(str(name))
    unread += [str(name) for name in document.child(primitive, "extensions") if name in _COMPRESSIONS]
    _refuse_compressions(document, unread)
    if "POSITION" not in attributes:
        raise document.invalid("a primitive has no POSITION")
    return _Primitive(attributes, matrix, document.count(attributes["POSITION"]), _degree(document, attributes), None)


def _degree(document: Document, attributes: dict[str, Any]) -> int:
    """Return the SH degree, all of whose coefficients must be there."""
    prefix = f"{EXTENSION}:SH_DEGREE_"
    present = {name.removeprefix(prefix) for name in attributes if name.startswith(prefix)}
    degree = 0
    for band in range(4):
        wanted = {f"{band}_COEF_{i}" for i in range(2 * band + 1)}
        if band == 0 or present & wanted:
            missing = sorted(wanted - present)
            if missing or degree < band - 1:
                raise document.invalid(f"it lacks {prefix}{missing[0] if missing else f'{band - 1}_COEF_0'}")
            degree = band
    if any(name.startswith("4_") for name in present):
        raise UnsupportedError(f"{document.name} has an SH degree above 3; export it with degree 3 or lower")
    return degree


def _read_attributes(document: Document, primitive: _Primitive, out: Splats) -> None:
    """Read the accessors of a primitive into ``out``, in glTF's axes."""

    def column(name: str, width: int) -> np.ndarray:
        key = name if name == "POSITION" else f"{EXTENSION}:{name}"
        if key not in primitive.attributes:
            raise document.invalid(f"a primitive has no {key}")
        values = document.numbers(primitive.attributes[key], width, key)
        if len(values) != len(out):
            raise document.invalid(f"{key} has {len(values):,} values for {len(out):,} Gaussians")
        return values

    with np.errstate(all="ignore"):  # values may be any floats; they are not cleaned here
        out.means[:] = column("POSITION", 3)
        out.quats[:] = np.roll(column("ROTATION", 4), 1, axis=1)  # x, y, z, w
        scales = column("SCALE", 3)
        if scales.size and float(scales.min()) < 0:
            raise document.invalid("it has negative scales, as drafts of the extension had them")
        opacities = column("OPACITY", 1)[:, 0]
        for part in steps(len(out)):
            out.scales[part] = log_scales(scales[part].astype(np.float64))
            out.opacities[part] = opacity_logits(opacities[part].astype(np.float64))
        out.sh0[:] = column("SH_DEGREE_0_COEF_0", 3)
        bands = [f"SH_DEGREE_{band}_COEF_{i}" for band in range(1, primitive.degree + 1) for i in range(2 * band + 1)]
        for i, name in enumerate(bands):
            out.shN[:, i] = column(name, 3)


def _read_spz(document: Document, view: int, out: Splats) -> tuple[str, ...]:
    """Read a ``.spz`` inside the file into ``out``, in glTF's axes (x left, y up, z forward); return its notes."""
    stored = read_spz(bytes(document.view(view, most=largest_spz(len(out)))), ReadOptions(max_gaussians=len(out)))
    mirror(stored, TO_PLY)
    for name in ATTRIBUTES:
        if name != "shN":
            getattr(out, name)[:] = getattr(stored, name)
    out.shN[:, : stored.shN.shape[1]] = stored.shN
    return stored.notes


@np.errstate(all="ignore")  # numbers that overflow are refused
def _apply(document: Document, matrix: Float64[np.ndarray, "4 4"], out: Splats) -> None:
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


def _turn_to_ply(splats: Splats) -> None:
    """Turn a scene from glTF's axes to those of a ``.ply``, half a turn about z.

    The rotation of each Gaussian follows by half a turn of its own about the same axis, which its ellipsoid does not
    show, so that a ``.ply`` written as floats gets back the same numbers.
    """
    mirror(splats, TO_PLY)
    w, x, y, z = (splats.quats[:, i].copy() for i in range(4))
    for i, values in enumerate((z, -y, x, -w)):
        splats.quats[:, i] = values


FORMAT = Codec(
    sniff=_sniff,
    info=describe,
    read=read_gltf,
    write={".glb": write_glb, ".spz.glb": write_spz_glb},
    records_origin=True,
)
