"""Recognition of scene formats: by content where a format has a mark, else by the ending of the name."""

from __future__ import annotations

import io
from collections.abc import Collection, Mapping
from pathlib import Path
from typing import Literal

from kissgs.core.errors import InvalidContainerError
from kissgs.io.container_names import ENDINGS, LEVELS_NAME, LOD_NAME, SCENE_ENDINGS
from kissgs.io.json_files import parse_json
from kissgs.io.packed_files import ZIP_MAGICS, MemorySource, Source, open_source, sniff_format, zip_names
from kissgs.io.scene_file import listed
from kissgs.sog.names import MAX_METADATA_BYTES, META_NAME
from kissgs.sogxt.container import is_packed
from kissgs.sogxt.names import YAML_NAME

SceneFormat = Literal["ply", "sogxt", "sog", "streamed-sog", "streamed-sogxt", "spz", "splat", "ksplat", "gltf"]
"""All formats that are read. "ply" stands for unknown content too, about which its reader has the best messages."""

STREAMED_FORMATS: frozenset[SceneFormat] = frozenset({"streamed-sog", "streamed-sogxt"})
"""Formats with levels of detail."""

CONTAINER_FORMATS: frozenset[SceneFormat] = STREAMED_FORMATS | {"sogxt", "sog"}
"""Formats whose metadata describes them without decoding an image."""

HEAD_BYTES = 512
"""Bytes at the beginning of a file that recognition needs."""

_STREAMED: dict[str, SceneFormat] = {LOD_NAME: "streamed-sog", LEVELS_NAME: "streamed-sogxt"}
"""Format of streamed scenes by the name of their manifest, the first of which decides."""

_WITHOUT_MARK: dict[str, SceneFormat] = {".splat": "splat", ".ksplat": "ksplat"}

_ENDINGS: dict[str, SceneFormat] = {".spz": "spz", ".glb": "gltf", ".gltf": "gltf", ".sog": "sog"}
"""Format of files whose content is not recognised: damaged ones, about which the reader says more."""


def recognise(
    source: Path | bytes | Mapping[str, bytes], *, name: str | None = None, size: int | None = None
) -> SceneFormat:
    """Return the format of a scene: a file, a folder, the bytes of a file, or a container's files in memory.

    The metadata file of a container and the manifest of a streamed scene stand for their folder. ``.splat`` is
    recognised by its name only.

    Args:
        source: the scene, or the first 512 bytes of a file, of which every zip then counts as "sogxt".
        name: name of the file, if ``source`` has none or another one.
        size: bytes of the whole file, if ``source`` is only its beginning.

    Raises:
        InvalidContainerError: a folder holds no container and no streamed scene.
    """
    if isinstance(source, Mapping):
        return _container_format(MemorySource(source))
    name = ("" if isinstance(source, bytes) else source.name) if name is None else name
    name = name.lower()
    ending = Path(name).suffix
    if isinstance(source, Path) and (_is_folder(source) or scene_root(source) != source):
        _check_folder(scene_root(source))
        return _STREAMED.get(name) or _packed_format(scene_root(source), "sogxt")
    head, found_size = _beginning(source)
    if marked := _by_mark(head):
        return marked
    if ending in _WITHOUT_MARK and head[:4] not in ZIP_MAGICS:
        return _WITHOUT_MARK[ending]
    if is_container(source):
        return _packed_format(source, "sog" if ending == ".sog" else "sogxt")
    from kissgs.io.ksplat import is_ksplat

    if is_ksplat(head, found_size if size is None else size):
        return "ksplat"
    if ending not in _ENDINGS and _is_json(head):
        return "gltf"
    return _ENDINGS.get(ending, "ply")


def scene_root(path: Path) -> Path:
    """Return the folder of a container or streamed scene if ``path`` is its metadata or manifest, else ``path``."""
    return path.parent if path.name in (META_NAME, *_STREAMED) and path.is_file() else path


def is_container(source: Path | bytes) -> bool:
    """Whether a source is a folder or a zip, rather than another file.

    A zip may have any name, and a prefix such as a self-extractor. If the file cannot be opened, the ending ``.zip``
    decides.
    """
    if isinstance(source, bytes):
        return sniff_format(io.BytesIO(source)) == "zip"
    try:
        if source.is_dir():
            return True
        if source.is_file():  # opening a named pipe would block
            with source.open("rb") as file:
                return sniff_format(file) == "zip"
    except (OSError, ValueError):
        pass
    return is_packed(source)


def _is_folder(path: Path) -> bool:
    try:
        return path.is_dir()
    except (OSError, ValueError):
        return False


def _check_folder(folder: Path) -> None:
    """Refuse a folder that is no container, and name the scenes in it, or below it where INRIA's trainer puts them."""
    try:
        if any((folder / name).is_file() for name in (YAML_NAME, META_NAME, *_STREAMED)):
            return
        found = [path for pattern in ("*", "point_cloud/iteration_*/*") for path in sorted(folder.glob(pattern))]
        scenes = [path for path in found if path.suffix.lower() in (*ENDINGS, *SCENE_ENDINGS) and path.is_file()]
    except (OSError, ValueError):
        return  # the reader says why
    if scenes:
        names = listed([str(path.relative_to(folder)) for path in scenes])
        raise InvalidContainerError(f"{folder!s:.200} is a folder, not a scene; name a file in it: {names}")
    raise InvalidContainerError(
        f"{folder!s:.200} is a folder without a scene: it has neither {YAML_NAME} nor {META_NAME}, {LOD_NAME} or "
        f"{LEVELS_NAME}; name the file of a scene, or the folder of a container"
    )


def _beginning(source: Path | bytes) -> tuple[bytes, int]:
    """Return the first bytes and the size of a file; nothing of what cannot be read."""
    if isinstance(source, bytes):
        return source[:HEAD_BYTES], len(source)
    try:
        if source.is_file():  # opening a named pipe would block
            with source.open("rb") as file:
                return file.read(HEAD_BYTES), source.stat().st_size
    except (OSError, ValueError):
        pass
    return b"", 0


def _by_mark(head: bytes) -> SceneFormat | None:
    if head[:3] == b"ply" and head[3:4].isspace():
        return "ply"
    if head[:4] in ZIP_MAGICS:  # the modules of other formats need not be loaded
        return None
    from kissgs.io.gltf_document import GLB_MAGIC
    from kissgs.io.spz import is_spz

    if head.startswith(GLB_MAGIC):
        return "gltf"
    return "spz" if is_spz(head) else None


def _is_json(head: bytes) -> bool:
    start = head.removeprefix(b"\xef\xbb\xbf").lstrip()
    return start.startswith(b"{") and not any(byte < 32 and byte not in b"\t\r\n" for byte in start)


def _packed_format(source: Path | bytes, damaged: SceneFormat) -> SceneFormat:
    """Return the format of a folder or a zip; ``damaged`` if it cannot be read, whose reader then says why."""
    try:
        if isinstance(source, bytes) or not _is_folder(source):
            with _opened(source) as file:
                names = {name.replace("\\", "/").rsplit("/", 1)[-1] for name in zip_names(file)}
            if found := _streamed_format(names):
                return found
        with open_source(source) as files:
            return _container_format(files, damaged)
    except (InvalidContainerError, OSError, ValueError):
        return damaged


def _opened(source: Path | bytes) -> io.BufferedIOBase:
    return io.BytesIO(source) if isinstance(source, bytes) else source.open("rb")


def _streamed_format(names: Collection[str]) -> SceneFormat | None:
    return next((kind for manifest, kind in _STREAMED.items() if manifest in names), None)


def _container_format(files: Source, unknown: SceneFormat = "sogxt") -> SceneFormat:
    """Tell the containers apart: only SOG-XT has a YAML file, and a mask in ``meta.json``."""
    names = files.names()
    if found := _streamed_format(names):
        return found
    if YAML_NAME in names or META_NAME not in names:
        return "sogxt" if YAML_NAME in names else unknown
    try:
        document = parse_json(files.read(META_NAME, MAX_METADATA_BYTES), META_NAME)
    except InvalidContainerError:
        return unknown
    plain = isinstance(document, dict) and "means" in document and document.keys().isdisjoint({"mask", "gridSide"})
    return "sog" if plain else unknown
