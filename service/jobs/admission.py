"""Admission: positions and times of jobs in the queue, and checks on it, on simultaneous uploads and on disk space."""

from __future__ import annotations

import asyncio
import contextlib
import itertools
import math
import statistics
import threading
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from typing import NoReturn

from ..core.models import Job, State
from ..core.presets import can_train, limited_seconds, usual_seconds
from ..core.problems import ProblemError, disk_full
from ..core.schemas import CAPTURED, FINETUNED, TIMED
from ..core.settings import ServiceSettings
from ..storage.job_files import JobStorage
from ..storage.job_records import LimitExceeded, Store


class QueueEstimator:
    """Estimates of positions and times, from one reading of the queue for each change of it."""

    def __init__(self, store: Store, workers: int) -> None:
        self._store, self._workers = store, workers
        self._lock = threading.Lock()
        self._changes: int | None = None
        self._latest: Queue | None = None

    def current(self) -> Queue:
        """Return the estimates at this moment."""
        with self._lock:
            changes = self._store.changes  # first, so that a change during the reading is read the next time
            if self._latest is None or changes != self._changes:
                self._latest, self._changes = Queue(self._store, self._workers), changes
            return self._latest


class Queue:
    """All active jobs at one time, the rates of recent ones, and what follows for their positions and times."""

    def __init__(self, store: Store, workers: int) -> None:
        self._store, self._workers = store, workers
        self._rates: dict[tuple[str, bool], float | None] = {}
        active, turns = store.active(), store.turns
        self._running = [job for job in active if job.state == State.RUNNING]
        self._positions: dict[int, int] = {}
        self._seconds_before: dict[int, float] = {}
        before = 0.0
        for job in _in_turn((job for job in active if job.state == State.QUEUED), turns):
            self._positions[job.number] = 1 + len(self._positions)
            self._seconds_before[job.number] = before
            before += self._remaining(job)

    @property
    def now(self) -> float:
        """The current time in seconds since 1970."""
        return self._store.clock()

    def _total(self, job: Job) -> float:
        """Estimate the seconds of a job from start to end, from recent jobs with equal preset and evaluation."""
        kind = _kind_without_limit(job), job.evaluate
        if kind not in self._rates:
            rates = self._store.rates(*kind)
            self._rates[kind] = statistics.median(rates) if rates else None
        rate = self._rates[kind]
        total = usual_seconds(*kind, job.gaussians) if rate is None else rate * job.gaussians
        if (limit := job.options.get("time_limit")) is not None:
            total = limited_seconds(*kind, job.gaussians, total, limit)
        return total

    def _remaining(self, job: Job) -> float:
        """Estimate the seconds that a queued or running job is still to run, from its progress if that is known."""
        if (end := self._store.ends.get(job.number)) is not None:
            return max(end - self.now, 0.0)
        total, started = self._total(job), job.started_at if job.state == State.RUNNING else None
        return max(total - (self.now - started if started is not None else 0.0), 0.1 * total, 0.5)

    def position(self, job: Job) -> int:
        """Return the position of a queued job; 1 is next."""
        return self._positions.get(job.number, 1)  # just started

    def seconds_left(self, job: Job) -> float:
        """Estimate the seconds until a queued or running job ends."""
        seconds = self._remaining(job)
        if job.state != State.QUEUED:
            return seconds
        before = sum(map(self._remaining, self._running)) + self._seconds_before.get(job.number, 0.0)
        return seconds + before / self._workers

    def seconds_to_room(self) -> float:
        """Estimate the seconds until the queue has room, 1 to 300."""
        return min(300.0, max(1.0, min(map(self._remaining, self._running), default=1.0) / self._workers))


def _kind_without_limit(job: Job) -> str:
    """Return the kind of the same job without a time limit, with fine-tuning where that is left to the time."""
    if not job.preset.endswith(TIMED):
        return job.preset
    open_to_tuning = job.options["finetune"]["enabled"] is None and CAPTURED not in job.preset and can_train()
    return job.preset.removesuffix(TIMED) + (FINETUNED if open_to_tuning else "")


def _in_turn(queued: Iterable[Job], turns: Mapping[str, int]) -> list[Job]:
    """Return queued jobs in the order in which :meth:`Store.claim` starts them: one of each owner, then the next ones.
    First is the owner whose ``turns``, the number of its last start, is the lowest; of one owner, the oldest job."""
    waiting: dict[str, list[Job]] = {}
    for job in sorted(queued, key=lambda job: job.number):
        waiting.setdefault(job.owner, []).append(job)
    owners = sorted(waiting.values(), key=lambda jobs: (turns.get(jobs[0].owner, 0), jobs[0].number))
    return [job for turn in itertools.zip_longest(*owners) for job in turn if job is not None]


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
    _lock: threading.RLock = field(default_factory=threading.RLock)

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
            self.check_space(size)
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
