"""``FolderStorage``: the files of jobs in a data folder; clients choose no file names.

    jobs/ID/scene.ENDING         the complete upload: ply, sog, spz, splat, ksplat or glb
    jobs/ID/work-TOKEN/          files of a running job process
    jobs/ID/checkpoint*.npz      checkpoints of training, kept until the job ends
    jobs/ID/result/              the result, renamed to this when it is complete and on the disk
        scene.zip or scene.sog  report.json  files/NAME
    jobs/ID/decoded.ply          the decoded scene, after the first request; decoded.json has its size and checksum

Incomplete files of a killed service have names that are never read, and the next start removes them. Only files with
names of this list are removed.
"""

from __future__ import annotations

import contextlib
import errno
import json
import logging
import os
import secrets
import time
from pathlib import Path
from typing import Any

from ..core.formats import UPLOAD_FILES
from .data_folder import JOB, DataFolder
from .folder_numbers import sync_folder
from .job_storage import DECODED, RESULT, JobStorage, StoredObject, complete_summary

log = logging.getLogger("kissgs.service")

UNFINISHED = ("work-*", ".*.part")
"""Patterns of incomplete files in a job's folder: work folders, and checkpoints that are being written."""

JOB_FILES = (*UNFINISHED, *UPLOAD_FILES, "result", "checkpoint*.npz", "decoded.ply", "decoded.json")
"""Patterns of all files that the service creates in a job's folder."""


class FolderStorage(DataFolder, JobStorage):
    """Files of jobs in the data folder of one service; for arguments and errors, see :class:`DataFolder`.

    Args:
        root: the data folder.
    """

    setting, shared = "KISSGS_DATA_DIR", False

    def __init__(self, root: Path) -> None:
        super().__init__(root)
        self.place = str(self.jobs)

    def adopt(self, upload: Path, job_id: str, name: str = UPLOAD_FILES[0]) -> None:
        """Move a complete upload to the folder of a job; ``name`` is one of :data:`UPLOAD_FILES`."""
        folder = self.jobs / job_id
        folder.mkdir()
        upload.rename(folder / name)
        sync_folder(folder)
        sync_folder(self.jobs)

    def upload(self, job_id: str) -> Path:
        """Return the path of the job's upload."""
        paths = [self.jobs / job_id / name for name in UPLOAD_FILES]
        return next((path for path in paths if path.exists()), paths[0])

    def result(self, job_id: str) -> Path:
        """Return the path of the job's result, a folder that exists only if the result is complete."""
        return self.jobs / job_id / RESULT

    def decoded(self, job_id: str) -> Path:
        """Return the path of the decoded scene, which exists after the first request."""
        return self.jobs / job_id / DECODED

    def checkpoint(self, job_id: str) -> Path:
        """Return the path of the job's checkpoint."""
        return self.jobs / job_id / "checkpoint.npz"

    def discard_checkpoints(self, job_id: str) -> None:
        """Remove the checkpoints of a job."""
        for path in (self.jobs / job_id).glob("checkpoint*.npz"):
            self.discard(path)

    def reclaimable_files(self, job_id: str) -> list[Path]:
        """Return the files that an ended job can do without, if they exist: its upload and its decoded scene."""
        return [path for path in (self.upload(job_id), self.decoded(job_id)) if path.exists()]

    def reclaimable_bytes(self, job_id: str) -> int:
        """Return the bytes that an ended job can do without."""
        return sum(path.stat().st_size for path in self.reclaimable_files(job_id))

    def reclaim(self, job_id: str) -> None:
        """Remove the upload and the decoded scene of an ended job."""
        for path in self.reclaimable_files(job_id):
            self.discard(path)

    def upload_name(self, job_id: str) -> str | None:
        """Return the name of the job's upload; None if there is none."""
        path = self.upload(job_id)
        return path.name if path.is_file() else None

    def fetch(self, job_id: str, name: str, work: Path) -> Path:
        """Return the path of a job's file."""
        return self.jobs / job_id / name

    def open(self, job_id: str, name: str) -> StoredObject:
        """Return a file of a job.

        Raises:
            FileNotFoundError: it does not exist.
        """
        path = self.jobs / job_id / name
        found = path.stat()
        return StoredObject(found.st_size, found.st_mtime, path)

    def new_work(self, job_id: str) -> Path:
        """Create a new work folder for a job process."""
        folder = self.jobs / job_id / f"work-{secrets.token_hex(8)}"
        folder.mkdir()
        return folder

    def keep_result(self, job_id: str, folder: str, work: Path) -> None:
        """Move the result from a work folder to its final path; do nothing if that is done already.

        A previous result moves to the work folder.

        Raises:
            OSError: the result cannot be moved, or there is none.
        """
        result, written = self.result(job_id), work / RESULT
        if written.is_dir():
            if os.path.lexists(result):
                result.rename(written.with_name("former"))
            written.rename(result)
            sync_folder(self.jobs / job_id)
        if not result.is_dir():
            raise FileNotFoundError(errno.ENOENT, "its result is missing")

    def read_result(self, job_id: str, folder: str, container: str) -> dict[str, Any] | None:
        """Return the summary of a complete result with this container; None if there is none or it is damaged."""
        result = self.jobs / job_id / folder
        try:
            text = (result / "summary.json").read_bytes()
            sizes = {str(path.relative_to(result)): path.stat().st_size for path in result.rglob("*")}
        except OSError:
            return None
        return complete_summary(text, sizes, container)

    def result_folders(self, job_id: str) -> list[str]:
        """Return the name of the result's folder if it exists."""
        return [RESULT] if self.result(job_id).exists() else []

    def remove_result(self, job_id: str, folder: str) -> None:
        """Remove a result."""
        self.discard(self.jobs / job_id / folder)

    def settle(self, job_id: str, folder: str, *, keep_upload: bool) -> bool:
        """Remove a job's checkpoints, and its upload unless ``keep_upload``; return whether there is an upload now."""
        self.discard_checkpoints(job_id)
        if not keep_upload:
            self.discard(self.upload(job_id))
        return keep_upload and self.upload(job_id).is_file()

    def keep_decoded(self, work: Path, job_id: str) -> None:
        """Move a decoded scene from a work folder to its final path."""
        (work / "decoded.json").rename(self.decoded(job_id).with_suffix(".json"))
        (work / "decoded.ply").rename(self.decoded(job_id))
        sync_folder(self.jobs / job_id)

    def read_decoded(self, job_id: str) -> dict[str, Any] | None:
        """Return the description of a job's decoded scene; None if it has not been decoded."""
        if not self.decoded(job_id).exists():
            return None
        found: dict[str, Any] = json.loads(self.decoded(job_id).with_suffix(".json").read_text())
        return found

    def remove_work(self, job_id: str) -> None:
        """Remove the incomplete files of a job; complete checkpoints stay."""
        for pattern in UNFINISHED:
            for path in (self.jobs / job_id).glob(pattern):
                self.discard(path)

    def remove_job(self, job_id: str) -> bool:
        """Remove all files of a job and return True; files that cannot be removed stay, with a warning in the log.

        If the job's path is not a folder, or has other content, it is moved to the orphaned folder instead.
        """
        folder = self.jobs / job_id
        if not JOB.fullmatch(job_id):
            raise ValueError(f"{job_id!r} is not a job id")
        try:
            if not self._remove(folder):
                log.warning("job %s: its folder cannot be removed", job_id)
        except OSError as error:
            log.warning("job %s: its folder cannot be removed: %s", job_id, (error.strerror or str(error)).lower())
        return True

    def _remove(self, folder: Path) -> bool:
        """Remove the folder of a job, or move it to the orphaned folder; return False if it still exists."""
        for _ in range(20):  # its process may still write a file while it is being killed
            if not os.path.lexists(folder):
                return True
            if folder.is_symlink() or not folder.is_dir():
                self.move_to_orphaned(folder.name, "was not created by the service")
                return True
            for pattern in JOB_FILES:
                for path in folder.glob(pattern):
                    self.discard(path)
            with contextlib.suppress(FileNotFoundError):
                if not all(any(path.match(pattern) for pattern in JOB_FILES) for path in folder.iterdir()):
                    self.move_to_orphaned(folder.name, "has files that are not the service's")
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

    def job_bytes(self, job_id: str) -> int:
        """Return the size of all files of a job, bytes."""
        return sum(path.stat().st_size for path in (self.jobs / job_id).rglob("*") if path.is_file())
