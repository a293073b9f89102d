"""``JobStorage``: where the files of jobs lie, as the rest of the service sees it.

A file belongs to a job and has a name such as ``scene.ply`` or ``result/scene.zip``. There are two implementations:
:class:`service.storage.job_files.FolderStorage`, the data folder of one service, and
:class:`service.storage.s3_storage.S3Storage`, a bucket that several replicas share, with a data folder of each replica
for what it is working on.
"""

from __future__ import annotations

import json
from abc import ABC, abstractmethod
from collections.abc import AsyncIterator, Callable, Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

RESULT = "result"
"""Folder of a job's result, unless the job's summary names another one."""

DECODED = "decoded.ply"
"""Name of a job's decoded scene."""


@dataclass(frozen=True, slots=True)
class StoredObject:
    """A complete file of a job.

    Attributes:
        size: bytes.
        modified: time of its creation, seconds since 1970.
        path: its path, if it lies on this machine.
        stream: otherwise, a function that yields its bytes from a first to before a last one.
    """

    size: int
    modified: float
    path: Path | None = None
    stream: Callable[[int, int], AsyncIterator[bytes]] | None = None


class JobStorage(ABC):
    """Files of jobs, and of this process. Methods block; those that read or write raise ``OSError`` if that fails.

    Attributes:
        place: where the files of jobs lie, for messages.
        setting: name of the setting that determines it.
        shared: whether other replicas use the files as well; then they are not on this machine's disk.
        replica: id of this replica, which names the results that it stores; empty if they are not shared.
    """

    place: str
    setting: str
    shared: bool
    replica: str = ""

    @abstractmethod
    def close(self) -> None:
        """Release the storage."""

    # Files that this process is working on, on this machine's disk --------------------------------------------------

    @abstractmethod
    def new_upload(self) -> Path:
        """Return a new path for an upload."""

    @abstractmethod
    def new_work(self, job_id: str) -> Path:
        """Create a new work folder for a job process."""

    @abstractmethod
    def checkpoint(self, job_id: str) -> Path:
        """Return the path of the job's checkpoint."""

    @abstractmethod
    def remove_work(self, job_id: str) -> None:
        """Remove the incomplete files of a job; complete checkpoints stay."""

    @abstractmethod
    def discard(self, path: Path) -> None:
        """Remove a file or folder of this machine if it exists; of a link, remove only the link."""

    @abstractmethod
    def free_bytes(self) -> int:
        """Return the free bytes of this machine's disk."""

    def keep_reserve(self) -> None:  # noqa: B027  nothing to do if the database lies elsewhere
        """Take disk space for what must work on a full disk, if there is enough."""

    def free_reserve(self) -> bool:
        """Free that space; return whether there was any."""
        return False

    @abstractmethod
    def remove_uploads(self) -> None:
        """Remove incomplete uploads of a previous service."""

    @abstractmethod
    def remove_unfinished(self, known: set[str]) -> None:
        """Remove what a previous service was working on: uploads, and work folders of known jobs."""

    # Files of jobs --------------------------------------------------------------------------------------------------

    @abstractmethod
    def adopt(self, upload: Path, job_id: str, name: str) -> None:
        """Move a complete upload to the files of a job; ``name`` is one of ``UPLOAD_FILES``."""

    @abstractmethod
    def upload_name(self, job_id: str) -> str | None:
        """Return the name of the job's upload; None if there is none."""

    @abstractmethod
    def fetch(self, job_id: str, name: str, work: Path) -> Path:
        """Return the path of a job's file on this machine, copied to the folder ``work`` if it lies elsewhere."""

    def fetch_scene(self, job_id: str, work: Path) -> Path:
        """Return the path of the job's upload on this machine, copied to ``work`` if it lies elsewhere.

        Raises:
            FileNotFoundError: there is none.
        """
        name = self.upload_name(job_id)
        if name is None:
            raise FileNotFoundError(2, "its upload is missing")
        return self.fetch(job_id, name, work)

    def fetch_checkpoints(self, job_id: str) -> None:  # noqa: B027  nothing to do if they lie on this machine
        """Copy the checkpoints of a job, which another replica may have made, to this machine."""

    def store_checkpoints(self, job_id: str) -> None:  # noqa: B027
        """Store the complete checkpoints of a job for other replicas, if they have changed."""

    def sizes(self, job_id: str) -> dict[str, int]:
        """Return the bytes of all files of a job by name, if they lie in a bucket."""
        raise NotImplementedError

    def sign(self, job_id: str, method: str, names: Iterable[str], seconds: float) -> dict[str, str]:
        """Return addresses by name with which anybody can read ("GET") or write ("PUT") files in a bucket for a time.

        Args:
            job_id: id of their job.
            method: of HTTP.
            names: of the files, which need not exist.
            seconds: time for which the addresses are valid, at most seven days.

        Raises:
            OSError: there are no credentials to sign with.
        """
        raise NotImplementedError

    def new_result(self) -> str:
        """Return the name of a folder for the result of one start of a job."""
        return RESULT

    @abstractmethod
    def keep_result(self, job_id: str, folder: str, work: Path) -> None:
        """Store the result in a work folder for good; do nothing if that is done already.

        Args:
            job_id: id of the job.
            folder: name from :meth:`new_result`.
            work: folder from :meth:`new_work`.

        Raises:
            OSError: it cannot be stored, or there is none.
        """

    @abstractmethod
    def read_result(self, job_id: str, folder: str, container: str) -> dict[str, Any] | None:
        """Return the summary of a complete result with this container; None if there is none or it is damaged."""

    @abstractmethod
    def result_folders(self, job_id: str) -> list[str]:
        """Return the names of the folders of results, complete or not."""

    @abstractmethod
    def remove_result(self, job_id: str, folder: str) -> None:
        """Remove a result."""

    @abstractmethod
    def settle(self, job_id: str, folder: str, *, keep_upload: bool) -> bool:
        """Remove what a job does not need beside its result: checkpoints, and the upload unless ``keep_upload``.

        A decoded scene stays.

        Returns:
            Whether there is an upload now.
        """

    @abstractmethod
    def keep_decoded(self, work: Path, job_id: str) -> None:
        """Store the decoded scene in a work folder, with its description, for good."""

    @abstractmethod
    def read_decoded(self, job_id: str) -> dict[str, Any] | None:
        """Return the description of a job's decoded scene; None if it has not been decoded."""

    @abstractmethod
    def open(self, job_id: str, name: str) -> StoredObject:
        """Return a file of a job.

        Raises:
            FileNotFoundError: it does not exist.
        """

    @abstractmethod
    def reclaimable_bytes(self, job_id: str) -> int:
        """Return the bytes that an ended job can do without: its upload and its decoded scene."""

    @abstractmethod
    def reclaim(self, job_id: str) -> None:
        """Remove the upload and the decoded scene of an ended job."""

    @abstractmethod
    def remove_job(self, job_id: str) -> bool:
        """Remove all files of a job; return whether there is no need to try again later."""

    @abstractmethod
    def job_bytes(self, job_id: str) -> int:
        """Return the size of all files of a job, bytes."""

    # The storage itself ---------------------------------------------------------------------------------------------

    @abstractmethod
    def job_ids(self) -> set[str]:
        """Return the ids of all jobs that have files."""

    @abstractmethod
    def set_aside(self, job_id: str, why: str) -> None:
        """Put files of a failed job where nothing removes them; ``why`` continues "its folder ..." in the log."""

    @abstractmethod
    def set_aside_unknown(self, known: Callable[[], set[str]]) -> int:
        """Put the files of all jobs except ``known`` ones where nothing removes them; call it before uploads start.

        Args:
            known: returns the ids of all jobs in the database.

        Returns:
            The number of these jobs.
        """

    @abstractmethod
    def orphaned_note(self) -> str | None:
        """Return a sentence about files of jobs that the database does not know; None if there are none."""

    @abstractmethod
    def health_problem(self) -> str | None:
        """Return why files cannot be stored; None if they can. Takes microseconds, at times a request."""

    def check(self) -> None:
        """Check that files can be stored.

        Raises:
            OSError: they cannot.
        """
        if problem := self.health_problem():
            raise OSError(problem)

    @abstractmethod
    def read_number(self, name: str) -> int | None:
        """Read a number of the storage: ``identity``, its own, or ``database``, that of its database.

        Returns:
            The number; None if there is none.

        Raises:
            SettingsError: it cannot be read or is not a number.
        """

    @abstractmethod
    def write_number(self, name: str, number: int) -> None:
        """Write a number of the storage atomically.

        Raises:
            SettingsError: it cannot be written.
        """


def complete_summary(text: bytes, sizes: dict[str, int], container: str) -> dict[str, Any] | None:
    """Return the summary of a result that is complete; None if it is not.

    Args:
        text: content of ``summary.json``.
        sizes: bytes of each file of the result, by name.
        container: name of the container's file.
    """
    try:
        summary: dict[str, Any] = json.loads(text)
        required = {f"files/{name}": entry["bytes"] for name, entry in summary["files"].items()}
        required |= {container: summary["container"]["bytes"], "report.json": summary["report"]["bytes"]}
        complete = all(sizes.get(name) == size for name, size in required.items())
        return summary if complete and {"count", "seconds", "cpu_seconds"} <= summary.keys() else None
    except (ValueError, LookupError, TypeError, AttributeError, RecursionError):
        return None
