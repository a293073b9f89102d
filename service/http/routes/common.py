"""Functions shared by the routes: documentation of errors, keys, jobs, their status, and waiting for their end."""

from __future__ import annotations

import asyncio
import hashlib
import hmac
from datetime import UTC, datetime
from typing import Annotated, Any

from anyio.to_thread import run_sync
from fastapi import Depends, Path, Request
from fastapi.security import HTTPAuthorizationCredentials, HTTPBearer

from ...core.files import THUMBNAIL
from ...core.models import ACTIVE, Job, State
from ...core.notifier import ended
from ...core.problems import MEDIA_TYPE, PROBLEM_TYPES, ProblemError
from ...core.schemas import Estimate, JobOptions, JobStatus, Links, Progress, Sizes, Timings
from ...jobs.admission import Queue
from ...jobs.container import ServiceContainer
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
    for owner, sha256 in keys:  # compare with all keys, so that the time reveals nothing
        if hmac.compare_digest(sha256, digest):
            found = owner
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


async def _disconnected(request: Request) -> None:
    """Wait until the client has closed the connection."""
    while (await request.receive())["type"] != "http.disconnect":
        pass


_OF_RESULTS = ("source_format", "compacted", "finetuning", "invisible", "cleaned", "evaluation")
"""Entries of a result's summary that the status has under the same names."""


def job_status(job: Job, queue: Queue) -> JobStatus:
    """Return the current status of a job."""
    waits, runs, result = job.state == State.QUEUED, job.state == State.RUNNING, job.result or {}
    estimate = None
    if waits or runs:
        seconds = queue.seconds_left(job)
        estimate = Estimate(seconds_left=round(seconds, 1), ready_at=_as_datetime(queue.now + seconds))
    return JobStatus(
        state=State(job.state),
        position=queue.position(job) if waits else None,
        progress=Progress(stage=job.stage, fraction=job.fraction, note=job.note) if runs and job.stage else None,
        estimate=estimate,
        options=JobOptions.stored(job.options),
        kept=result.get("count"),
        note=result.get("note") or None,
        sizes=_sizes(job),
        timings=_timings(job, queue.now),
        links=_links(job),
        expires_at=_as_datetime(job.expires_at) if job.expires_at is not None else None,
        id=job.id,
        name=job.name,
        upload_bytes=job.upload_bytes,
        gaussians=job.gaussians,
        sh_degree=job.sh_degree,
        starts=job.starts,
        problem=job.problem,
        **{name: result.get(name) for name in _OF_RESULTS},
    )


def _sizes(job: Job) -> Sizes | None:
    if job.result is None:
        return None
    container = job.result["container"]["bytes"]
    return Sizes(
        container=container,
        files={name: file["stored"] for name, file in job.result["files"].items()},
        ratio=job.upload_bytes / container,
        bytes_per_gaussian=container / max(job.gaussians, 1),
    )


def _timings(job: Job, now: float) -> Timings:
    started, finished = job.started_at, job.finished_at
    until = finished if finished is not None else now
    return Timings(
        created_at=_as_datetime(job.created_at),
        started_at=_as_datetime(started) if started is not None else None,
        finished_at=_as_datetime(finished) if finished is not None else None,
        queue_seconds=max(0.0, started - job.created_at) if started is not None else None,
        run_seconds=max(0.0, until - started) if started is not None and job.state != State.QUEUED else None,
        stages=job.result["seconds"] if job.result else None,
        cpu_seconds=job.result["cpu_seconds"] if job.result else None,
    )


def _links(job: Job) -> Links:
    here, done = f"/v1/jobs/{job.id}", job.state == State.SUCCEEDED
    return Links(
        self=here,
        events=f"{here}/events",
        cancel=f"{here}/cancel" if job.state in ACTIVE else None,
        result=f"{here}/result" if done else None,
        files=f"{here}/files/{{name}}" if done and (job.result or {}).get("files") else None,
        thumbnail=f"{here}/{THUMBNAIL}" if done and "thumbnail" in (job.result or {}) else None,
        decoded=f"{here}/decoded" if done else None,
        source=f"{here}/source" if done and job.upload_kept else None,
        report=f"{here}/report" if done else None,
        preview=f"/preview/{job.id}" if done else None,
    )


def _as_datetime(seconds: float) -> datetime:
    """Convert seconds since 1970 to a datetime in UTC."""
    return datetime.fromtimestamp(seconds, UTC)
