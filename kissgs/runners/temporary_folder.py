"""``temporary_folder``: a folder of one item on the disk of the machine that runs it.

    TEMP/kissgs-item-TOKEN/lock     locked by the process that made the folder, as long as it lives
    TEMP/kissgs-item-TOKEN/work/    the current folder of the item's process

TEMP is the system's folder for temporary files (``TMPDIR``). Whoever starts the item's process removes the folder when
that has ended. If it is killed itself, the folder stays, and the next item that starts on the machine removes it: a
lock that can be taken has no owner any more.
"""

from __future__ import annotations

import contextlib
import fcntl
import os
import shutil
import tempfile
from collections.abc import Iterator
from pathlib import Path

PREFIX, NEW = "kissgs-item-", "kissgs-new-"
"""Beginnings of names: of folders with a lock, and of those that do not have theirs yet."""


@contextlib.contextmanager
def temporary_folder() -> Iterator[Path]:
    """Make an empty folder, and remove it with all that is in it; remove former ones whose owners were killed.

    Raises:
        OSError: it cannot be made.
    """
    place = Path(tempfile.gettempdir())
    _remove_remains(place)
    made = Path(tempfile.mkdtemp(prefix=NEW, dir=place))
    try:
        with (made / "lock").open("wb") as lock:
            fcntl.flock(lock, fcntl.LOCK_EX)
            (made / "work").mkdir()
            made = made.rename(place / made.name.replace(NEW, PREFIX, 1))
            yield made / "work"
    finally:
        _remove(made)


def _remove_remains(place: Path) -> None:
    """Remove folders of this user that nobody has locked."""
    with contextlib.suppress(OSError), os.scandir(place) as entries:
        for entry in entries:
            if entry.name.startswith(PREFIX):
                with contextlib.suppress(OSError):
                    _remove_if_unlocked(Path(entry.path))


def _remove_if_unlocked(folder: Path) -> None:
    if folder.is_symlink() or folder.stat().st_uid != os.geteuid():
        return
    with (folder / "lock").open("rb") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        _remove(folder)


def _remove(folder: Path) -> None:
    """Remove a folder, its lock last: what cannot be removed now, the next item can try to remove."""
    shutil.rmtree(folder / "work", ignore_errors=True)
    if not (folder / "work").exists():
        shutil.rmtree(folder, ignore_errors=True)
