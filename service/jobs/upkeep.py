"""Recovery of jobs after a start; and expiry: removal of ended jobs after their time, and the record of the time."""

from __future__ import annotations

import asyncio
import contextlib
import logging
from dataclasses import dataclass

from anyio.to_thread import run_sync
from sqlalchemy.exc import SQLAlchemyError

from ..core.files import container_file
from ..core.models import ENDED, Job, State
from .container import ServiceContainer

log = logging.getLogger("kissgs.service")


# Recovery after a start: waiting and interrupted jobs go on, interrupted removals are completed. The database may be an
# older copy than the data folder, so files of jobs that it does not know are never removed.


def recover(context: ServiceContainer) -> None:
    """Recover all jobs; call it before jobs are accepted or started."""
    store, storage = context.store, context.storage
    for job in store.in_state(State.QUEUED, State.RUNNING):
        _recover_job(context, job)
    known, failed = store.ids(), store.ids(State.FAILED)
    for job_id in sorted(storage.job_ids() & (known - store.ids(State.QUEUED, State.RUNNING, State.SUCCEEDED))):
        if job_id in failed and storage.result(job_id).exists():
            storage.set_aside(job_id, "holds a result, although the job failed according to the database,")
        else:
            storage.remove_job(job_id)
    storage.set_aside_unknown(store.ids())


def _recover_job(context: ServiceContainer, job: Job) -> None:
    store, storage, completion = context.store, context.storage, context.worker.completion
    summary = storage.read_result(job.id, container_file(job.options).name)
    if summary is None and storage.result(job.id).exists():
        log.warning("job %s: its result is damaged", job.id)
    if summary is not None:
        if job.state == State.QUEUED:
            log.warning("job %s: its result exists, although it is queued in the database", job.id)
            store.move(job.number, State.RUNNING)
        completion.succeed(job, summary)
    elif storage.upload_name(job.id) is None:
        completion.lose(job)
    elif job.state == State.RUNNING and job.starts >= context.settings.job_starts:
        detail = f"the service was ended {job.starts} times while the job ran; submit a scene with fewer Gaussians"
        completion.fail(job, "crashed", detail)
    elif job.state == State.RUNNING:
        store.move(job.number, State.QUEUED)


# Expiry.

HEARTBEAT_SECONDS = 5.0  # between records of the time, with the last of which the next clock begins
GRACE_SECONDS = 3600.0  # after the start in which nothing expires: the machine's clock may have been wrong


@dataclass(frozen=True, slots=True)
class ExpiryTask:
    """Background task that removes expired jobs; the service ``began`` at that time, seconds since 1970."""

    context: ServiceContainer
    began: float

    async def run(self) -> None:
        """Sweep periodically until cancelled; failures are logged and retried."""
        while True:
            await asyncio.sleep(self.context.settings.sweep_seconds)
            try:
                for job_id in await run_sync(self.sweep):
                    self.context.notifier.notify_end(job_id)
            except Exception:
                log.exception("expired jobs could not be removed; trying again")

    async def heartbeat(self) -> None:
        """Record the time periodically until cancelled."""
        while True:
            await asyncio.sleep(HEARTBEAT_SECONDS)
            with contextlib.suppress(SQLAlchemyError):  # /readyz and the worker report it
                await run_sync(self.context.store.heartbeat)

    def sweep(self) -> list[str]:
        """Expire ended jobs and remove their files after ``keep_seconds``, and return their ids. Their rows are deleted
        after as long again."""
        store, storage, now = self.context.store, self.context.storage, self.context.clock()
        completion, keep, expired = self.context.worker.completion, self.context.settings.keep_seconds, []
        storage.keep_reserve()
        if now - self.began < min(GRACE_SECONDS, keep):
            return []
        while due := store.due(ENDED, now):
            for number, job_id in due:
                completion.expire(number, job_id, expires_at=now + keep)
                expired.append(job_id)
        while due := store.due([State.EXPIRED], now):
            for number, job_id in due:
                storage.remove_job(job_id)
                completion.forget(number)
        if expired:
            log.info("%d jobs expired", len(expired))
        return expired
