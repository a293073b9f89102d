"""Parts of a running service, and the dependencies through which requests access them."""

from __future__ import annotations

import asyncio
import hashlib
import hmac
from collections.abc import Awaitable, Callable
from dataclasses import dataclass, field
from typing import Annotated

from fastapi import Depends, Request
from fastapi.security import HTTPAuthorizationCredentials, HTTPBearer

from ..core.clock import Clock
from ..core.metrics import Metrics
from ..core.notifier import JobNotifier
from ..core.problems import ProblemError
from ..core.schemas import Health
from ..core.settings import ServiceSettings
from ..storage.job_files import JobStorage
from ..storage.job_records import Store
from .admission import Admission
from .decoding import Decoder
from .status import EventStream, QueueEstimator
from .worker import Worker

READY_SECONDS = 2.0  # of a check's result: each check writes to the disk, and anybody may ask for one


class Readiness:
    """The latest result of the checks of all parts, of which one runs at a time."""

    def __init__(self) -> None:
        self._lock = asyncio.Lock()
        self._found: Health | None = None
        self._checked = 0.0

    async def health(self, check: Callable[[], Awaitable[Health]]) -> Health:
        """Return the latest result, or that of a new check."""
        clock = asyncio.get_running_loop().time
        async with self._lock:
            if self._found is None or clock() - self._checked > READY_SECONDS:
                self._found = await check()
                self._checked = clock()
            return self._found


@dataclass(frozen=True, slots=True)
class ServiceContainer:
    """All parts of a running service."""

    settings: ServiceSettings
    store: Store
    storage: JobStorage
    notifier: JobNotifier
    metrics: Metrics
    clock: Clock
    worker: Worker
    queue: QueueEstimator
    admission: Admission
    decoder: Decoder
    event_stream: EventStream
    readiness: Readiness = field(default_factory=Readiness)

    def close(self) -> None:
        """End all jobs and release the data folder."""
        self.worker.runners.close()
        self.store.close()
        self.storage.close()


def _context(request: Request) -> ServiceContainer:
    context: ServiceContainer = request.app.state.context
    return context


Service = Annotated[ServiceContainer, Depends(_context)]

_bearer = HTTPBearer(auto_error=False, description="A key, if the service requires one (see /v1/limits).")


def _owner(context: Service, given: Annotated[HTTPAuthorizationCredentials | None, Depends(_bearer)]) -> str:
    """Return the owner of the request's key; empty if no keys are configured."""
    keys = context.settings.keys
    if not keys:
        return ""
    digest = hashlib.sha256((given.credentials if given else "").encode()).hexdigest()
    found = ""
    for key in keys:  # compare with all keys, so that the time reveals nothing
        if hmac.compare_digest(key.sha256, digest):
            found = key.owner
    if not found:
        raise ProblemError(
            "unauthorized",
            "this key is unknown; check it, or ask the operator for a new one"
            if given
            else "this service requires a key; send it as 'Authorization: Bearer KEY'",
            headers={"WWW-Authenticate": 'Bearer realm="kissgs"'},
        )
    return found


Owner = Annotated[str, Depends(_owner)]
