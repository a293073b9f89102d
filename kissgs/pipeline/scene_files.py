"""Scenes in files: read a ``.ply`` or a container, write a ``.ply``."""

from __future__ import annotations

import io
from os import PathLike
from pathlib import Path

from kissgs.core.errors import InvalidContainerError, OutputError
from kissgs.core.progress import Progress, silent
from kissgs.core.splats import Cleaned, Splats, clean
from kissgs.io.atomic import atomic_file, reason_of, refuse_existing
from kissgs.io.packed_files import sniff_format
from kissgs.io.ply import read_ply, write_ply
from kissgs.sogxt.container import is_packed
from kissgs.sogxt.decode import MAX_GAUSSIANS, decode

AnyPath = str | PathLike[str]


def load(path: AnyPath, *, max_gaussians: int = MAX_GAUSSIANS, threads: int = 0, progress: Progress = silent) -> Splats:
    """Read and clean a scene: a ``.ply`` of any common 3DGS tool, or a SOG-XT container (zip or folder).

    A container with more than ``max_gaussians`` is refused before memory is allocated for them.

    Raises:
        InvalidSceneError: the ``.ply`` is not a usable scene.
        InvalidContainerError: the container is damaged.
        UnsupportedError: the file is valid, but uses a feature that kissgs does not read.
    """
    return clean(_read(Path(path), threads, progress, max_gaussians))[0]


def save(splats: Splats, path: AnyPath, *, overwrite: bool = False, progress: Progress = silent) -> None:
    """Write a scene atomically as ``.ply`` (binary, INRIA layout, at the scene's own SH degree).

    To write a container, use :func:`compress`.

    Raises:
        OutputError: the file exists and ``overwrite`` is false, its name does not end in ``.ply``, or writing fails.
    """
    path = Path(path)
    check_ply(path, overwrite=overwrite)
    with atomic_file(path, overwrite=overwrite) as file:
        write_ply(file, splats, progress=progress)


def is_container(source: Path | bytes) -> bool:
    """Whether a source is a container rather than a ``.ply``; every command decides by this function.

    A folder is a container, and so is a zip under any name, also with a prefix such as a self-extractor. If the file
    cannot be opened, the ending ``.zip`` decides.
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


def check_ply(path: Path, *, overwrite: bool) -> None:
    """Check that a scene can be written to ``path``.

    Raises:
        OutputError: the ending is not ``.ply``, the file exists and ``overwrite`` is false, or there is no such folder.
    """
    if path.suffix.lower() != ".ply":
        raise OutputError(f"{path}: a scene is written as .ply; use compress to write a container")
    refuse_existing(path, overwrite=overwrite)


def open_scene(source: Splats | AnyPath | bytes, threads: int, progress: Progress) -> tuple[Splats, Cleaned, int]:
    """Read and clean a scene; return it, the defects that were corrected, and the bytes of the source.

    Raises:
        KissgsError: the scene cannot be read.
    """
    if isinstance(source, Splats):
        splats, cleaned = clean(source)
        return splats, cleaned, source.nbytes
    progress("read", 0.0)
    scene = source if isinstance(source, bytes) else Path(source)
    splats, cleaned = clean(_read(scene, threads, progress))
    return splats, cleaned, len(scene) if isinstance(scene, bytes) else stored_bytes(scene)


def _read(source: Path | bytes, threads: int, progress: Progress, max_gaussians: int = MAX_GAUSSIANS) -> Splats:
    """Read a scene without cleaning; the limit is for containers, whose decoded size can be far above their bytes."""
    if is_container(source):
        return decode(source, max_gaussians=max_gaussians, threads=threads, progress=progress)
    return read_ply(source, progress=progress)


def stored_bytes(path: Path) -> int:
    """Return the size of a file, or of all files in a folder, in bytes.

    Raises:
        InvalidContainerError: the path cannot be read.
    """
    try:
        return sum(entry.stat().st_size for entry in path.iterdir()) if path.is_dir() else path.stat().st_size
    except OSError as error:
        raise InvalidContainerError(f"cannot read {path}: {reason_of(error)}") from error
