"""``Workplace``: the files of one start of a job: where its process finds the scene, and where its result goes."""

from __future__ import annotations

from abc import ABC, abstractmethod
from functools import cached_property
from pathlib import Path
from typing import Any

from ..core.disk_estimates import RESULT_BYTES, RESULT_BYTES_PER_GAUSSIAN
from ..core.formats import CHECKPOINT_FILES, UPLOAD_FILES, ContainerFile, container_file
from ..core.models import Job
from ..core.schemas import JobOptions
from ..core.settings import ServiceSettings
from ..storage.job_storage import JobStorage
from .runner import COMPRESS, COMPRESS_IN_BUCKET

SIGNED_SECONDS, MOST_SIGNED_SECONDS = 86_400, 7 * 86_400
"""Seconds beyond a job's time limit for which its signed addresses are valid, while it waits for a node; the most that
S3 allows in all."""


class Workplace(ABC):
    """Files of one start; methods block, and raise ``OSError`` if the storage fails.

    Args:
        storage: files of all jobs.
        job: the job.

    Attributes:
        folder: name of the folder of its result.
        stores_checkpoints: whether :meth:`store_checkpoints` should be called while the process runs; known after
            :meth:`task`.
    """

    stores_checkpoints = False

    def __init__(self, storage: JobStorage, job: Job) -> None:
        self._storage, self._job = storage, job
        self.folder = storage.new_result()

    @cached_property
    def _options(self) -> JobOptions:
        return JobOptions.model_validate(self._job.options)

    @property
    def _container(self) -> ContainerFile:
        return container_file(self._job.options)

    @abstractmethod
    def task(self) -> dict[str, Any]:
        """Make the files ready; return the task of the process.

        Raises:
            FileNotFoundError: the upload is missing.
        """

    @abstractmethod
    def store_checkpoints(self) -> None:
        """Store the complete checkpoints of a process that has not succeeded, for the next start of the job."""

    @abstractmethod
    def finished(self) -> dict[str, Any] | None:
        """Return the summary of a complete result although the process has not reported it; None if there is none."""

    @abstractmethod
    def keep(self) -> None:
        """Store the result of a process that has succeeded for good; do nothing if that is done already.

        Raises:
            OSError: it cannot be stored, or there is none.
        """

    def clear(self, *, kept: bool) -> None:
        """Remove what the process has left, but for checkpoints, and for its result if that is ``kept``."""
        self._storage.remove_work(self._job.id)

    @abstractmethod
    def abandon(self) -> None:
        """Remove what belongs to this start alone, because another start of the job may be running."""

    def _common(self) -> dict[str, Any]:
        left_out = ("format", "evaluate", "origin")
        return {
            "settings": {name: value for name, value in self._job.options.items() if name not in left_out},
            "format": self._options.format,
            "container": self._container.name,
            "evaluate": self._options.evaluate,
            "origin": self._options.origin,
        }


class FolderWorkplace(Workplace):
    """A folder on this machine's disk, which the nodes of a cluster see as well."""

    _work: Path | None = None

    def task(self) -> dict[str, Any]:
        """See :class:`Workplace`."""
        work = self._work = self._storage.new_work(self._job.id)
        source = self._storage.fetch_scene(self._job.id, work)
        checkpoint = None
        if self._options.resumable:
            self._storage.fetch_checkpoints(self._job.id)
            self.stores_checkpoints = self._storage.shared
            checkpoint = str(self._storage.checkpoint(self._job.id))
        return {
            "function": COMPRESS,
            "source": str(source),
            "work": str(work),
            "checkpoint": checkpoint,
            **self._common(),
        }

    def store_checkpoints(self) -> None:
        """See :class:`Workplace`."""
        self._storage.store_checkpoints(self._job.id)

    def finished(self) -> None:
        """See :class:`Workplace`; only the process of this service can store it."""

    def keep(self) -> None:
        """See :class:`Workplace`."""
        if self._work is None:
            raise FileNotFoundError(2, "its result is missing")
        self._storage.keep_result(self._job.id, self.folder, self._work)

    def abandon(self) -> None:
        """See :class:`Workplace`."""
        if self._work is not None:
            self._storage.discard(self._work)


class BucketWorkplace(Workplace):
    """A temporary folder of the node that runs the job, which reads and writes a bucket by signed addresses.

    Args:
        storage: files of all jobs, in a bucket.
        job: the job.
        seconds: validity of the addresses.
    """

    def __init__(self, storage: JobStorage, job: Job, seconds: float) -> None:
        super().__init__(storage, job)
        self._seconds = seconds

    def task(self) -> dict[str, Any]:
        """See :class:`Workplace`."""
        job_id, resumable = self._job.id, self._options.resumable
        sizes = self._storage.sizes(job_id)
        upload = next((name for name in UPLOAD_FILES if name in sizes), None)
        if upload is None:
            raise FileNotFoundError(2, "its upload is missing")
        kept = [name for name in CHECKPOINT_FILES if resumable and name in sizes]
        readable = self._storage.sign(job_id, "GET", [upload, *kept], self._seconds)
        found = {name: {"url": url, "bytes": sizes[name]} for name, url in readable.items()}
        return {
            "function": COMPRESS_IN_BUCKET,
            "scene": {"name": upload, **found.pop(upload)},
            "checkpoint": CHECKPOINT_FILES[0] if resumable else None,
            "checkpoints": found,
            "store": self._writable(),
            "space": sizes[upload]
            + self._job.work_bytes
            + RESULT_BYTES_PER_GAUSSIAN * self._job.gaussians
            + RESULT_BYTES,
            **self._common(),
        }

    def _writable(self) -> dict[str, str]:
        """Return an address for every file that the process may store, by its name on the node."""
        names = [self._container.name, "report.json", "summary.json"]
        names += [f"files/{name}" for name in self._container.contents]
        wanted = {f"result/{name}": f"{self.folder}/{name}" for name in names}
        if self._options.resumable:
            wanted |= {name: name for name in CHECKPOINT_FILES}
        addresses = self._storage.sign(self._job.id, "PUT", wanted.values(), self._seconds)
        return {name: addresses[key] for name, key in wanted.items()}

    def store_checkpoints(self) -> None:
        """See :class:`Workplace`; the process itself has done it."""

    def finished(self) -> dict[str, Any] | None:
        """See :class:`Workplace`: a node may be lost after its last request."""
        return self._storage.read_result(self._job.id, self.folder, self._container.name)

    def keep(self) -> None:
        """See :class:`Workplace`."""
        if self.finished() is None:
            raise FileNotFoundError(2, "its result is missing")

    def clear(self, *, kept: bool) -> None:
        """See :class:`Workplace`."""
        if not kept:
            self._storage.remove_result(self._job.id, self.folder)

    def abandon(self) -> None:
        """See :class:`Workplace`."""
        self._storage.remove_result(self._job.id, self.folder)


def workplace(settings: ServiceSettings, storage: JobStorage, job: Job) -> Workplace:
    """Return the files of a new start of a job."""
    if settings.runner == "ray" and storage.shared:
        return BucketWorkplace(storage, job, min(settings.job_seconds + SIGNED_SECONDS, MOST_SIGNED_SECONDS))
    return FolderWorkplace(storage, job)
