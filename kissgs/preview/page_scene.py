"""Scenes in the forms that the preview page reads: containers as they are, all others as ``.ply``."""

from __future__ import annotations

import io
import os
from dataclasses import dataclass, replace
from pathlib import Path

from kissgs.core.errors import InvalidSceneError
from kissgs.core.origin import WORLD
from kissgs.core.progress import Progress, silent
from kissgs.io.atomic import reason_of
from kissgs.io.container_names import CONTAINERS, ending_of
from kissgs.io.packed_files import open_source
from kissgs.io.ply import write_ply
from kissgs.pipeline.pipeline import compress
from kissgs.pipeline.read_options import DEFAULT_READ_OPTIONS, ReadOptions
from kissgs.pipeline.scene_files import open_scene
from kissgs.pipeline.scene_formats import recognise, scene_root
from kissgs.sogxt.container import zip_bytes

_MAX_FILE_BYTES = 1 << 30
_FILE_ENDINGS = (".webp", ".json", ".yaml", ".yml")


@dataclass(frozen=True)
class PageScene:
    """A file for the page, which recognises its format by the ending of its name.

    Attributes:
        name: file name, ending in ``.zip``, ``.sog`` or ``.ply``.
        data: content of the file.
        converted: whether the scene came in another format.
        notes: what reading the scene left out or changed, one phrase each.
    """

    name: str
    data: bytes
    converted: bool
    notes: tuple[str, ...] = ()


def page_scene(
    source: Path | bytes, reading: ReadOptions = DEFAULT_READ_OPTIONS, *, threads: int = 0, progress: Progress = silent
) -> PageScene:
    """Return a scene for the page: a SOG-XT or SOG container unchanged, any other format as a ``.ply`` of equal values.

    Args:
        source: path of a scene of any format, or the bytes of its file.
        reading: options for reading it.
        threads: number of threads; 0 means one per processor.
        progress: receives events.

    Raises:
        KissgsError: the scene cannot be read.
    """
    splats, cleaned, _ = open_scene(source, reading, threads, progress)
    notes = (*splats.notes, *cleaned.notes)
    container = _as_container(source, reading)
    if container is not None:
        return replace(container, notes=notes)
    file = io.BytesIO()
    write_ply(file, replace(splats, origin=WORLD), progress=progress)  # viewers draw a scene better near the origin
    return PageScene(f"{_stem(source)}.ply", file.getvalue(), converted=recognise(source) != "ply", notes=notes)


def page_container(
    source: Path | bytes, reading: ReadOptions = DEFAULT_READ_OPTIONS, *, threads: int = 0, progress: Progress = silent
) -> PageScene:
    """Return a scene as a container: SOG-XT or SOG unchanged, any other format compressed by the preset ``balanced``.

    The parameters and errors are those of :func:`page_scene`.
    """
    container = _as_container(source, reading)
    if container is not None:  # whoever gets the page cannot mend a damaged one
        splats, cleaned, _ = open_scene(source, reading, threads, progress)
        return replace(container, notes=(*splats.notes, *cleaned.notes))
    result = compress(source, reading=reading, threads=threads, progress=progress)
    notes = tuple(filter(None, (result.report.note, *result.report.cleaned.notes)))
    return PageScene(f"{_stem(source)}.zip", result.to_zip(), converted=True, notes=notes)


def _as_container(source: Path | bytes, reading: ReadOptions) -> PageScene | None:
    """Return the zip of a container, None for other formats. The files of a folder are packed.

    A container is not shown as it is if its mark of antialiasing does not count.
    """
    found = recognise(source)
    kind = next((kind for kind in CONTAINERS if kind == found), None)
    if kind is None or reading.antialiased is not None:
        return None
    root = scene_root(source) if isinstance(source, Path) else source
    name = f"{_stem(source)}{ending_of(kind)}"
    if isinstance(root, bytes):
        return PageScene(name, root, converted=False)
    if not root.is_dir():
        try:
            return PageScene(name, root.read_bytes(), converted=False)
        except OSError as error:
            raise InvalidSceneError(f"cannot read {root!s:.100}: {reason_of(error)}") from error
    with open_source(root) as files:
        names = sorted(name for name in files.names() if name.endswith(_FILE_ENDINGS))
        return PageScene(name, zip_bytes({name: files.read(name, _MAX_FILE_BYTES) for name in names}), converted=False)


def _stem(source: Path | bytes) -> str:
    """Return the name of a scene without its ending, in characters that UTF-8 has."""
    if isinstance(source, bytes):
        return "scene"
    root = scene_root(source).absolute()
    return os.fsencode(root.name if root.is_dir() else root.stem).decode(errors="replace") or "scene"
