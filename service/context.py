"""The parts of one running service, and how a request gets at them."""

from __future__ import annotations

import hashlib
import hmac
from dataclasses import dataclass
from typing import Annotated

from fastapi import Depends, Request
from fastapi.security import HTTPAuthorizationCredentials, HTTPBearer

from service.admission import Admission
from service.bell import Bell
from service.clock import Clock
from service.decoding import Decoder
from service.events import Follower
from service.files import Folders
from service.metrics import Metrics
from service.problems import ProblemError
from service.settings import ServiceSettings
from service.store import Store
from service.worker import Worker


@dataclass(frozen=True, slots=True)
class Context:
    """What a service is made of."""

    settings: ServiceSettings
    store: Store
    folders: Folders
    bell: Bell
    metrics: Metrics
    clock: Clock
    worker: Worker
    admission: Admission
    decoder: Decoder
    follower: Follower


def _context(request: Request) -> Context:
    context: Context = request.app.state.context
    return context


Service = Annotated[Context, Depends(_context)]

_bearer = HTTPBearer(auto_error=False, description="A key, where the service asks for one (see /v1/limits).")


def _owner(context: Service, given: Annotated[HTTPAuthorizationCredentials | None, Depends(_bearer)]) -> str:
    """Whose request this is; everybody's where no keys are configured."""
    keys = context.settings.keys
    if not keys:
        return ""
    digest = hashlib.sha256((given.credentials if given else "").encode()).hexdigest()
    found = ""
    for key in keys:  # all of them, whichever fits: the time tells nothing
        if hmac.compare_digest(key.sha256, digest):
            found = key.owner
    if not found:
        raise ProblemError(
            "unauthorized",
            "this key is not known here; check it, or ask for a new one"
            if given
            else "this service needs a key; send it as 'Authorization: Bearer KEY'",
            headers={"WWW-Authenticate": 'Bearer realm="kissgs"'},
        )
    return found


Owner = Annotated[str, Depends(_owner)]
