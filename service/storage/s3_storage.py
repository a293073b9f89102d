"""``S3Storage``: the files of jobs in a bucket that several replicas share.

    PREFIX/identity, PREFIX/database            numbers of the storage and of its database
    PREFIX/jobs/ID/                             the files of a job (:mod:`service.storage.job_objects`)

What a replica is working on lies in a data folder of its own: uploads in progress, the files of its job processes, and
their checkpoints. Nothing else lies there, so that folder may be lost at any time.

A replica holds a claim of the job (:mod:`service.storage.replicas`) while it writes files of a job that is not in the
database yet, or that it runs; the claims of a replica that has died say what to remove.
"""

from __future__ import annotations

import logging
import secrets
import threading
import time
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

from ..core.formats import CHECKPOINT_FILES, UPLOAD_FILES
from ..core.settings import SettingsError
from .bucket_numbers import BucketNumbers
from .folder_numbers import read_number
from .job_files import FolderStorage
from .job_objects import DECODED_SUMMARY, JOB, SUMMARY, JobObjects, reclaimable
from .job_storage import DECODED, RESULT, JobStorage, StoredObject
from .object_store import ObjectStore

log = logging.getLogger("kissgs.service")


class S3Storage(JobStorage):
    """Bucket for the files of jobs, and a data folder for what this replica is working on.

    Args:
        url: ``s3://BUCKET`` or ``s3://BUCKET/PREFIX``.
        root: the data folder; created if it does not exist.

    Attributes:
        replica: id of this replica, which names the folders of its results; set it before :meth:`new_result`.

    Raises:
        SettingsError: the bucket or the folder cannot be used, or the folder holds jobs of a service without a bucket.
    """

    setting, shared = "KISSGS_STORAGE", True

    def __init__(self, url: str, root: Path) -> None:
        self._objects = ObjectStore(url)
        self._local = FolderStorage(root)
        self.place = f"{self._objects.url}/jobs"
        self._stored: dict[Path, int] = {}
        self._stored_lock = threading.Lock()
        self._unknown = 0
        self._numbers = BucketNumbers(self._objects)
        try:
            if read_number(self._local.root / "identity") is not None:
                raise SettingsError(
                    f"KISSGS_DATA_DIR: {root} belongs to a service without KISSGS_STORAGE; use another folder, which "
                    "will hold nothing but work in progress"
                )
            self._objects.check_usable(f"check-{time.time_ns():x}")
        except BaseException:
            self._local.close()
            raise

    def close(self) -> None:
        """Release the data folder for other services."""
        self._local.close()

    # Files that this replica is working on --------------------------------------------------------------------------

    def new_upload(self) -> Path:
        """Return a new path for an upload."""
        return self._local.new_upload()

    def new_work(self, job_id: str) -> Path:
        """Create a new work folder for a job process."""
        (self._local.jobs / job_id).mkdir(exist_ok=True)
        return self._local.new_work(job_id)

    def checkpoint(self, job_id: str) -> Path:
        """Return the path of the job's checkpoint."""
        return self._local.checkpoint(job_id)

    def remove_work(self, job_id: str) -> None:
        """Remove what this replica has of a job; stored checkpoints stay."""
        with self._stored_lock:
            self._stored = {path: made for path, made in self._stored.items() if path.parent.name != job_id}
        self._local.remove_job(job_id)

    def discard(self, path: Path) -> None:
        """Remove a file or folder of this machine if it exists; of a link, remove only the link."""
        self._local.discard(path)

    def free_bytes(self) -> int:
        """Return the free bytes of this machine's disk."""
        return self._local.free_bytes()

    def remove_uploads(self) -> None:
        """Remove incomplete uploads of a previous service."""
        self._local.remove_uploads()

    def remove_unfinished(self, known: set[str]) -> None:
        """Remove what a previous service was working on in this folder."""
        self._local.remove_uploads()
        for job_id in self._local.job_ids():
            self._local.remove_job(job_id)

    # Files of jobs --------------------------------------------------------------------------------------------------

    def adopt(self, upload: Path, job_id: str, name: str = UPLOAD_FILES[0]) -> None:
        """Move a complete upload to the files of a job; ``name`` is one of ``UPLOAD_FILES``."""
        self._objects.put(upload, self._job(job_id).key(name))
        self._local.discard(upload)

    def upload_name(self, job_id: str) -> str | None:
        """Return the name of the job's upload; None if there is none."""
        found = self._job(job_id).upload()
        return None if found is None else found.key.rpartition("/")[2]

    def fetch(self, job_id: str, name: str, work: Path) -> Path:
        """Copy a file of a job to the folder ``work``; return its path there."""
        path = work / Path(name).name
        self._objects.fetch(self._job(job_id).key(name), path)
        return path

    def fetch_checkpoints(self, job_id: str) -> None:
        """Copy the checkpoints of a job, which another replica may have made, to this machine."""
        self._job(job_id).fetch_all(CHECKPOINT_FILES, self._local.jobs / job_id)

    def store_checkpoints(self, job_id: str) -> None:
        """Store the complete checkpoints of a job for other replicas, if they have changed."""
        for path in sorted((self._local.jobs / job_id).glob("checkpoint*.npz")):
            with self._stored_lock:
                known = self._stored.get(path)
            if known != (made := path.stat().st_mtime_ns):
                self._objects.put(path, self._job(job_id).key(path.name))
                with self._stored_lock:
                    self._stored[path] = made

    def sizes(self, job_id: str) -> dict[str, int]:
        """Return the bytes of all files of a job by name."""
        return {name: info.size for name, info in self._job(job_id).files().items()}

    def sign(self, job_id: str, method: str, names: Iterable[str], seconds: float) -> dict[str, str]:
        """Return addresses by name with which anybody can read ("GET") or write ("PUT") these files for a time."""
        return self._job(job_id).sign(method, names, seconds)

    def new_result(self) -> str:
        """Return the name of a folder for the result of one start of a job."""
        return f"{RESULT}-{self.replica}-{secrets.token_hex(4)}"

    def keep_result(self, job_id: str, folder: str, work: Path) -> None:
        """Store the result in a work folder for good; do nothing if that is done already.

        Raises:
            OSError: it cannot be stored, or there is none.
        """
        if (work / RESULT).is_dir():
            self._job(job_id).put_result(work / RESULT, folder)
        elif f"{folder}/{SUMMARY}" not in self.sizes(job_id):
            raise FileNotFoundError(2, "its result is missing")

    def read_result(self, job_id: str, folder: str, container: str) -> dict[str, Any] | None:
        """Return the summary of a complete result with this container; None if there is none or it is damaged."""
        return self._job(job_id).read_result(folder, container)

    def result_folders(self, job_id: str) -> list[str]:
        """Return the names of the folders of results, complete or not."""
        return self._job(job_id).result_folders()

    def remove_result(self, job_id: str, folder: str) -> None:
        """Remove a result."""
        self._job(job_id).remove(lambda name: name.startswith(f"{folder}/"))

    def settle(self, job_id: str, folder: str, *, keep_upload: bool) -> bool:
        """Remove checkpoints, other results, and the upload unless ``keep_upload``; return whether there is one now."""
        wanted = (DECODED, DECODED_SUMMARY, *(UPLOAD_FILES if keep_upload else ()))
        kept = self._job(job_id).remove(lambda name: not name.startswith(f"{folder}/") and name not in wanted)
        return any(name in UPLOAD_FILES for name in kept)

    def keep_decoded(self, work: Path, job_id: str) -> None:
        """Store the decoded scene in a work folder, with its description, for good."""
        for name in (DECODED, DECODED_SUMMARY):
            self._objects.put(work / name, self._job(job_id).key(name))

    def read_decoded(self, job_id: str) -> dict[str, Any] | None:
        """Return the description of a job's decoded scene; None if it has not been decoded."""
        return self._job(job_id).read_decoded()

    def open(self, job_id: str, name: str) -> StoredObject:
        """Return a file of a job.

        Raises:
            FileNotFoundError: it does not exist.
        """
        key = self._job(job_id).key(name)
        info = self._objects.info(key)
        return StoredObject(info.size, info.modified, stream=lambda first, end: self._objects.stream(key, first, end))

    def reclaimable_bytes(self, job_id: str) -> int:
        """Return the bytes that an ended job can do without: its upload and its decoded scene."""
        return sum(size for name, size in self.sizes(job_id).items() if reclaimable(name))

    def reclaim(self, job_id: str) -> None:
        """Remove the upload and the decoded scene of an ended job."""
        self._job(job_id).remove(reclaimable)

    def remove_job(self, job_id: str) -> bool:
        """Remove all files of a job; return False if that is not possible now, with a warning in the log."""
        self._local.remove_job(job_id)
        try:
            self._job(job_id).remove(lambda name: True)
        except OSError as error:
            log.warning("job %s: its files cannot be removed now: %s", job_id, error)
            return False
        return True

    def job_bytes(self, job_id: str) -> int:
        """Return the size of all files of a job, bytes."""
        return sum(self.sizes(job_id).values())

    def _job(self, job_id: str) -> JobObjects:
        return JobObjects(self._objects, job_id)

    # The storage itself ---------------------------------------------------------------------------------------------

    def job_ids(self) -> set[str]:
        """Return the ids of all jobs that have files."""
        return {name for name in self._objects.folders("jobs") if JOB.fullmatch(name)}

    def set_aside(self, job_id: str, why: str) -> None:
        """Leave the files of a failed job where they are, until it expires."""
        log.warning("job %s: its folder %s; its files stay in %s until it expires", job_id, why, self.place)

    def set_aside_unknown(self, known: Callable[[], set[str]]) -> int:
        """Count the jobs that have files, but no row in the database: nothing removes them or changes them.

        Returns:
            Their number.
        """
        stored = self.job_ids()  # first, because other replicas may add jobs meanwhile
        self._unknown = len(stored - known())
        if note := self.orphaned_note():
            log.warning("%s", note)
        return self._unknown

    def orphaned_note(self) -> str | None:
        """Return a sentence about files of jobs that the database does not know; None if there are none."""
        return f"jobs in {self.place} that the database does not know: {self._unknown}" if self._unknown else None

    def health_problem(self) -> str | None:
        """Return why files cannot be stored; None if they can. Asks the bucket again after some seconds."""
        return self._local.health_problem() or self._numbers.health_problem()

    def read_number(self, name: str) -> int | None:
        """Read a number of the storage, see :class:`JobStorage`."""
        return self._numbers.read(name)

    def write_number(self, name: str, number: int) -> None:
        """Write a number of the storage, see :class:`JobStorage`."""
        self._numbers.write(name, number)
