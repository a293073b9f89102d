"""The work folder of a streamed scene: whose work it holds, its room on the disk, and the last step of the work."""

from __future__ import annotations

import contextlib
import errno
import fcntl
import json
import os
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any, BinaryIO

from kissgs.core.errors import OutputError
from kissgs.formats import MANIFESTS
from kissgs.io.files import move_into_place, path_state, reason_of
from kissgs.io.streamed import MAX_TREE_BYTES
from kissgs.sog import FILES
from kissgs.streaming.build import CHUNK
from kissgs.streaming.layout import OUT, continuation, write_json
from kissgs.streaming.levels import row_bytes

WORK, LOCK = "work.json", "lock"  # files: which work the folder belongs to; locked by the process that works in it
TEMPORARY = ".kissgs."  # beginning of the names of files that are being written
ENCODED_BYTES = 30  # upper estimate of the encoded bytes of a Gaussian with all its levels


def check_destination(manifest: Path, source: Path, *, overwrite: bool) -> None:
    """Refuse to replace anything but a streamed scene, and that only if allowed."""
    folder, remedy = manifest.parent, f"name {manifest.name} in a new folder"
    present, is_folder = path_state(folder)
    if not folder.name:
        raise OutputError(f"{folder} cannot be replaced; {remedy}")
    if not present:
        return
    if not is_folder or folder.is_symlink() or folder.is_mount():
        what = "a link" if folder.is_symlink() else "a mount point" if is_folder else "a file"
        raise OutputError(f"{folder} is {what} and cannot be replaced as a whole; {remedy}")
    for inside, what in ((Path.cwd(), "the current folder"), (source.resolve(), "the input")):
        if inside.is_relative_to(folder.resolve()):
            where = f"is {what}" if inside == folder.resolve() else f"has {what} in it"
            raise OutputError(f"{folder} would be replaced as a whole, but {where}; {remedy}")
    ours = _paths_of(folder)
    found = (path.relative_to(folder) for path in folder.rglob("*"))
    if strange := next((path for path in found if path not in ours), None):
        raise OutputError(f"{folder} holds other files ({strange}); {remedy}")
    if any(folder.iterdir()) and not overwrite:
        raise OutputError(f"{manifest} exists already; choose another name or allow overwriting (--force)")


def _paths_of(folder: Path) -> set[Path]:
    """Return the relative paths of all files and folders of the streamed scenes whose manifests are in a folder."""
    found: set[Path] = set()
    for manifest, container in MANIFESTS.items():
        document = read_json(folder / manifest)
        if not isinstance(document, dict) or not isinstance(document.get("filenames"), list):
            continue
        environment = document.get("environment")
        named = [Path(str(name)) for name in (*document["filenames"], *([environment] if environment else ()))]
        if container == "sog":
            files = [path.parent / name for path in named for name in FILES]
        else:
            files = [path for path in named if path.suffix == ".zip"]
        found |= {Path(manifest), *files, *(above for path in files for above in path.parents)}
    return found


@contextlib.contextmanager
def claimed(work: Path, mine: dict[str, Any]) -> Iterator[None]:
    """Make the work folder, or check that the one that is there belongs to the same work; keep others out meanwhile."""
    try:
        if work.is_symlink():
            raise OutputError(f"{work} is a link; delete it, or choose another name")
        work.mkdir(exist_ok=True)
        strange = (path for path in work.iterdir() if path.name != LOCK and not path.name.startswith(TEMPORARY))
        if not (work / WORK).exists() and any(strange):
            raise OutputError(f"{work} holds other files; choose another name")
        lock = (work / LOCK).open("ab")
    except OSError as error:
        raise OutputError(f"cannot make {work}: {reason_of(error)}") from error
    with lock:
        if not _locked(lock):
            raise OutputError(f"another process works in {work}; wait for it, or choose another name")
        if (work / WORK).exists() and read_json(work / WORK) != mine:
            raise OutputError(f"{work} belongs to other or older work; delete it, or choose another name")
        for left in (*work.glob(f"{TEMPORARY}*"), *(work / OUT).glob(f"{TEMPORARY}*"), _discarded(work)):
            with contextlib.suppress(OSError):  # of a process that was killed
                shutil.rmtree(left) if left.is_dir() else left.unlink()
        write_json(work / WORK, mine)
        try:
            yield
        except OutputError as error:
            if not any(os.strerror(number).lower() in str(error) for number in (errno.ENOSPC, errno.EDQUOT)):
                raise
            raise OutputError(f"{error}; once there is room, {continuation(work)}") from error


def _locked(lock: BinaryIO) -> bool:
    """Lock a file until it is closed, or the process ends; return False if another process has locked it."""
    try:
        fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    except OSError:  # a network file system without locks
        return True
    return True


def needed_bytes(count: int, sh_degree: int) -> int:
    """Return the most bytes that the work folder takes: all levels as float32, a chunk once more, and the result."""
    return (2 * count + min(count, CHUNK)) * row_bytes(sh_degree) + count * ENCODED_BYTES


def megabytes(count: float) -> str:
    """Format bytes: "10,622 MB", and below one megabyte "34 kB"."""
    return f"{count / 1e6:,.0f} MB" if count >= 1e6 else f"{count / 1e3:,.0f} kB"


def check_space(work: Path, needed: int) -> None:
    """Check, before the partition, that the disk has room for the work folder; what is in it counts as free."""
    present = sum(path.stat().st_size for path in work.rglob("*") if path.is_file())
    free = shutil.disk_usage(work).free
    if needed - present > free:
        raise OutputError(
            f"{work} will take up to {megabytes(needed)}, but its disk has {megabytes(free)} free; "
            "free some, or write to another disk"
        )


def finish(work: Path, manifest: Path, source: Path, *, overwrite: bool) -> None:
    """Move the result into place, and delete the work folder; may be repeated after an interruption anywhere. The work
    folder is renamed before it is deleted: a part of it would look like other work."""
    result = work / OUT
    if (result / manifest.name).exists():
        check_destination(manifest, source, overwrite=overwrite)
        move_into_place(result, manifest.parent)
    elif not manifest.exists():
        raise OutputError(f"{work} was complete, but its result is gone; delete it and start again")
    try:
        work.rename(_discarded(work))
        shutil.rmtree(_discarded(work))
    except OSError as error:
        raise OutputError(f"cannot delete {work}: {reason_of(error)}") from error


def remove(work: Path) -> None:
    """Delete a claimed work folder whose work is of no use; what cannot be deleted stays. The files by which
    :func:`claimed` recognises it are the last to go, so that after an interruption anywhere the same command may begin
    anew."""
    with contextlib.suppress(OSError):
        for path in work.iterdir():
            if path.name not in (WORK, LOCK):
                shutil.rmtree(path) if path.is_dir() else path.unlink()
        (work / WORK).unlink(missing_ok=True)
        (work / LOCK).unlink()
        work.rmdir()


def _discarded(work: Path) -> Path:
    """Return the name under which a work folder is deleted."""
    return work.with_name(f"{TEMPORARY}{work.name}.old")


def read_json(path: Path) -> Any:  # noqa: ANN401  any JSON
    """Return the JSON of a file; None if it is missing, incomplete, or larger than a manifest may be."""
    try:
        with path.open("rb") as file:
            data = file.read(MAX_TREE_BYTES + 1)
        return json.loads(data) if len(data) <= MAX_TREE_BYTES else None
    except (OSError, ValueError, RecursionError):
        return None
