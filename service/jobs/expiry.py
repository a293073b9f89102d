"""Expiry: removal of ended jobs after their time, and the record of the time."""

from __future__ import annotations

import asyncio
import contextlib
import logging
from dataclasses import dataclass

from anyio.to_thread import run_sync
from sqlalchemy.exc import SQLAlchemyError

from ..core.models import ENDED, State
from .container import ServiceContainer

log = logging.getLogger("kissgs.service")


HEARTBEAT_SECONDS = 5.0
"""Seconds between records of the time, with the last of which the clock of the next start begins."""

GRACE_SECONDS = 3600.0
"""Seconds after the start in which nothing expires, in case the machine's clock was wrong at the start."""


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
        """Expire ended jobs and remove their files after ``keep_seconds``, and return their ids.

        Their rows are deleted after as long again.
        """
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
