"""Admission: checks on the queue, on simultaneous uploads and on disk space."""

from __future__ import annotations

import asyncio
import contextlib
import math
import threading
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import NoReturn

from ..core.models import Job, State
from ..core.problems import ProblemError, disk_full
from ..core.settings import ServiceSettings
from ..storage.job_files import JobStorage
from ..storage.job_records import LimitExceeded, Store
from .status import QueueEstimator

BUSY_SECONDS = 5.0  # Retry-After of refusals because of simultaneous uploads, seconds

PARSES_AT_ONCE = 2
"""Uploads whose headers are read at a time, which takes up to 30 MB and half a second each. One hostile upload does not
delay all others, and the memory of many does not add up."""


@dataclass
class Admission:
    """Counts of uploads and reserved disk space, and refusals beyond the limits; methods may block on the database."""

    settings: ServiceSettings
    store: Store
    storage: JobStorage
    queue: QueueEstimator
    _uploads: Counter[str] = field(default_factory=Counter)
    parsing: asyncio.Semaphore = field(default_factory=lambda: asyncio.Semaphore(PARSES_AT_ONCE))
    unpacking: asyncio.Semaphore = field(default_factory=lambda: asyncio.Semaphore(1))
    _reserved: int = 0
    _written: int = 0
    _lock: threading.Lock = field(default_factory=threading.Lock)

    def check(self, owner: str) -> None:
        """Refuse a request before its body is read, if :meth:`add` would refuse it afterwards."""
        if self.store.counts()[State.QUEUED] >= self.settings.max_queue:
            raise self._refused("queue")
        if owner and self.store.active_of(owner) >= self.settings.max_jobs_per_key:
            raise self._refused("owner")

    def add(self, job: Job) -> Job:
        """Queue a job."""
        try:
            return self.store.add(job, max_queue=self.settings.max_queue, max_owner=self.settings.max_jobs_per_key)
        except LimitExceeded as refused:
            if refused.limit == "key":
                raise
            raise self._refused(refused.limit) from refused

    @property
    def uploads(self) -> int:
        """Number of uploads in progress."""
        return self._uploads.total()

    @contextlib.contextmanager
    def slot(self, client: str) -> Iterator[None]:
        """Count an upload of a client, the owner of a key or an address, while it is received."""
        if self.uploads >= self.settings.max_uploads:
            self._refuse_upload(f"{self.uploads} uploads are in progress")
        if self._uploads[client] >= math.ceil(self.settings.max_uploads / 4):
            which = "this key" if self.settings.keys else "this address"
            self._refuse_upload(f"{self._uploads[client]} uploads of {which} are in progress")
        self._uploads[client] += 1
        try:
            yield
        finally:
            self._uploads[client] -= 1
            self._uploads += Counter()  # forgets clients without uploads

    def _refuse_upload(self, found: str) -> NoReturn:
        text = f"{found}, which is the limit; try again in a few seconds"
        raise ProblemError("too-many-uploads", text, retry_after=BUSY_SECONDS)

    def check_space(self, size: int) -> None:
        """Refuse ``size`` bytes that would not fit even without the reclaimable files of ended jobs."""
        with self._lock:
            if not self._fits(size) and not self._fits(size, self.store.reclaimable_bytes()):
                raise self._full(size)

    def reserve(self, size: int) -> None:
        """Reserve disk space in bytes; if there is not enough, remove reclaimable files of ended jobs."""
        with self._lock:
            if not self._fits(size) and not self._fits(size, self.store.reclaimable_bytes()):
                raise self._full(size)
            while not self._fits(size):
                oldest = self.store.oldest_reclaimable()
                if oldest is None:
                    raise self._full(size)
                # Its upload, and its decoded scene, which can be decoded again.
                self.store.monitor.check_files()
                for path in self.storage.reclaimable_files(oldest.id):
                    self.storage.discard(path)
                left = self.storage.job_bytes(oldest.id)
                self.store.update(oldest.number, upload_kept=False, reclaimable_bytes=0, disk_bytes=left)
            self._reserved += size

    def wrote(self, size: int) -> None:
        """Record that ``size`` reserved bytes have been written, so they are no longer free on the disk."""
        with self._lock:
            self._written += size

    def release(self, size: int, written: int) -> None:
        """Release a reservation of ``size`` bytes, of which ``written`` were written and now count as the job's."""
        with self._lock:
            self._reserved -= size
            self._written -= written

    def _fits(self, size: int, reclaimable: int = 0) -> bool:
        taken = self.store.disk_bytes() + self._reserved - reclaimable + size
        free = self.storage.free_bytes() - (self._reserved - self._written) + reclaimable - size
        return taken <= self.settings.max_disk_bytes and free >= self.settings.min_free_bytes

    def _full(self, size: int) -> ProblemError:
        remedy = "try again later, or delete jobs that you no longer need"
        return disk_full(f"the server has no disk space for {size:,} more bytes; {remedy}")

    def _refused(self, limit: str) -> ProblemError:
        seconds = self.queue.current().seconds_to_room()
        if limit == "queue":
            text = f"{self.settings.max_queue} jobs are waiting, which is the limit; try again in {seconds:.0f} s"
            return ProblemError("queue-full", text, retry_after=seconds)
        text = (
            f"this key has {self.settings.max_jobs_per_key} jobs waiting or running, which is the limit; "
            f"cancel one or try again in {seconds:.0f} s"
        )
        return ProblemError("too-many-jobs", text, retry_after=seconds)
