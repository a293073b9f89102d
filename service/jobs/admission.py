"""What is let in: the queue's length, uploads at the same time, room on the disk."""

from __future__ import annotations

import contextlib
import threading
from collections.abc import Iterator
from dataclasses import dataclass, field

from service.core.models import Job
from service.core.problems import ProblemError
from service.core.settings import ServiceSettings
from service.jobs.status import QueueEstimator
from service.storage.job_storage import JobStorage
from service.storage.job_store import LimitExceeded, Store

BUSY_SECONDS = 5.0
"""When to try again what is refused for a crowd that will pass soon."""

FULL_SECONDS = 600.0
"""When to try again what is refused for want of room."""


@dataclass
class Admission:
    """Counts what is on its way in, and refuses what there is no room for. Its methods may block on the database."""

    settings: ServiceSettings
    store: Store
    storage: JobStorage
    uploads: int = 0
    _reserved: int = 0
    _written: int = 0
    _lock: threading.Lock = field(default_factory=threading.Lock)

    def check(self, owner: str) -> None:
        """Refuse, before a body is read, what :meth:`add` would refuse after it.

        Raises:
            ProblemError: ``queue-full`` or ``too-many-jobs``.
        """
        if self.store.waiting() >= self.settings.max_queue:
            raise self._refused("queue")
        if owner and self.store.active_of(owner) >= self.settings.max_jobs_per_key:
            raise self._refused("owner")

    def add(self, job: Job) -> Job:
        """Queue a job.

        Raises:
            ProblemError: ``queue-full`` or ``too-many-jobs``.
            LimitExceeded: its idempotency key is taken.
        """
        try:
            with self._lock:  # counted and added in one step, on every kind of database
                return self.store.add(job, max_queue=self.settings.max_queue, max_owner=self.settings.max_jobs_per_key)
        except LimitExceeded as refused:
            if refused.limit == "key":
                raise
            raise self._refused(refused.limit) from refused

    @contextlib.contextmanager
    def slot(self) -> Iterator[None]:
        """Count an upload for as long as it arrives.

        Raises:
            ProblemError: ``too-many-uploads``.
        """
        if self.uploads >= self.settings.max_uploads:
            raise ProblemError(
                "too-many-uploads",
                f"{self.uploads} uploads are arriving, which is the limit; try again in a few seconds",
                retry_after=BUSY_SECONDS,
            )
        self.uploads += 1
        try:
            yield
        finally:
            self.uploads -= 1

    def require(self, size: int) -> None:
        """Refuse what cannot fit even if ended jobs gave up all they can. Nothing is set aside or removed.

        Raises:
            ProblemError: ``disk-full``.
        """
        with self._lock:
            if not self._fits(size) and not self._fits(size, self.store.reclaimable_bytes()):
                raise self._full(size)

    def reserve(self, size: int) -> None:
        """Set bytes of the disk aside; where there is no room, ended jobs give up what they can.

        Raises:
            ProblemError: ``disk-full``.
        """
        with self._lock:
            if not self._fits(size) and not self._fits(size, self.store.reclaimable_bytes()):
                raise self._full(size)
            while not self._fits(size):
                spare = self.store.reclaimable()
                if not spare:
                    raise self._full(size)
                for number, job_id in spare:
                    self._give_up(number, job_id)
                    if self._fits(size):
                        break
            self._reserved += size

    def wrote(self, size: int) -> None:
        """Bytes that were set aside have become a file, and the disk has that much less already."""
        with self._lock:
            self._written += size

    def release(self, size: int, written: int) -> None:
        """Give back what :meth:`reserve` has set aside: it is a job's now, or nobody's."""
        with self._lock:
            self._reserved -= size
            self._written -= written

    def _give_up(self, number: int, job_id: str) -> None:
        """Remove the upload of an ended job, and its decoded scene, which can be made anew."""
        self.store.require()
        for path in self.storage.reclaimable_files(job_id):
            self.storage.discard(path)
        self.store.update(number, upload_kept=False, reclaimable_bytes=0, disk_bytes=self.storage.job_bytes(job_id))

    def _fits(self, size: int, spare: int = 0) -> bool:
        taken = self.store.disk_bytes() + self._reserved - spare
        free = self.storage.free_bytes() - (self._reserved - self._written) + spare
        return taken + size <= self.settings.max_disk_bytes and free - size >= self.settings.min_free_bytes

    def _full(self, size: int) -> ProblemError:
        text = (
            f"there is no room for {size:,} more bytes on the server; try again later, "
            "or delete jobs that you no longer need"
        )
        return ProblemError("disk-full", text, retry_after=FULL_SECONDS)

    def _refused(self, limit: str) -> ProblemError:
        seconds = QueueEstimator(self.store, self.settings.workers).seconds_to_room()
        if limit == "queue":
            text = f"{self.settings.max_queue} jobs are waiting, which is the limit; try again in {seconds:.0f} s"
            return ProblemError("queue-full", text, retry_after=seconds)
        text = (
            f"this key has {self.settings.max_jobs_per_key} jobs waiting or running, which is the limit; "
            f"cancel one or try again in {seconds:.0f} s"
        )
        return ProblemError("too-many-jobs", text, retry_after=seconds)
