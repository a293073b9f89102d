"""Expiry: removal of ended jobs after their time, and the heartbeat of the database lease."""

from __future__ import annotations

import asyncio
import contextlib
import logging
from dataclasses import dataclass

from anyio.to_thread import run_sync
from sqlalchemy.exc import SQLAlchemyError

from ..core.models import ENDED, State
from ..core.notifier import ended
from ..storage.database_lease import HEARTBEAT_SECONDS
from .container import ServiceContainer

log = logging.getLogger("kissgs.service")


GRACE_SECONDS = 3600.0
"""Seconds after the start in which nothing expires, in case the machine's clock was wrong at the start."""


RETRY_SECONDS = 600.0
"""Seconds after which files that could not be removed are removed again."""


@dataclass(frozen=True, slots=True)
class ExpiryTask:
    """Background task that removes expired jobs every ``settings.sweep_seconds``.

    Attributes:
        context: the parts of the service.
        began: time of the service's start, seconds since 1970.
    """

    context: ServiceContainer
    began: float

    async def run(self) -> None:
        """Sweep periodically until cancelled; failures are logged and retried."""
        while True:
            await asyncio.sleep(self.context.settings.sweep_seconds)
            try:
                for job_id in await run_sync(self.sweep):
                    self.context.notifier.notify(job_id)
                    self.context.notifier.notify(ended(job_id))
            except Exception:
                log.exception("expired jobs could not be removed; trying again")

    async def heartbeat(self) -> None:
        """Renew the database lease periodically until cancelled."""
        while True:
            await asyncio.sleep(HEARTBEAT_SECONDS)
            with contextlib.suppress(SQLAlchemyError):  # /readyz and the worker report it
                await run_sync(self.context.store.heartbeat)

    def sweep(self) -> list[str]:
        """Expire ended jobs and remove their files after ``keep_seconds``; delete their rows after as long again.

        Returns:
            Ids of the jobs that have expired.
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
                if storage.remove_job(job_id):
                    completion.forget(number)
                else:
                    store.update(number, expires_at=now + RETRY_SECONDS)
        if expired:
            log.info("%d jobs expired", len(expired))
        return expired
