"""Functions shared by the routes: documentation of errors, look-up of jobs, and waiting for their end."""

from __future__ import annotations

import asyncio
import re
from collections.abc import Iterable
from typing import Annotated, Any

from anyio.to_thread import run_sync
from fastapi import Depends, Path, Request

from ...core.models import ACTIVE, Job
from ...core.notifier import ended
from ...core.problems import MEDIA_TYPE, PROBLEM_TYPES, ProblemError
from ...core.schemas import JobStatus
from ...jobs.container import Owner, Service, ServiceContainer
from ...jobs.status import job_status
from ...storage.job_files import JOB

MAX_WAIT_SECONDS = 30.0  # maximum duration of a long poll, shorter than typical idle time-outs of proxies

NO_STORE = {"Cache-Control": "no-store"}


def problems(*codes: str) -> dict[int | str, dict[str, Any]]:
    """Return the OpenAPI responses of a route that are problem documents."""
    answers: dict[int | str, dict[str, Any]] = {}
    for code in ("unauthorized", "invalid-request", "internal", "database", *codes):
        answer = answers.setdefault(
            PROBLEM_TYPES[code].status,
            {"description": "", "content": {MEDIA_TYPE: {"schema": {"$ref": "#/components/schemas/Problem"}}}},
        )
        text = f"{PROBLEM_TYPES[code].title} (`{code}`)"
        answer["description"] = ". ".join(filter(None, (answer["description"], text)))
        if code == "unauthorized":
            answer["headers"] = {"WWW-Authenticate": {"schema": {"type": "string"}, "description": "Bearer"}}
    return dict(sorted(answers.items(), key=lambda item: int(item[0])))


async def _find(
    context: Service,
    owner: Owner,
    id: Annotated[str, Path(description="Id of a job: 32 hexadecimal digits.", max_length=100)],
) -> Job:
    job = await run_sync(context.store.get, id, owner) if JOB.fullmatch(id) else None
    if job is None:
        raise ProblemError("not-found", f"there is no job {id!r}; it may have been deleted")
    return job


RequestedJob = Annotated[Job, Depends(_find)]


async def statuses(context: ServiceContainer, *jobs: Job) -> list[JobStatus]:
    """Return the statuses of jobs."""

    def read() -> list[JobStatus]:
        queue = context.queue.current()
        return [job_status(job, queue) for job in jobs]

    return await run_sync(read)


async def reload(context: ServiceContainer, job: Job) -> Job:
    """Return the current row of a job."""
    current = await run_sync(context.store.get, job.id)
    if current is None:
        raise ProblemError("not-found", f"there is no job {job.id}; it has just been deleted")
    return current


async def wait_for_end(context: ServiceContainer, job: Job, seconds: float, request: Request) -> Job:
    """Wait up to ``seconds`` for the end of a job; return its current row.

    The wait ends early if the client disconnects or the service stops.
    """
    clock = asyncio.get_running_loop().time
    end = clock() + seconds
    disconnected = asyncio.create_task(_disconnected(request))
    try:
        while True:
            changed = context.notifier.subscribe(ended(job.id))
            job = await reload(context, job)
            left = end - clock()
            if job.state not in ACTIVE or left <= 0 or context.notifier.closing or disconnected.done():
                return job
            notified = asyncio.create_task(changed.wait())
            await asyncio.wait((notified, disconnected), timeout=left, return_when=asyncio.FIRST_COMPLETED)
            notified.cancel()
    finally:
        disconnected.cancel()


def accepts(headers: Iterable[str], media_type: str) -> bool:
    """Whether ``Accept`` headers allow a media type. The most specific range decides; no range allows every type."""
    weights: dict[str, float] = {}
    for text in ",".join(headers).lower().split(","):
        name, *parameters = (part.strip() for part in text.split(";"))
        quality = next((part[2:] for part in parameters if part.startswith("q=")), "1")
        if name:
            weights[name] = float(quality) if re.fullmatch(r"[01](\.[0-9]{0,3})?", quality) else 1.0
    ranges = (media_type, f"{media_type.partition('/')[0]}/*", "*/*")
    return next((weights[name] > 0 for name in ranges if name in weights), not weights)


async def _disconnected(request: Request) -> None:
    """Wait until the client has closed the connection."""
    while (await request.receive())["type"] != "http.disconnect":
        pass
