"""The data folder: uploads on their way in, a folder for each job, and nothing whose name a client chose.

    incoming/TOKEN.part          an upload as it arrives
    jobs/ID/scene.ply            the upload, whole
    jobs/ID/work-TOKEN/          what a running job has written so far
    jobs/ID/checkpoint*.npz      where its training stands: all that outlives its process, until the job has ended
    jobs/ID/result/              the result, renamed into place once it is whole and on the disk
        scene.zip  report.json  files/NAME
    jobs/ID/decoded.ply          made when first asked for; decoded.json has its size and checksum
    jobs/.orphaned/ID/           what no job of the database owns; nothing here is read or removed
    lock, identity, database     who uses the folder, its own number, and that of its database

What a killed service leaves half-written stands under a name that nothing reads, and is swept at the next start. Only
what bears a name of this list is ever removed, and nothing behind a link in the place of a job's folder.
"""

from __future__ import annotations

import contextlib
import errno
import fcntl
import logging
import os
import re
import secrets
import shutil
import time
from pathlib import Path
from typing import IO

from service.core.settings import SettingsError

log = logging.getLogger("kissgs.service")

ORPHANED = ".orphaned"

UNFINISHED = ("work-*", ".*.part")
"""What a process that was ended leaves in its job's folder: a folder of its own, and the file that was to become the
next checkpoint."""

OF_A_JOB = (*UNFINISHED, "scene.ply", "result", "checkpoint*.npz", "decoded.ply", "decoded.json")
"""All that the service puts into a job's folder."""

_JOB, _UPLOAD = re.compile("[0-9a-f]{32}"), re.compile(r"[0-9a-f]{16}\.part")


class JobStorage:
    """The data folder, which belongs to one service at a time.

    Raises:
        SettingsError: it cannot be made or written to, or another service uses it.
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
            raise SettingsError(f"KISSGS_DATA_DIR: another service is using {root}; give this one its own") from error
        # Open, so that they stay the same to every file system for as long as they are.
        self._opened = {folder: os.open(folder, os.O_RDONLY) for folder in (self.incoming, self.jobs)}
        if os.path.lexists(self.orphaned) and not self.orphaned.is_dir():
            self.close()
            raise SettingsError(f"KISSGS_DATA_DIR: {self.orphaned} is not a folder; move it away")

    def close(self) -> None:
        """Let another service have the folder."""
        while self._opened:
            os.close(self._opened.popitem()[1])
        self._lock.close()

    def new_upload(self) -> Path:
        """Where an upload may arrive."""
        return self.incoming / f"{secrets.token_hex(8)}.part"

    def adopt(self, upload: Path, job_id: str) -> None:
        """Make a whole upload that of a job."""
        folder = self.jobs / job_id
        folder.mkdir()
        upload.rename(folder / "scene.ply")
        sync_folder(folder)
        sync_folder(self.jobs)

    def upload(self, job_id: str) -> Path:
        """The job's ``.ply``."""
        return self.jobs / job_id / "scene.ply"

    def result(self, job_id: str) -> Path:
        """The folder of the job's result; there if and only if the result is whole."""
        return self.jobs / job_id / "result"

    def decoded(self, job_id: str) -> Path:
        """The decoded scene, if it has been asked for."""
        return self.jobs / job_id / "decoded.ply"

    def checkpoint(self, job_id: str) -> Path:
        """Where the job's training keeps its state."""
        return self.jobs / job_id / "checkpoint.npz"

    def discard_checkpoints(self, job_id: str) -> None:
        """They are of no more use."""
        for path in (self.jobs / job_id).glob("checkpoint*.npz"):
            self.discard(path)

    def reclaimable_files(self, job_id: str) -> list[Path]:
        """What an ended job can do without: its upload and its decoded scene, as far as they are there."""
        return [path for path in (self.upload(job_id), self.decoded(job_id)) if path.exists()]

    def new_work(self, job_id: str) -> Path:
        """A fresh folder for a job's process to write into."""
        folder = self.jobs / job_id / f"work-{secrets.token_hex(8)}"
        folder.mkdir()
        return folder

    def keep_result(self, job_id: str) -> None:
        """Make what a job's process has written its result, all at once; nothing to do if that is done already.

        A former result makes room for it, and goes with what else its process has left.

        Raises:
            OSError: that is not possible, or there is no result.
        """
        result = self.result(job_id)
        for written in (self.jobs / job_id).glob("work-*/result"):
            if os.path.lexists(result):
                result.rename(written.with_name("former"))
            written.rename(result)
            sync_folder(self.jobs / job_id)
        if not result.is_dir():
            raise FileNotFoundError(errno.ENOENT, "its result has vanished")

    def keep_decoded(self, work: Path, job_id: str) -> None:
        """Make a decoded scene the job's, all at once."""
        (work / "decoded.json").rename(self.decoded(job_id).with_suffix(".json"))
        (work / "decoded.ply").rename(self.decoded(job_id))
        sync_folder(self.jobs / job_id)

    def remove_work(self, job_id: str) -> None:
        """Remove what a process of the job has left, but for its checkpoint."""
        for pattern in UNFINISHED:
            for path in (self.jobs / job_id).glob(pattern):
                self.discard(path)

    def discard(self, path: Path) -> None:
        """Remove a file or folder, if it is there; of a link, only the link."""
        if path.parent.parent == self.jobs and path.parent.is_symlink():
            return
        if path.is_dir() and not path.is_symlink():
            shutil.rmtree(path, ignore_errors=True)
        else:
            with contextlib.suppress(FileNotFoundError, NotADirectoryError):
                path.unlink()

    def remove_job(self, job_id: str) -> None:
        """Remove all files of a job. What is no folder, or holds anything else, is set aside instead.

        What the system does not let go stays where it is, and the log says so.
        """
        folder = self.jobs / job_id
        if not _JOB.fullmatch(job_id):
            raise ValueError(f"{job_id!r} is no id of a job")
        try:
            if not self._remove(folder):
                log.warning("job %s: its folder cannot be removed", job_id)
        except OSError as error:
            log.warning("job %s: its folder cannot be removed: %s", job_id, (error.strerror or str(error)).lower())

    def _remove(self, folder: Path) -> bool:
        """Remove the folder of a job, or set it aside; False if it is still there."""
        for _ in range(20):  # its process may write a last file while it is being ended
            if not os.path.lexists(folder):
                return True
            if folder.is_symlink() or not folder.is_dir():
                self.set_aside(folder.name, "is no folder of ours")
                return True
            for pattern in OF_A_JOB:
                for path in folder.glob(pattern):
                    self.discard(path)
            with contextlib.suppress(FileNotFoundError):
                if not all(any(path.match(pattern) for pattern in OF_A_JOB) for path in folder.iterdir()):
                    self.set_aside(folder.name, "holds files of others")
                    return True
                with contextlib.suppress(OSError):
                    folder.rmdir()
                    return True
            time.sleep(0.05)
        return False

    def remove_unfinished(self, known: set[str]) -> None:
        """Remove what was being written when a former service ended: uploads, and work of known jobs."""
        self.remove_uploads()
        for job_id in self.held() & known:
            self.remove_work(job_id)

    def remove_uploads(self) -> None:
        """Remove what had arrived of uploads when a former service ended."""
        for path in self.incoming.iterdir():
            if _UPLOAD.fullmatch(path.name):
                self.discard(path)

    # What others own -----------------------------------------------------------------------------------------------

    @property
    def orphaned(self) -> Path:
        """The folder of what has been set aside."""
        return self.jobs / ORPHANED

    def held(self) -> set[str]:
        """The ids of all jobs that have a folder."""
        return {path.name for path in self.jobs.iterdir() if _JOB.fullmatch(path.name) and path.is_dir()}

    def set_aside(self, job_id: str, why: str) -> None:
        """Move the folder of a job out of the way, with all that it holds; the log says why and where it lies now."""
        self._move_aside(self.jobs / job_id)
        log.warning("job %s: its folder %s and lies in %s now", job_id, why, self.orphaned)

    def keep_aside(self, job_id: str, why: str) -> None:
        """Set the folder of a job aside, if there is anything in it."""
        with contextlib.suppress(OSError):  # not empty, no folder, or not there
            (self.jobs / job_id).rmdir()
        if os.path.lexists(self.jobs / job_id):
            self.set_aside(job_id, why)

    def set_aside_unknown(self, known: set[str]) -> int:
        """Move the folders of all jobs but the known ones out of the way: only while nothing arrives.

        Returns:
            How many there were.
        """
        unknown = sorted(self.held() - known)
        for job_id in unknown:
            self._move_aside(self.jobs / job_id)
        return len(unknown)

    def count_orphaned(self) -> int:
        """Count the folders that have been set aside and are still there."""
        try:
            return sum(1 for _ in self.orphaned.iterdir())
        except OSError:
            return 0

    def _move_aside(self, folder: Path) -> None:
        self.orphaned.mkdir(exist_ok=True)
        place, number = self.orphaned / folder.name, 1
        while os.path.lexists(place):
            number += 1
            place = self.orphaned / f"{folder.name}-{number}"
        folder.rename(place)

    # The disk ------------------------------------------------------------------------------------------------------

    def health_problem(self) -> str | None:
        """Why nothing can be kept in the folder; None if it can. A matter of microseconds."""
        for folder, opened in self._opened.items():
            try:
                same = os.path.samestat(folder.stat(), os.fstat(opened))
            except OSError:
                return f"the data folder cannot be used: its folder {folder.name} is not there; put it back"
            if not same:
                return f"the data folder cannot be used: its folder {folder.name} was replaced; restart the service"
            if not os.access(folder, os.R_OK | os.W_OK | os.X_OK):
                return f"the data folder cannot be used: its folder {folder.name} cannot be written to"
        return None

    def require(self) -> None:
        """See that files can be kept.

        Raises:
            OSError: they cannot.
        """
        if health_problem := self.health_problem():
            raise OSError(health_problem)

    def free_bytes(self) -> int:
        """What the disk has left."""
        return shutil.disk_usage(self.root).free

    def job_bytes(self, job_id: str) -> int:
        """What the files of a job take."""
        return sum(path.stat().st_size for path in (self.jobs / job_id).rglob("*") if path.is_file())


def sync_folder(folder: Path) -> None:
    """Have the names in a folder on the disk, so that a power cut cannot undo a rename."""
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
