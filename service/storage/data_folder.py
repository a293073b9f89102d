"""``DataFolder``: the data folder of a service, which one service uses at a time.

    incoming/TOKEN.part          an upload in progress
    jobs/ID/                     files of a job (:mod:`service.storage.job_files`)
    jobs/.orphaned/ID/           folders of jobs that the database does not know; never read or removed
    lock, identity, database     lock of the service, number of the folder, number of its database
    reserve                      space that deleting and starting need on a full disk

Nothing is removed behind a link in place of a job's folder.
"""

from __future__ import annotations

import contextlib
import fcntl
import logging
import os
import re
import secrets
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import IO

from ..core.settings import SettingsError
from .folder_numbers import read_number, write_number

log = logging.getLogger("kissgs.service")

ORPHANED = ".orphaned"
"""Name of the folder, within ``jobs``, for folders that no job of the database owns."""

JOB = re.compile("[0-9a-f]{32}")

RESERVE_BYTES = 1 << 20
"""Bytes of the reserve: to open an SQLite database and change it takes 100 kB of journal, each change 20 to 40."""

_UPLOAD = re.compile(r"[0-9a-f]{16}\.part")


class DataFolder:
    """Data folder, locked by one service at a time.

    Args:
        root: the folder; created if it does not exist.

    Attributes:
        root: its absolute path.
        incoming: path of the folder of uploads in progress.
        jobs: path of the folder of jobs.

    Raises:
        SettingsError: it cannot be created or written to, or another service uses it.
    """

    def __init__(self, root: Path) -> None:
        self.root = root.absolute()
        self.incoming, self.jobs = self.root / "incoming", self.root / "jobs"
        try:
            self.root.mkdir(mode=0o700, parents=True, exist_ok=True)
            for folder in (self.incoming, self.jobs):
                folder.mkdir(exist_ok=True)
            self._lock: IO[str] = (self.root / "lock").open("a")
        except OSError as error:
            raise SettingsError(
                f"KISSGS_DATA_DIR: cannot use {root}: {(error.strerror or str(error)).lower()}"
            ) from error
        try:
            fcntl.flock(self._lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as error:
            self._lock.close()
            raise SettingsError(f"KISSGS_DATA_DIR: another service is using {root}; use a separate folder") from error
        # Kept open, so that no file system reuses their inode numbers.
        self._opened = {folder: os.open(folder, os.O_RDONLY) for folder in (self.incoming, self.jobs)}
        if os.path.lexists(self.orphaned) and not self.orphaned.is_dir():
            self.close()
            raise SettingsError(f"KISSGS_DATA_DIR: {self.orphaned} is not a folder; move it away")

    def close(self) -> None:
        """Release the folder for other services."""
        while self._opened:
            os.close(self._opened.popitem()[1])
        self._lock.close()

    def new_upload(self) -> Path:
        """Return a new path for an upload."""
        return self.incoming / f"{secrets.token_hex(8)}.part"

    def discard(self, path: Path) -> None:
        """Remove a file or folder if it exists; of a link, remove only the link."""
        if path.parent.parent == self.jobs and path.parent.is_symlink():
            return
        if path.is_dir() and not path.is_symlink():
            shutil.rmtree(path, ignore_errors=True)
        else:
            with contextlib.suppress(FileNotFoundError, NotADirectoryError):
                path.unlink()

    def remove_uploads(self) -> None:
        """Remove incomplete uploads of a previous service."""
        for path in self.incoming.iterdir():
            if _UPLOAD.fullmatch(path.name):
                self.discard(path)

    # Orphaned folders -----------------------------------------------------------------------------------------------

    @property
    def orphaned(self) -> Path:
        """Folder for folders that no job of the database owns."""
        return self.jobs / ORPHANED

    def job_ids(self) -> set[str]:
        """Return the ids of all jobs that have a folder."""
        return {path.name for path in self.jobs.iterdir() if JOB.fullmatch(path.name) and path.is_dir()}

    def move_to_orphaned(self, job_id: str, why: str) -> None:
        """Move the folder of a job to the orphaned folder and log why; ``why`` continues "its folder ..."."""
        self._move_to_orphaned(self.jobs / job_id)
        log.warning("job %s: its folder %s and was moved to %s", job_id, why, self.orphaned)

    def set_aside(self, job_id: str, why: str) -> None:
        """Move the folder of a job to the orphaned folder; remove it if it is empty."""
        with contextlib.suppress(OSError):  # not empty, not a folder, or missing
            (self.jobs / job_id).rmdir()
        if os.path.lexists(self.jobs / job_id):
            self.move_to_orphaned(job_id, why)

    def set_aside_unknown(self, known: Callable[[], set[str]]) -> int:
        """Move the folders of all jobs except ``known`` ones to the orphaned folder; call it before uploads start.

        Returns:
            The number of folders moved.
        """
        unknown = sorted(self.job_ids() - known())
        for job_id in unknown:
            self._move_to_orphaned(self.jobs / job_id)
        if unknown:
            log.warning(
                "folders of jobs that the database does not know were moved to %s: %d", self.orphaned, len(unknown)
            )
        return len(unknown)

    def orphaned_note(self) -> str | None:
        """Return a sentence about the entries of the orphaned folder; None if it is empty."""
        count = self.count_orphaned()
        return f"folders without a job in jobs/{ORPHANED} of the data folder: {count}" if count else None

    def count_orphaned(self) -> int:
        """Return the number of entries of the orphaned folder."""
        try:
            return sum(1 for _ in self.orphaned.iterdir())
        except OSError:
            return 0

    def _move_to_orphaned(self, folder: Path) -> None:
        self.orphaned.mkdir(exist_ok=True)
        target, number = self.orphaned / folder.name, 1
        while os.path.lexists(target):
            number += 1
            target = self.orphaned / f"{folder.name}-{number}"
        folder.rename(target)

    # The disk ------------------------------------------------------------------------------------------------------

    def health_problem(self) -> str | None:
        """Return why files cannot be stored; None if they can. Takes microseconds."""
        for folder, opened in self._opened.items():
            try:
                same = os.path.samestat(folder.stat(), os.fstat(opened))
            except OSError:
                return f"the data folder cannot be used: its folder {folder.name} is missing; restore it"
            if not same:
                return f"the data folder cannot be used: its folder {folder.name} was replaced; restart the service"
            if not os.access(folder, os.R_OK | os.W_OK | os.X_OK):
                return (
                    f"the data folder cannot be used: its folder {folder.name} is not writable; change its permissions"
                )
        return None

    def free_bytes(self) -> int:
        """Return the free bytes of the disk."""
        return shutil.disk_usage(self.root).free

    def keep_reserve(self) -> None:
        """Take the reserve if it is missing, or what is left of it on a full disk."""
        path = self.root / "reserve"
        try:
            size = min(RESERVE_BYTES, self.free_bytes() - RESERVE_BYTES // 16)
            if not path.exists() and size > 0:
                with path.open("wb") as file:
                    os.posix_fallocate(file.fileno(), 0, size)
        except OSError:
            self.free_reserve()

    def free_reserve(self) -> bool:
        """Free the reserve, for a change that will free more; return whether there was one."""
        try:
            (self.root / "reserve").unlink()
        except OSError:
            return False
        return True

    # Numbers -------------------------------------------------------------------------------------------------------

    def read_number(self, name: str) -> int | None:
        """Read a number of the data folder: ``identity``, its own, or ``database``, that of its database.

        Returns:
            The number; None if the file is missing or empty.

        Raises:
            SettingsError: the file cannot be read or has other content.
        """
        return read_number(self.root / name)

    def write_number(self, name: str, number: int) -> None:
        """Write a number of the data folder atomically.

        Raises:
            SettingsError: it cannot be written.
        """
        write_number(self.root / name, number)
