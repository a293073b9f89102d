"""The scene formats, one line each, and what the name of an output stands for. A format's module is imported when used.
To add a format, add its module, which ends in ``FORMAT = Codec(…)``, and its line in :data:`FORMATS`."""

from __future__ import annotations

import importlib
import os
import unicodedata
from collections.abc import Sequence
from dataclasses import dataclass
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING, Literal, cast, get_args

from kissgs.core.errors import OutputError, UnsupportedError

if TYPE_CHECKING:
    from kissgs.io.scene_format import Codec


@dataclass(frozen=True, slots=True, kw_only=True)
class Format:
    """Format of scenes."""

    module: str  # module that has the Codec as FORMAT, of streamed scenes in STREAMED
    endings: tuple[str, ...] = ()  # that are read, the usual one first; they decide where the content does not
    written: tuple[str, ...] = ()  # endings of files that are written, containers by compress and others by save
    is_container: bool = False  # whether the metadata describes a scene without decoding an image
    manifest: str | None = None  # name of the manifest of a scene in levels of detail
    by_ending: bool = False  # whether the ending decides before the content, which has no mark
    is_pickle: bool = False  # whether a file is a pickle: a zip that is no container, which no service takes

    @property
    def codec(self) -> Codec:
        """Code of the format."""
        module = importlib.import_module(self.module)
        return cast("Codec", module.STREAMED.codec if self.manifest else module.FORMAT)


LOD_NAME, LEVELS_NAME = "lod-meta.json", "levels.json"

FORMATS = {
    "ply": Format(module="kissgs.io.ply", endings=(".ply",), written=(".ply", ".compressed.ply")),
    "sogxt": Format(module="kissgs.sogxt.decode", written=(".zip",), is_container=True),
    "sog": Format(module="kissgs.sog.decode", endings=(".sog",), written=(".sog",), is_container=True),
    "streamed-sog": Format(module="kissgs.sog.decode", manifest=LOD_NAME, is_container=True),
    "streamed-sogxt": Format(module="kissgs.sogxt.decode", manifest=LEVELS_NAME, is_container=True),
    "spz": Format(module="kissgs.io.spz", endings=(".spz",), written=(".spz",)),
    "splat": Format(module="kissgs.io.splat", endings=(".splat",), written=(".splat",), by_ending=True),
    "ksplat": Format(module="kissgs.io.ksplat", endings=(".ksplat",), by_ending=True),
    "gltf": Format(module="kissgs.io.gltf", endings=(".glb", ".gltf"), written=(".glb", ".spz.glb")),
    "checkpoint": Format(module="kissgs.io.checkpoint", endings=(".pt", ".ckpt"), by_ending=True, is_pickle=True),
}
"""All formats by name. "ply" stands for unknown content too, about which its reader has the best messages."""

ContainerName = Literal["sogxt", "sog"]  # SOG-XT, the default, or SOG of version 2, which other viewers open

CONTAINERS: tuple[ContainerName, ...] = get_args(ContainerName)

ENDINGS: dict[str, ContainerName] = {ending: name for name in CONTAINERS for ending in FORMATS[name].written}
"""Container of a file by its ending."""

SCENE_ENDINGS = tuple(ending for each in FORMATS.values() if not each.is_container for ending in each.endings)
"""Endings of scenes that are no containers."""

MANIFESTS: dict[str, ContainerName] = {LOD_NAME: "sog", LEVELS_NAME: "sogxt"}
"""Containers of a streamed scene by the name of its manifest; the first one decides which is read."""

LEVELS_ENDING = ".sogxt"  # ending of a folder for levels.json
FOLDER_ENDING = ".container"  # ending of folders that the command line names after their scenes

WRITTEN = tuple(ending for each in FORMATS.values() if not each.is_container for ending in each.written)
"""Endings that ``save`` and ``kissgs convert`` write."""

OUTPUT_FORMATS = tuple(ending.removeprefix(".") for ending in WRITTEN)  # what these endings stand for

UPLOADS = {name: each.endings[0] for name, each in FORMATS.items() if each.endings and not each.is_pickle}
"""Formats of one file, which can be sent to a service, and their usual endings."""

DOUBLE_ENDINGS = tuple(ending for ending in WRITTEN if ending.count(".") > 1)

PHOTOGRAPHS = frozenset({".jpg", ".jpeg", ".png", ".webp", ".tif", ".tiff", ".bmp"})
"""Endings of photographs, in lower case; any other suffix is part of the name."""

CAMERA_FILES = frozenset(
    {
        "cameras.bin",
        "images.bin",
        "cameras.txt",
        "images.txt",
        "points3D.bin",
        "points3D.txt",
        "dataparser_transforms.json",
        "transforms.json",
        "transforms_train.json",
        "transforms_test.json",
        "transforms_val.json",
    }
)
"""Names of the files of a capture that have its cameras, and the frame of its scene."""

MAX_PACKED_NAME = 255  # bytes of the name of a file in the archive of a capture, with its folders


def is_packable(name: str) -> bool:
    """Whether a needed file in the archive of a capture may have this name; all kinds of spaces count as printable."""
    return unicodedata.normalize("NFKC", name).isprintable() and len(name.encode()) <= MAX_PACKED_NAME


_SLASHES = tuple({"/", os.sep})


def alternatives(words: Sequence[str]) -> str:
    """Return words as alternatives: "a, b or c"."""
    return " or ".join(filter(None, [", ".join(words[:-1]), words[-1]]))


def output_format(path: Path) -> str:
    """Return the format of :data:`OUTPUT_FORMATS` that the ending of a name stands for."""
    found = [ending for ending in WRITTEN if path.name.lower().endswith(ending)]
    if found:
        return max(found, key=len).removeprefix(".")
    if path.suffix.lower() in ENDINGS:
        raise OutputError(f"{path!s:.100} is the name of a container; kissgs compress writes those")
    raise OutputError(
        f"{path!s:.100} has no ending of a format that is written: {', '.join(WRITTEN)}; choose one of them"
    )


def ending_of(container: ContainerName) -> str:
    """Return the ending of a container's files."""
    return FORMATS[container].written[0]


def names_folder(destination: str | PathLike[str]) -> bool:
    """Whether a name is that of a folder: one that exists, or ends in a slash or in ``.container``. A Path keeps no
    slash: one without an ending is a folder."""
    name = os.fspath(destination)
    ending = Path(f"_{Path(name).name.rstrip('.')}").suffix  # also of ".zip" and "a.zip."
    return (
        name.endswith(_SLASHES)
        or ending == FOLDER_ENDING
        or (not ending and not isinstance(destination, str))
        or os.path.isdir(name)  # noqa: PTH112  Path.is_dir raises where a name is too long
    )


def named_container(requested: str | None, destination: str | PathLike[str] | None) -> ContainerName:
    """Return the container to write: the requested one, else that of the destination's ending, else SOG-XT.

    A destination that ends in neither ``.zip`` nor ``.sog`` is a folder, and must look like one (:func:`names_folder`).
    """
    path = None if destination is None else Path(destination)
    ending = "" if path is None else path.suffix.lower()
    manifest = path is not None and named_manifest(path) is not None
    if manifest or (destination is not None and ending not in ENDINGS and not names_folder(destination)):
        remedy = f"end it in {alternatives(tuple(ENDINGS))}"
        levels = f"FOLDER/{LOD_NAME}, FOLDER/{LEVELS_NAME} or NAME{LEVELS_ENDING}"
        if ending in SCENE_ENDINGS:
            remedy += " (kissgs convert writes other formats)"
        elif ending in (".json", LEVELS_ENDING):
            remedy += f"; levels of detail, which kissgs compress and kissgs.compress_streamed write, are {levels}"
        else:
            remedy += f", or if it is a folder, in a slash; levels of detail are {levels}"
        raise UnsupportedError(f"{destination!s:.100} is not the name of a container: {remedy}")
    by_ending = ENDINGS.get(ending)
    if requested is None:
        return by_ending or "sogxt"
    for name in CONTAINERS:
        if requested == name:
            if by_ending not in (None, name):
                raise UnsupportedError(
                    f"{destination} is not the name of a {name} container: end it in {ending_of(name)}"
                )
            return name
    raise UnsupportedError(f"there is no container {requested!r}; choose one of {', '.join(CONTAINERS)}")


def named_manifest(destination: Path) -> Path | None:
    """Return the manifest of the streamed scene that a destination names; None if it names something else. It is the
    destination itself, or ``levels.json`` in a folder that ends in ``.sogxt``."""
    if destination.name in MANIFESTS:
        return destination
    return destination / LEVELS_NAME if destination.suffix.lower() == LEVELS_ENDING else None
