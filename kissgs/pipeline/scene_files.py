"""Scenes in files: reading whatever holds one, writing ``.ply``."""

from __future__ import annotations

import io
from os import PathLike
from pathlib import Path

from kissgs.core.errors import InvalidContainerError, OutputError
from kissgs.core.progress import Progress, silent
from kissgs.core.splats import Cleaned, Splats, clean
from kissgs.io.atomic import atomic_file, reason_of, refuse_existing
from kissgs.io.ply import read_ply, write_ply
from kissgs.sogxt.container import is_packed, kind_of
from kissgs.sogxt.decode import MAX_GAUSSIANS, decode

AnyPath = str | PathLike[str]


def load(path: AnyPath, *, max_gaussians: int = MAX_GAUSSIANS, threads: int = 0, progress: Progress = silent) -> Splats:
    """Read a scene: a ``.ply`` of any of the field's tools, or a SOG-XT container (zip or folder); cleaned.

    A container with more than ``max_gaussians`` is refused before memory is taken for them.

    Raises:
        InvalidSceneError: the ``.ply`` is not a usable scene.
        InvalidContainerError: the container is damaged.
        UnsupportedError: something valid that kissgs does not read.
    """
    return clean(_read(Path(path), threads, progress, max_gaussians))[0]


def save(splats: Splats, path: AnyPath, *, overwrite: bool = False, progress: Progress = silent) -> None:
    """Write a scene as ``.ply`` (binary, INRIA layout, at its own SH degree), whole or not at all.

    For containers there is :func:`compress`.

    Raises:
        OutputError: it exists and ``overwrite`` is false, its name does not end in ``.ply``, or the disk refuses.
    """
    path = Path(path)
    check_ply(path, overwrite=overwrite)
    with atomic_file(path, overwrite=overwrite) as file:
        write_ply(file, splats, progress=progress)


def is_container(source: Path | bytes) -> bool:
    """Whether this is a container rather than a ``.ply``, as far as a look at it tells; every command asks here.

    A folder is one, and a zip under any name, whatever stands before it; of what cannot be opened, what is named .zip.
    """
    if isinstance(source, bytes):
        return kind_of(io.BytesIO(source)) == "zip"
    try:
        if source.is_dir():
            return True
        if source.is_file():  # a pipe would keep us waiting
            with source.open("rb") as file:
                return kind_of(file) == "zip"
    except (OSError, ValueError):
        pass
    return is_packed(source)


def check_ply(path: Path, *, overwrite: bool) -> None:
    """See that a scene can be written there.

    Raises:
        OutputError: it cannot.
    """
    if path.suffix.lower() != ".ply":
        raise OutputError(f"{path}: only .ply files are written here; use compress for containers")
    refuse_existing(path, overwrite=overwrite)


def open_scene(source: Splats | AnyPath | bytes, threads: int, progress: Progress) -> tuple[Splats, Cleaned, int]:
    """A scene, cleaned, what was mended, and its bytes.

    Raises:
        KissgsError: it cannot be had.
    """
    if isinstance(source, Splats):
        splats, cleaned = clean(source)
        return splats, cleaned, source.nbytes
    progress("read", 0.0)
    scene = source if isinstance(source, bytes) else Path(source)
    splats, cleaned = clean(_read(scene, threads, progress))
    return splats, cleaned, len(scene) if isinstance(scene, bytes) else stored_bytes(scene)


def _read(source: Path | bytes, threads: int, progress: Progress, max_gaussians: int = MAX_GAUSSIANS) -> Splats:
    """As it stands in the file; the limit is for containers, which can hold far more than they weigh."""
    if is_container(source):
        return decode(source, max_gaussians=max_gaussians, threads=threads, progress=progress)
    return read_ply(source, progress=progress)


def stored_bytes(path: Path) -> int:
    """Of a file, or of all files in a folder.

    Raises:
        InvalidContainerError: the file system refuses.
    """
    try:
        return sum(entry.stat().st_size for entry in path.iterdir()) if path.is_dir() else path.stat().st_size
    except OSError as error:
        raise InvalidContainerError(f"cannot read {path}: {reason_of(error)}") from error
