"""The work folder of a streamed scene: whose work it holds, its room on the disk, and the last step of the work."""

from __future__ import annotations

import contextlib
import json
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any, BinaryIO

from kissgs.core.errors import OutputError
from kissgs.io.atomic import atomic_file, path_state, reason_of
from kissgs.sog.encode import SHN
from kissgs.sog.names import LOD_NAME, META_NAME
from kissgs.streaming.build import OUT
from kissgs.streaming.rows import row_bytes

WORK, LOCK = "work.json", "lock"
"""Files: which work the folder belongs to; locked by the process that works in it."""

TEMPORARY = ".kissgs."
"""Beginning of the names of files that are being written."""

SOG_FILES = (META_NAME, "means_l.webp", "means_u.webp", "quats.webp", "scales.webp", "sh0.webp", *SHN)
"""Files of a container."""

REPLACED = "replaced"
"""Folder for what the result replaces, until the result is in place."""

ENCODED_BYTES = 30
"""Upper estimate of the encoded bytes of a Gaussian with all its levels."""


def check_destination(folder: Path, overwrite: bool) -> None:
    """Refuse to replace anything but a streamed scene, and that only if allowed.

    Raises:
        OutputError: the folder holds something else, or a scene that may not be replaced.
    """
    present, is_folder = path_state(folder)
    if not folder.name or (present and folder.samefile(".")):
        raise OutputError(
            f"a streamed scene replaces its whole folder; name {LOD_NAME} in a new folder, not in {folder}"
        )
    if present and (not is_folder or folder.is_symlink()):
        raise OutputError(f"{folder} is no folder of its own; name {LOD_NAME} in a new folder")
    if not present:
        return
    found = {path.relative_to(folder) for path in folder.rglob("*") if not path.is_dir() or path.is_symlink()}
    if strange := found - _files_of(folder / LOD_NAME):
        raise OutputError(f"{folder} holds other files ({min(strange)}); name {LOD_NAME} in a new folder")
    if found and not overwrite:
        raise OutputError(f"{folder / LOD_NAME} exists already; choose another name or allow overwriting (--force)")


def _files_of(manifest: Path) -> set[Path]:
    """Return the relative paths of the files that a streamed SOG may have; none if there is no manifest."""
    document = read_json(manifest)
    if not isinstance(document, dict) or not isinstance(document.get("filenames"), list):
        return set()
    folders = [Path(str(name)).parent for name in document["filenames"]]
    return {Path(LOD_NAME), *(folder / name for folder in folders for name in SOG_FILES)}


@contextlib.contextmanager
def claimed(work: Path, mine: dict[str, Any]) -> Iterator[None]:
    """Make the work folder, or check that the one that is there belongs to the same work; keep others out meanwhile.

    Args:
        work: the work folder.
        mine: JSON that identifies the work: its input, settings and version.

    Raises:
        OutputError: it belongs to other work, another process works in it, or it cannot be written.
    """
    try:
        if work.exists() and not (work / WORK).exists() and _names(work) - {LOCK, OUT}:
            raise OutputError(f"{work} holds other files; choose another name")
        work.mkdir(exist_ok=True)
        (work / OUT).mkdir(exist_ok=True)
        lock = (work / LOCK).open("ab")
    except OSError as error:
        raise OutputError(f"cannot make {work}: {reason_of(error)}") from error
    with lock:
        if not _locked(lock):
            raise OutputError(f"another process works in {work}; wait for it, or choose another name")
        _take_over(work, mine)
        yield


def _names(work: Path) -> set[str]:
    return {path.name for path in work.iterdir() if not path.name.startswith(TEMPORARY)}


def _take_over(work: Path, mine: dict[str, Any]) -> None:
    """Check whose work a work folder holds, and remove what a killed process was writing."""
    try:
        if _names(work) - {LOCK, OUT} and read_json(work / WORK) != mine:
            raise OutputError(f"{work} belongs to other or older work; delete it, or choose another name")
        for left in (*work.glob(f"{TEMPORARY}*"), *(work / OUT).glob(f"{TEMPORARY}*")):
            shutil.rmtree(left) if left.is_dir() else left.unlink()
    except OSError as error:
        raise OutputError(f"cannot use {work}: {reason_of(error)}") from error
    with atomic_file(work / WORK, overwrite=True) as file:
        file.write(json.dumps(mine).encode())


def _locked(lock: BinaryIO) -> bool:
    """Lock a file until it is closed, or the process ends; return False if another process has locked it."""
    try:
        import fcntl
    except ImportError:  # Windows
        return True
    try:
        fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    return True


def needed_bytes(count: int, sh_degree: int) -> int:
    """Return the most bytes that the work folder takes: the Gaussians of all levels as float32, and the result."""
    return count * (2 * row_bytes(sh_degree) + ENCODED_BYTES)


def check_space(work: Path, needed: int) -> None:
    """Check that the disk has room for what the work folder still lacks.

    Raises:
        OutputError: the disk is too full.
    """
    present = sum(path.stat().st_size for path in work.rglob("*") if path.is_file())
    free = shutil.disk_usage(work).free
    if needed - present > free:
        raise OutputError(
            f"{work} will take up to {needed / 1e6:,.0f} MB, but its disk has {free / 1e6:,.0f} MB free; "
            "free some, or write to another disk"
        )


def finish(work: Path, folder: Path) -> None:
    """Move the result into place, and delete the work folder; may be repeated after an interruption anywhere.

    Raises:
        OutputError: the result cannot be moved.
    """
    out, replaced = work / OUT, work / REPLACED
    try:
        if out.exists():
            if folder.exists():
                folder.rename(replaced)
            out.rename(folder)
        shutil.rmtree(work)
    except OSError as error:
        raise OutputError(f"cannot write {folder}: {reason_of(error)}") from error


def read_json(path: Path) -> Any:  # noqa: ANN401  any JSON
    """Return the JSON of a file; None if it is missing or incomplete."""
    try:
        return json.loads(path.read_bytes())
    except (OSError, ValueError):
        return None
