"""``JobStorage``: the data folder, which one service uses at a time, and the files of jobs in it.

    incoming/TOKEN.part          an upload in progress, or the files of an archive
    jobs/ID/scene.ENDING         the complete upload: ply, sog, spz, splat, ksplat or glb
    jobs/ID/capture/             cameras and photographs of the scene; their files may be those of other jobs, too
    jobs/ID/work-TOKEN/          files of a running job process
    jobs/ID/checkpoint*.npz      checkpoints of training, kept until the job ends
    jobs/ID/result/              the result, renamed to this when it is complete and on the disk
        scene.zip or scene.sog  report.json  files/NAME
    jobs/ID/decoded-SHA256.ply   the decoded scene, after the first request, and its checksum
    jobs/.orphaned/ID/           folders of jobs that the database does not know; never read or removed
    jobs.sqlite                  the database of jobs (:mod:`service.storage.job_records`)
    lock                         lock of the service
    reserve                      space that deleting and starting need on a full disk

Clients choose no file names. Incomplete files of a killed service have names that are never read, and the next start
removes them. Only files with names of this list are removed, and nothing behind a link in place of a job's folder.
"""

from __future__ import annotations

import contextlib
import errno
import fcntl
import json
import logging
import os
import re
import secrets
import shutil
import time
from pathlib import Path
from typing import IO, Any

from ..core.files import UPLOAD_FILES, sync_folder
from ..core.settings import SettingsError

log = logging.getLogger("kissgs.service")

ORPHANED = ".orphaned"  # name of the folder, within jobs, for folders that no job of the database owns

JOB = re.compile("[0-9a-f]{32}")

RESERVE_BYTES = 1 << 20  # to open an SQLite database and change it takes 100 kB of journal, each change 40

_UPLOAD = re.compile(r"[0-9a-f]{16}\.part")

RESULT = "result"  # name of the folder of a job's result
CAPTURE = "capture"  # name of the folder of its photographs and their cameras
DECODED = "decoded-*.ply"
UNFINISHED = ("work-*", ".*.part")  # in a job's folder: work folders, and checkpoints being written

JOB_FILES = (*UNFINISHED, *UPLOAD_FILES, "result", CAPTURE, "checkpoint*.npz", "decoded*")
"""Patterns of all files that the service creates in a job's folder."""


class JobStorage:
    """The data folder, locked by one service at a time. Methods block, and raise ``OSError`` for unusable files."""

    def __init__(self, root: Path) -> None:
        self.root = root.absolute()
        self.incoming, self.jobs, self.database = (self.root / n for n in ("incoming", "jobs", "jobs.sqlite"))
        try:
            self.root.mkdir(mode=0o700, parents=True, exist_ok=True)
            for folder in (self.incoming, self.jobs):
                folder.mkdir(exist_ok=True)
            self._lock: IO[str] = (self.root / "lock").open("a")
        except OSError as error:
            reason = (error.strerror or str(error)).lower()
            raise SettingsError(f"KISSGS_DATA_DIR: cannot use {root}: {reason}") from error
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

    # Files of a job ---------------------------------------------------------------------------------------------------

    def adopt(self, upload: Path, job_id: str, name: str = UPLOAD_FILES[0], capture: Path | None = None) -> None:
        """Move a complete upload to the folder of a job, and the folder ``capture`` if there is one; ``name`` is one of
        :data:`UPLOAD_FILES`."""
        folder = self.jobs / job_id
        folder.mkdir()
        if capture is not None and capture.exists():
            capture.rename(folder / CAPTURE)
        upload.rename(folder / name)
        sync_folder(folder)
        sync_folder(self.jobs)

    def upload(self, job_id: str) -> Path | None:
        """Return the path of the job's upload; None if there is none."""
        return next((path for name in UPLOAD_FILES if (path := self.jobs / job_id / name).is_file()), None)

    def result(self, job_id: str) -> Path:
        """Return the path of the job's result, a folder that exists only if the result is complete."""
        return self.jobs / job_id / RESULT

    def decoded(self, job_id: str) -> Path | None:
        """Return the path of the decoded scene; None before the first request."""
        return next((self.jobs / job_id).glob(DECODED), None)

    def discard_checkpoints(self, job_id: str) -> None:
        """Remove the checkpoints of a job."""
        for path in (self.jobs / job_id).glob("checkpoint*.npz"):
            self.discard(path)

    def link_capture(self, job_id: str, folder: Path) -> None:
        """Make a folder with links to all files of a job's capture."""
        shutil.copytree(self.jobs / job_id / CAPTURE, folder, copy_function=os.link)

    def capture_files(self, job_id: str) -> list[str]:
        """Return the names of all files of a job's capture, relative to the job's folder; none if it has none."""
        folder = self.jobs / job_id
        return sorted(str(path.relative_to(folder)) for path in (folder / CAPTURE).rglob("*") if path.is_file())

    def reclaimable_files(self, job_id: str) -> list[Path]:
        """Return what an ended job can do without, if it exists: its upload, its capture and its decoded scene."""
        paths = self.upload(job_id), self.jobs / job_id / CAPTURE, self.decoded(job_id)
        return [path for path in paths if path is not None and path.exists()]

    def reclaimable_bytes(self, job_id: str) -> int:
        """Return the bytes that an ended job can do without."""
        return sum(map(tree_bytes, self.reclaimable_files(job_id)))

    def checkpoints(self, job_id: str) -> list[str]:
        """Return the names of the job's checkpoints."""
        return sorted(path.name for path in (self.jobs / job_id).glob("checkpoint*.npz"))

    def new_work(self, job_id: str) -> Path:
        """Create a new work folder for a job process."""
        folder = self.jobs / job_id / f"work-{secrets.token_hex(8)}"
        folder.mkdir()
        return folder

    def keep_result(self, job_id: str, work: Path) -> None:
        """Move the result from a work folder to its final path; do nothing if that is done already. A previous result
        moves to the work folder."""
        result, written = self.result(job_id), work / RESULT
        if written.is_dir():
            if os.path.lexists(result):
                result.rename(written.with_name("former"))
            written.rename(result)
            sync_folder(self.jobs / job_id)
        if not result.is_dir():
            raise FileNotFoundError(errno.ENOENT, "its result is missing")

    def read_result(self, job_id: str, container: str) -> dict[str, Any] | None:
        """Return the summary of a complete result with this container; None if there is none or it is damaged."""
        result = self.result(job_id)
        try:
            summary: dict[str, Any] = json.loads((result / "summary.json").read_bytes())
            sizes = {str(path.relative_to(result)): path.stat().st_size for path in result.rglob("*")}
            required = {f"files/{name}": entry["bytes"] for name, entry in summary["files"].items()}
            required |= {container: summary["container"]["bytes"], "report.json": summary["report"]["bytes"]}
            complete = all(sizes.get(name) == size for name, size in required.items())
            return summary if complete and {"count", "seconds", "cpu_seconds"} <= summary.keys() else None
        except (OSError, ValueError, LookupError, TypeError, AttributeError, RecursionError):
            return None

    def keep_decoded(self, work: Path, job_id: str) -> None:
        """Move a decoded scene from a work folder to its final path."""
        for path in work.glob(DECODED):
            path.rename(self.jobs / job_id / path.name)
        sync_folder(self.jobs / job_id)

    def job_bytes(self, job_id: str) -> int:
        """Return the size of all files of a job, bytes."""
        return tree_bytes(self.jobs / job_id)

    # Removal ----------------------------------------------------------------------------------------------------------

    def remove_work(self, job_id: str) -> None:
        """Remove the incomplete files of a job; complete checkpoints stay."""
        for pattern in UNFINISHED:
            for path in (self.jobs / job_id).glob(pattern):
                self.discard(path)

    def remove_job(self, job_id: str) -> None:
        """Remove all files of a job; files that cannot be removed stay, with a warning in the log. If the job's path is
        not a folder, or has other content, it is moved to the orphaned folder instead."""
        folder = self.jobs / job_id
        if not JOB.fullmatch(job_id):
            raise ValueError(f"{job_id!r} is not a job id")
        try:
            if not self._remove(folder):
                log.warning("job %s: its folder cannot be removed", job_id)
        except OSError as error:
            log.warning("job %s: its folder cannot be removed: %s", job_id, (error.strerror or str(error)).lower())

    def _remove(self, folder: Path) -> bool:
        """Remove the folder of a job, or move it to the orphaned folder; return False if it still exists."""
        for _ in range(20):  # its process may still write a file while it is being killed
            if not os.path.lexists(folder):
                return True
            if folder.is_symlink() or not folder.is_dir():
                self.set_aside(folder.name, "was not created by the service")
                return True
            for pattern in JOB_FILES:
                for path in folder.glob(pattern):
                    self.discard(path)
            with contextlib.suppress(FileNotFoundError):
                if not all(any(path.match(pattern) for pattern in JOB_FILES) for path in folder.iterdir()):
                    self.set_aside(folder.name, "has files that are not the service's")
                    return True
                with contextlib.suppress(OSError):
                    folder.rmdir()
                    return True
            time.sleep(0.05)
        return False

    def remove_unfinished(self, known: set[str]) -> None:
        """Remove incomplete files of a previous service: uploads, and work folders of known jobs."""
        self.remove_uploads()
        for job_id in self.job_ids() & known:
            self.remove_work(job_id)

    # Orphaned folders -----------------------------------------------------------------------------------------------

    @property
    def orphaned(self) -> Path:
        """Folder for folders that no job of the database owns."""
        return self.jobs / ORPHANED

    def job_ids(self) -> set[str]:
        """Return the ids of all jobs that have a folder."""
        return {path.name for path in self.jobs.iterdir() if JOB.fullmatch(path.name) and path.is_dir()}

    def set_aside(self, job_id: str, why: str) -> None:
        """Move the folder of a job to the orphaned folder and log why, "its folder ..."; remove it if it is empty."""
        with contextlib.suppress(OSError):  # not empty, not a folder, or missing
            (self.jobs / job_id).rmdir()
        if os.path.lexists(self.jobs / job_id):
            self._move_to_orphaned(self.jobs / job_id)
            log.warning("job %s: its folder %s and was moved to %s", job_id, why, self.orphaned)

    def set_aside_unknown(self, known: set[str]) -> None:
        """Move the folders of all jobs except ``known`` ones to the orphaned folder; call it before uploads start."""
        unknown = sorted(self.job_ids() - known)
        for job_id in unknown:
            self._move_to_orphaned(self.jobs / job_id)
        if unknown:
            text = "folders of jobs that the database does not know were moved to %s: %d"
            log.warning(text, self.orphaned, len(unknown))

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
            unusable = f"the data folder cannot be used: its folder {folder.name}"
            try:
                same = os.path.samestat(folder.stat(), os.fstat(opened))
            except OSError:
                return f"{unusable} is missing; restore it"
            if not same:
                return f"{unusable} was replaced; restart the service"
            if not os.access(folder, os.R_OK | os.W_OK | os.X_OK):
                return f"{unusable} is not writable; change its permissions"
        return None

    def check(self) -> None:
        """Check that files can be stored."""
        if problem := self.health_problem():
            raise OSError(problem)

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


def tree_bytes(path: Path) -> int:
    """Return the size of a file, or of all files below a folder, bytes."""
    return sum(each.stat().st_size for each in (path, *path.rglob("*")) if each.is_file())
