"""Atomic output: a temporary file beside the destination, renamed when it is complete."""

from __future__ import annotations

import contextlib
import os
import shutil
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import BinaryIO

from kissgs.core.errors import OutputError

BLOCK = 4096
"""Bytes that :func:`check_writable` writes: at least one block of the file system."""


@contextlib.contextmanager
def atomic_file(path: Path, *, overwrite: bool = False) -> Iterator[BinaryIO]:
    """Open a binary file that replaces ``path`` when the block succeeds, and is deleted when it fails.

    Raises:
        OutputError: ``path`` exists and ``overwrite`` is false, or the file system refuses.
    """
    refuse_existing(path, overwrite=overwrite)
    temporary: Path | None = None
    try:
        descriptor, name = tempfile.mkstemp(dir=path.parent, prefix=".kissgs.", suffix=".part")
        temporary = Path(name)
        with os.fdopen(descriptor, "wb") as file:
            yield file
            file.flush()
            os.fsync(file.fileno())
        temporary.chmod(0o666 & ~umask())
        temporary.replace(path)
    except OSError as error:
        raise OutputError(f"cannot write {path}: {reason_of(error)}") from error
    finally:
        if temporary is not None:
            temporary.unlink(missing_ok=True)


def move_into_place(made: Path, path: Path) -> None:
    """Rename a complete file or folder to ``path`` on the same file system, replacing what is there.

    Raises:
        OutputError: the file system refuses; what was there stays.
    """
    old: Path | None = None
    try:
        if path.is_dir():
            old = path.rename(made.with_suffix(".old"))
        made.replace(path)
    except OSError as error:
        raise OutputError(f"cannot write {path}: {reason_of(error)}") from error
    finally:
        # After any end of the block, also an interrupt: the old folder is removed only if the new one is there.
        if old is not None and not path.exists():
            old.rename(path)
        elif old is not None:
            shutil.rmtree(old)


def refuse_existing(path: Path, *, overwrite: bool) -> None:
    """Raise OutputError if no file can be written to ``path``; called before the work starts."""
    present, folder = path_state(path)
    if folder:
        raise OutputError(f"{path} is a folder; name a file")
    if present and not overwrite:
        raise OutputError(f"{path} exists already; choose another name or allow overwriting (--force)")
    check_writable(path)


def check_writable(path: Path) -> None:
    """Raise OutputError if no file can be written beside ``path``; called before the work starts."""
    try:
        with tempfile.TemporaryFile(dir=path.parent, prefix=".kissgs.", suffix=".part") as file:
            file.write(bytes(BLOCK))  # on a full disk, creating a file succeeds, but writing fails
    except OSError as error:
        raise OutputError(f"cannot write {path}: {reason_of(error)}") from error


def path_state(path: Path) -> tuple[bool, bool]:
    """Return whether ``path`` exists, and whether it is a folder.

    Raises:
        OutputError: the parent folder does not exist, or the name is invalid.
    """
    try:
        present, folder, above = False, path.is_dir(), path.absolute().parent.is_dir()
        with contextlib.suppress(FileNotFoundError):
            path.lstat()
            present = True  # also for a broken link
    except (OSError, ValueError) as error:
        raise OutputError(f"cannot write {path!s:.100}: {reason_of(error)}") from error
    if not above:
        raise OutputError(f"cannot write {path}: there is no folder {path.parent}; make it first")
    return present, folder


def umask() -> int:
    """Return the umask: the permission bits that new files of this process do not get."""
    try:
        status = Path("/proc/self/status").read_text(encoding="ascii", errors="replace")
        return int(status.split("Umask:", 1)[1].split(maxsplit=1)[0], 8)
    except (OSError, IndexError, ValueError):
        current = os.umask(0o022)  # other systems can only return it while setting it, briefly for all threads
        os.umask(current)
        return current


def reason_of(error: OSError | ValueError) -> str:
    """Return the system's reason, as the end of a sentence; ValueError is an invalid name, such as one with NUL."""
    reason = error.strerror if isinstance(error, OSError) and error.strerror else str(error)
    return reason.lower()
