"""Jobs: submit, follow, list, cancel, delete."""

from __future__ import annotations

import json
import logging
import re
from collections.abc import AsyncIterator, Iterable
from typing import Annotated, Any

from anyio.to_thread import run_sync
from fastapi import APIRouter, Depends, Header, Query, Request, Response
from fastapi.responses import StreamingResponse

from ...core.models import ACTIVE, Job, State
from ...core.notifier import wait
from ...core.problems import ProblemError
from ...core.schemas import JobPage, JobStatus
from ...jobs.container import ServiceContainer
from ..submission import RAW_TYPES, Submission
from .common import MAX_WAIT_SECONDS, NO_STORE, Owner, RequestedJob, Service, problems, reload, statuses, wait_for_end
from .results import CONTAINER_TYPES, get_result

log = logging.getLogger("kissgs.service")

router = APIRouter(prefix="/v1", tags=["jobs"])

Options = Annotated[
    str | None,
    Query(
        description="JobOptions as JSON, if the body is the scene itself; in a form, use the field `options`.",
        max_length=8192,
        examples=['{"preset": "fast"}'],
    ),
]
Name = Annotated[
    str | None, Query(description="Name of the scene. Default: the file name in the form.", max_length=1000)
]
IdempotencyKey = Annotated[
    str | None,
    Header(
        description="Unique key of a job, chosen by the client. A repeated request with an identical scene and options "
        "returns the existing job, so a request whose response was lost can be repeated.",
        min_length=1,
        max_length=255,
        pattern="^[!-~]+$",
    ),
]


async def _submit(
    context: Service,
    request: Request,
    owner: Owner,
    options: Options = None,
    name: Name = None,
    idempotency_key: IdempotencyKey = None,
) -> Job:
    return await Submission(context, request, owner, options, name, idempotency_key).job()


SubmittedJob = Annotated[Job, Depends(_submit)]

Wait = Annotated[float, Query(description="Maximum wait for the end of the job, seconds.", ge=0, le=MAX_WAIT_SECONDS)]

_REFUSALS = (
    *("invalid-scene", "invalid-views", "unsupported", "gone", "key-reused", "media-type", "too-large"),
    *("upload-timeout", "upload-aborted", "queue-full", "too-many-jobs", "too-many-uploads", "disk-full", "stopping"),
)

_BODY: dict[str, Any] = {
    "requestBody": {
        "required": True,
        "description": "The scene: the field `file` of a form with the optional fields `capture` and `options`, or the "
        "body itself.",
        "content": {
            "multipart/form-data": {
                "schema": {
                    "type": "object",
                    "required": ["file"],
                    "additionalProperties": False,
                    "properties": {
                        "file": {"type": "string", "format": "binary", "description": "The scene."},
                        "capture": {
                            "type": "string",
                            "format": "binary",
                            "description": "Photographs of the scene and their cameras, a COLMAP model or "
                            "transforms.json, as zip or tar: jobs with a goal train on them. Other jobs name it by "
                            "its SHA-256, in the option `capture`.",
                        },
                        "options": {"$ref": "#/components/schemas/JobOptions"},
                    },
                },
                "encoding": {"options": {"contentType": "application/json"}},
            },
            RAW_TYPES[1]: {"schema": {"type": "string", "format": "binary"}},
        },
    }
}

_ACCEPTED: dict[int | str, dict[str, Any]] = {
    202: {
        "model": JobStatus,
        "description": "The job was accepted; request `Location` after `Retry-After` seconds.",
        "headers": {
            "Location": {"schema": {"type": "string"}, "description": "Path of the job."},
            "Retry-After": {
                "schema": {"type": "integer"},
                "description": "Delay before the first status request, seconds.",
            },
        },
    }
}


_EVENT: dict[str, Any] = {
    "type": "object",
    "description": "Server-sent event.",
    "required": ["id", "event", "data"],
    "properties": {
        "id": {"type": "string", "pattern": "^[0-9]+$"},
        "event": {"type": "string", "enum": ["state", "progress"]},
        "data": {"type": "string", "contentMediaType": "application/json"},
    },
}


@router.post(
    "/jobs",
    status_code=202,
    operation_id="submit",
    summary="Submit a scene",
    response_model_exclude_none=True,
    openapi_extra=_BODY,
    responses={**_ACCEPTED, **problems(*_REFUSALS)},
)
async def submit_job(context: Service, response: Response, job: SubmittedJob) -> JobStatus:
    """Upload a scene and create a job that compresses it.

    The header of a `.ply` and the limits are checked during the upload, headers of other formats after it. After the
    response, the job is stored on disk and survives a crash of the service.
    """
    return await _accepted(context, response, job)


@router.post(
    "/compress",
    operation_id="compress",
    summary="Compress a small scene while you wait",
    openapi_extra=_BODY,
    response_class=Response,
    responses={
        200: {
            "description": "The container. `Content-Location` is the path of the result, `Link` that of the job.",
            "content": {name: {"schema": {"type": "string", "format": "binary"}} for name in CONTAINER_TYPES},
        },
        **_ACCEPTED,
        **problems(*_REFUSALS, "crashed", "cancelled", "not-finished", "not-found"),
    },
)
async def compress_now(context: Service, request: Request, job: SubmittedJob) -> Response:
    """Submit a scene and answer with its container, if the job succeeds within `sync_seconds` of `/v1/limits`.

    After that time the job continues, and the answer is 202 with its status as JSON. A client whose `Accept` header
    excludes JSON gets a 409 problem instead (`not-finished`), with `Location`, so that a program that saves every
    successful answer as a container never saves a status.
    """
    job = await wait_for_end(context, job, context.settings.sync_seconds, request)
    if job.state == State.SUCCEEDED:
        answer = await get_result(context, job)
        answer.headers["Content-Location"] = f"/v1/jobs/{job.id}/result"
        answer.headers["Link"] = f'</v1/jobs/{job.id}>; rel="describedby"'
        return answer
    if job.problem is not None:
        raise ProblemError(job.problem["code"], job.problem["detail"])
    if job.state in (State.CANCELLED, State.EXPIRED):
        raise ProblemError("cancelled", "the job was cancelled before it ended; submit the scene again")
    response = Response(status_code=202, media_type="application/json")
    status = await _accepted(context, response, job)
    if not accepts(request.headers.getlist("accept"), "application/json"):
        text = (
            f"the job has not ended yet and continues; wait for it with GET /v1/jobs/{job.id}?wait="
            f"{MAX_WAIT_SECONDS:g}, then download /v1/jobs/{job.id}/result instead of submitting the scene again"
        )
        headers = {name: response.headers[name] for name in ("Location", "Retry-After")}
        raise ProblemError("not-finished", text, headers=headers)
    response.body = status.model_dump_json(exclude_none=True).encode()
    response.headers["Content-Length"] = str(len(response.body))
    return response


@router.get(
    "/jobs",
    operation_id="list",
    summary="List jobs, newest first",
    response_model_exclude_none=True,
    responses=problems(),
)
async def list_jobs(
    context: Service,
    owner: Owner,
    response: Response,
    limit: Annotated[int, Query(ge=1, le=100, description="Maximum number of jobs on a page.")] = 20,
    cursor: Annotated[str | None, Query(pattern="^[0-9]{1,18}$", description="`next` of the previous page.")] = None,
    state: Annotated[State | None, Query(description="Only jobs in this state.")] = None,
) -> JobPage:
    """List the jobs of the request's key; all jobs if the service requires no keys."""
    response.headers.update(NO_STORE)
    before = int(cursor) if cursor is not None else None
    jobs = await run_sync(lambda: context.store.listing(owner, limit=limit + 1, before=before, state=state))
    cursor = str(jobs[limit - 1].number) if len(jobs) > limit else None
    return JobPage(jobs=await statuses(context, *jobs[:limit]), next=cursor)


@router.head("/jobs/{id}", include_in_schema=False)
@router.get(
    "/jobs/{id}",
    operation_id="status",
    summary="Get the status of a job",
    response_model_exclude_none=True,
    responses=problems("not-found"),
)
async def get_job(
    request: Request, context: Service, job: RequestedJob, response: Response, wait: Wait = 0
) -> JobStatus:
    """Return the status. With `wait`, the response comes when the job ends or the time is over."""
    if wait > 0:
        job = await wait_for_end(context, job, wait, request)
    response.headers.update(NO_STORE)
    if job.state in ACTIVE:
        response.headers["Retry-After"] = "1"
    return (await statuses(context, job))[0]


@router.get(
    "/jobs/{id}/events",
    operation_id="events",
    summary="Follow a job",
    response_class=StreamingResponse,
    responses={
        200: {
            "description": "Server-sent events until the job has ended: `state` with the job's status, `progress` with "
            "a stage, the completed fraction of the job, `seconds_left` and, during training, a note. Ids count from 1 "
            "without gaps.",
            "content": {"text/event-stream": {"schema": _EVENT}},
        },
        204: {"description": "The job has ended, and `Last-Event-ID` was its last event."},
        **problems("not-found"),
    },
)
async def follow_job(
    context: Service,
    job: RequestedJob,
    last_event_id: Annotated[
        str | None,
        Header(pattern="^[0-9]{1,9}$", description="Id of the last event received, to resume after a lost connection."),
    ] = None,
) -> Response:
    """Stream all past and future events of a job as server-sent events."""
    after = int(last_event_id or 0)
    if job.state not in ACTIVE and after >= job.last_event:
        return Response(status_code=204)
    return StreamingResponse(
        _events(context, job, after),
        media_type="text/event-stream",
        headers={"Cache-Control": "no-store", "X-Accel-Buffering": "no"},
    )


@router.post(
    "/jobs/{id}/cancel",
    operation_id="cancel",
    summary="Cancel a job",
    response_model_exclude_none=True,
    responses=problems("not-found"),
)
async def cancel_job(context: Service, job: RequestedJob, response: Response) -> JobStatus:
    """Stop a job immediately. A job that has ended stays unchanged."""
    await context.worker.cancel(job)
    response.headers.update(NO_STORE)
    return (await statuses(context, await reload(context, job)))[0]


@router.delete(
    "/jobs/{id}",
    status_code=204,
    operation_id="delete",
    summary="Delete a job",
    responses={204: {"description": "The job was deleted."}, **problems("not-found")},
)
async def delete_job(context: Service, job: RequestedJob) -> Response:
    """Cancel a job if it has not ended, and remove all its data."""
    await context.worker.cancel(job)
    context.decoder.stop(job.id)
    await run_sync(context.completion.expire, job.number, job.id)  # first, as a folder without a job would be kept
    await run_sync(context.completion.forget, job.number)
    context.notifier.notify_end(job.id)
    log.info("job %s deleted", job.id)
    return Response(status_code=204)


async def _accepted(context: ServiceContainer, response: Response, job: Job) -> JobStatus:
    (status,) = await statuses(context, job)
    response.headers["Location"] = f"/v1/jobs/{job.id}"
    seconds = status.estimate.seconds_left if status.estimate else 0
    response.headers["Retry-After"] = str(max(1, min(60, round(seconds))))
    return status


KEEPALIVE_SECONDS = 15.0  # without an event; then a comment is sent, so that the connection is not taken for dead
RETRY_MILLISECONDS = 1000  # delay after which a browser reconnects, milliseconds


async def _events(context: ServiceContainer, job: Job, after: int) -> AsyncIterator[str]:
    """Yield the events with a ``seq`` above ``after``, until the job ends or is deleted, or the service stops. They are
    framed here: FastAPI's own events have no ids without gaps, and no 204 for a finished stream."""
    yield f"retry: {RETRY_MILLISECONDS}\n\n"
    while True:
        changed = context.notifier.subscribe(job.id)  # before reading, so that no later event is missed
        found = await run_sync(context.store.events, job.number, after)
        current = await run_sync(context.store.get, job.id)  # afterwards, so that it is not older than its last event
        for event in found:
            after, data = event.seq, event.data
            if event.kind == "state" and current is not None and after == current.last_event:
                (status,) = await statuses(context, current)  # with the latest state only
                data = {**data, "job": status.model_dump(mode="json", exclude_none=True)}
            yield f"id: {after}\nevent: {event.kind}\ndata: {json.dumps(data)}\n\n"
        if current is None or (after >= current.last_event and current.state not in ACTIVE) or context.notifier.closing:
            return
        if not await wait(changed, KEEPALIVE_SECONDS):
            yield ": keep-alive\n\n"


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
