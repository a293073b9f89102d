"""Parts of a running service, and the dependencies through which requests access them."""

from __future__ import annotations

import hashlib
import hmac
from dataclasses import dataclass
from typing import Annotated

from fastapi import Depends, Request
from fastapi.security import HTTPAuthorizationCredentials, HTTPBearer

from ..core.clock import Clock
from ..core.metrics import Metrics
from ..core.notifier import JobNotifier
from ..core.problems import ProblemError
from ..core.settings import ServiceSettings
from ..storage.job_records import Store
from ..storage.job_storage import JobStorage
from .admission import Admission
from .decoding import Decoder
from .event_stream import EventStream
from .worker import Worker


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
    admission: Admission
    decoder: Decoder
    event_stream: EventStream


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
