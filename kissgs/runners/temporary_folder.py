"""``temporary_folder``: a folder of one item on the disk of the machine that runs it.

    TEMP/kissgs-item-TOKEN.lock    locked by the process that made it, as long as it lives
    TEMP/kissgs-item-TOKEN/        the current folder of the item's process, made once the lock is held

TEMP is the system's folder for temporary files (``TMPDIR``). Whoever starts the item's process removes both when that
has ended. If it is killed itself, they stay, and the next item that starts on the machine removes them: a lock that can
be taken has no owner.
"""

from __future__ import annotations

import contextlib
import fcntl
import os
import shutil
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import IO

PREFIX, LOCK = "kissgs-item-", ".lock"


@contextlib.contextmanager
def temporary_folder() -> Iterator[Path]:
    """Make an empty folder, and remove it with all that is in it; remove former ones whose owners were killed."""
    place = Path(tempfile.gettempdir())
    _remove_remains(place)
    with _new_lock(place) as lock:
        folder = Path(lock.name).with_suffix("")
        try:
            folder.mkdir(mode=0o700)
            yield folder
        finally:
            _remove(folder)


def _new_lock(place: Path) -> IO[bytes]:
    """Return a new file that is locked. Before it is, another process may take it for remains and remove it."""
    while True:
        lock = tempfile.NamedTemporaryFile(prefix=PREFIX, suffix=LOCK, dir=place, delete=False)  # noqa: SIM115
        try:
            fcntl.flock(lock, fcntl.LOCK_EX)
        except OSError:
            lock.close()
            Path(lock.name).unlink(missing_ok=True)
            raise
        if Path(lock.name).exists():
            return lock
        lock.close()


def _remove_remains(place: Path) -> None:
    """Remove folders of this user that nobody has locked."""
    with contextlib.suppress(OSError):
        for path in place.glob(f"{PREFIX}*{LOCK}"):
            with contextlib.suppress(OSError):
                _remove_if_unlocked(path)


def _remove_if_unlocked(path: Path) -> None:
    if path.is_symlink() or path.stat().st_uid != os.geteuid():
        return
    with path.open("rb") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        _remove(path.with_suffix(""))


def _remove(folder: Path) -> None:
    """Remove a folder, and then its lock: what cannot be removed now, the next item can try to remove."""
    shutil.rmtree(folder, ignore_errors=True)
    with contextlib.suppress(OSError):
        if not folder.exists():
            folder.with_suffix(LOCK).unlink(missing_ok=True)
