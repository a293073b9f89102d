"""``ServiceContainer``: all parts of a running service, the recovery of its jobs, and the removal of expired ones."""

from __future__ import annotations

import asyncio
import contextlib
import logging
from dataclasses import dataclass, field

from anyio.to_thread import run_sync
from sqlalchemy.exc import SQLAlchemyError

from ..core.clock import Clock
from ..core.files import container_file
from ..core.metrics import Metrics
from ..core.models import ENDED, Job, State
from ..core.notifier import JobNotifier
from ..core.schemas import Health
from ..core.settings import ServiceSettings
from ..storage.job_files import JobStorage
from ..storage.job_records import open_store
from .admission import Admission, QueueEstimator
from .process import Decoder, JobRunners
from .worker import LOST, JobCompletion, Worker

log = logging.getLogger("kissgs.service")

HEARTBEAT_SECONDS = 5.0  # between records of the time, with the last of which the next clock begins
GRACE_SECONDS = 3600.0  # after the start in which nothing expires: the machine's clock may have been wrong


@dataclass
class Readiness:
    """The latest result of the checks of all parts, of which one runs at a time."""

    lock: asyncio.Lock = field(default_factory=asyncio.Lock)
    found: Health | None = None
    checked: float = 0.0


class ServiceContainer:
    """All parts of a running service. Waiting and interrupted jobs of an earlier one go on, interrupted removals are
    completed. The database may be an older copy than the data folder, so files of jobs that it does not know are never
    removed."""

    def __init__(self, settings: ServiceSettings) -> None:
        """Open the data folder and recover its jobs, but start nothing."""
        self.settings = settings
        with contextlib.ExitStack() as opened:
            self.storage, self.clock = JobStorage(settings.data_dir), Clock()
            opened.callback(self.storage.close)
            self.store = open_store(self.storage, self.clock)
            opened.callback(self.store.close)
            runners = JobRunners(settings)
            opened.callback(runners.close)
            self.storage.remove_unfinished(self.store.ids())
            self.clock.start_after(self.store.meta_value("time") or 0.0)
            self.storage.keep_reserve()
            self.began = self.clock()
            self.notifier, self.metrics, self.readiness = JobNotifier(), Metrics(), Readiness()
            self.metrics.queue_limit.set(settings.max_queue)
            self.completion = JobCompletion(settings, self.store, self.storage, self.metrics)
            self.worker = Worker(
                settings, self.store, self.storage, self.notifier, self.metrics, self.completion, runners
            )
            self.queue = QueueEstimator(self.store, settings.workers)
            self.admission = Admission(settings, self.store, self.storage, self.queue)
            self.decoder = Decoder(self.store, self.storage, self.admission, runners)
            self._recover()
            opened.pop_all()  # :meth:`close` closes them

    def close(self) -> None:
        """End all jobs and release the data folder."""
        self.worker.runners.close()
        self.store.close()
        self.storage.close()

    def _recover(self) -> None:
        store, storage = self.store, self.storage
        for job in store.active():
            self._recover_job(job)
        known, failed = store.ids(), store.ids(State.FAILED)
        for job_id in sorted(storage.job_ids() & (known - store.ids(State.QUEUED, State.RUNNING, State.SUCCEEDED))):
            if job_id in failed and storage.result(job_id).exists():
                storage.set_aside(job_id, "holds a result, although the job failed according to the database,")
            else:
                storage.remove_job(job_id)
        storage.set_aside_unknown(known)

    def _recover_job(self, job: Job) -> None:
        summary = self.storage.read_result(job.id, container_file(job.options).name)
        if summary is None and self.storage.result(job.id).exists():
            log.warning("job %s: its result is damaged", job.id)
        if summary is not None:
            if job.state == State.QUEUED:
                log.warning("job %s: its result exists, although it is queued in the database", job.id)
                self.store.move(job.number, State.RUNNING)
            self.completion.succeed(job, summary)
        elif self.storage.upload(job.id) is None:
            self.completion.fail(job, "internal", LOST, lost=True)
        elif job.state == State.RUNNING and job.starts >= self.settings.job_starts:
            detail = f"the service was ended {job.starts} times while the job ran; submit a scene with fewer Gaussians"
            self.completion.fail(job, "crashed", detail)
        elif job.state == State.RUNNING:
            self.store.move(job.number, State.QUEUED)

    async def keep_sweeping(self) -> None:
        """Remove expired jobs until cancelled; failures are logged and retried."""
        while True:
            await asyncio.sleep(self.settings.sweep_seconds)
            try:
                for job_id in await run_sync(self.sweep):
                    self.notifier.notify_end(job_id)
            except Exception:
                log.exception("expired jobs could not be removed; trying again")

    async def keep_time(self) -> None:
        """Record the time until cancelled."""
        while True:
            await asyncio.sleep(HEARTBEAT_SECONDS)
            with contextlib.suppress(SQLAlchemyError):  # /readyz and the worker report it
                await run_sync(self.store.heartbeat)

    def sweep(self) -> list[str]:
        """Expire ended jobs and remove their files after ``keep_seconds``, and return their ids. Their rows are deleted
        after as long again."""
        now, keep, expired = self.clock(), self.settings.keep_seconds, list[str]()
        self.storage.keep_reserve()
        if now - self.began < min(GRACE_SECONDS, keep):
            return []
        while due := self.store.due(ENDED, now):
            for number, job_id in due:
                self.completion.expire(number, job_id, expires_at=now + keep)
                expired.append(job_id)
        while due := self.store.due([State.EXPIRED], now):
            for number, job_id in due:
                self.storage.remove_job(job_id)
                self.completion.forget(number)
        if expired:
            log.info("%d jobs expired", len(expired))
        return expired
