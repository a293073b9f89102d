"""Output that appears whole or not at all: written beside its destination, then renamed into place."""

from __future__ import annotations

import contextlib
import os
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import BinaryIO

from kissgs.core.errors import OutputError

BLOCK = 4096
"""Bytes, for which a file system takes at least one block of its own."""


@contextlib.contextmanager
def atomic_file(path: Path, *, overwrite: bool = False) -> Iterator[BinaryIO]:
    """A binary file that replaces ``path`` when the block ends well, and vanishes when it does not.

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


def refuse_existing(path: Path, *, overwrite: bool) -> None:
    """Raise OutputError if ``path`` cannot become a file: before the work starts, rather than after it."""
    present, folder = look(path)
    if folder:
        raise OutputError(f"{path} is a folder; name a file")
    if present and not overwrite:
        raise OutputError(f"{path} exists already; choose another name or allow overwriting (--force)")
    try_out(path)


def try_out(path: Path) -> None:
    """Raise OutputError if nothing can be written beside ``path``: before the work starts, rather than after it."""
    try:
        with tempfile.TemporaryFile(dir=path.parent, prefix=".kissgs.", suffix=".part") as file:
            file.write(bytes(BLOCK))  # a full disk takes names, but no bytes
    except OSError as error:
        raise OutputError(f"cannot write {path}: {reason_of(error)}") from error


def look(path: Path) -> tuple[bool, bool]:
    """Whether there is something at ``path``, and whether it is a folder.

    Raises:
        OutputError: there is no folder to put it in, or no file system would take the name.
    """
    try:
        present, folder, above = False, path.is_dir(), path.absolute().parent.is_dir()
        with contextlib.suppress(FileNotFoundError):
            path.lstat()
            present = True  # even if it is a link that leads nowhere
    except (OSError, ValueError) as error:
        raise OutputError(f"cannot write {path!s:.100}: {reason_of(error)}") from error
    if not above:
        raise OutputError(f"cannot write {path}: there is no folder {path.parent}")
    return present, folder


def umask() -> int:
    """The permission bits that new files of this process do not get."""
    try:
        status = Path("/proc/self/status").read_text(encoding="ascii", errors="replace")
        return int(status.split("Umask:", 1)[1].split(maxsplit=1)[0], 8)
    except (OSError, IndexError, ValueError):
        current = os.umask(0o022)  # elsewhere, asking means setting, for all threads for a moment
        os.umask(current)
        return current


def reason_of(error: OSError | ValueError) -> str:
    """Why the system refused, as the end of a sentence; ValueError is a name that it cannot even be asked about."""
    reason = error.strerror if isinstance(error, OSError) and error.strerror else str(error)
    return reason.lower()
