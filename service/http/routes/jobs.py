"""Jobs: submit, follow, list, cancel, delete."""

from __future__ import annotations

import logging
from typing import Annotated, Any

from anyio.to_thread import run_sync
from fastapi import APIRouter, Header, Query, Request, Response
from fastapi.responses import StreamingResponse

from service.core.models import ACTIVE, Job, State
from service.core.notifier import ended
from service.core.problems import ProblemError
from service.core.schemas import JobPage, JobStatus
from service.http.routes.common import MAX_WAIT_SECONDS, NO_STORE, Found, accepts, finished, fresh, problems, show
from service.http.routes.results import container
from service.http.submission import RAW_TYPES, submit
from service.jobs.container import Owner, Service, ServiceContainer

log = logging.getLogger("kissgs.service")

router = APIRouter(prefix="/v1", tags=["jobs"])

Options = Annotated[
    str | None,
    Query(
        description="JobOptions as JSON, where the body is the scene itself; in a form they are its field `options`.",
        max_length=8192,
        examples=['{"preset": "fast"}'],
    ),
]
Name = Annotated[str | None, Query(description="What to call the scene; in a form, the file's name.", max_length=1000)]
IdempotencyKey = Annotated[
    str | None,
    Header(
        description="Chosen by the client, new for every job. Sent again with the same scene and options it gives the "
        "same job again, so that a request whose answer was lost can be repeated.",
        min_length=1,
        max_length=255,
        pattern="^[!-~]+$",
    ),
]
Wait = Annotated[
    float,
    Query(description="Seconds to wait for the job's end, if it has not ended yet.", ge=0, le=MAX_WAIT_SECONDS),
]

_REFUSALS = (
    *("invalid-scene", "unsupported", "key-reused", "media-type", "too-large", "upload-timeout", "upload-aborted"),
    *("queue-full", "too-many-jobs", "too-many-uploads", "disk-full", "stopping"),
)

_BODY: dict[str, Any] = {
    "requestBody": {
        "required": True,
        "description": "The scene: as the field `file` of a form, with `options` beside it, or as the body itself.",
        "content": {
            "multipart/form-data": {
                "schema": {
                    "type": "object",
                    "required": ["file"],
                    "additionalProperties": False,
                    "properties": {
                        "file": {"type": "string", "format": "binary", "description": "The `.ply`."},
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
        "description": "Accepted: follow `Location`, not before `Retry-After` seconds.",
        "headers": {
            "Location": {"schema": {"type": "string"}, "description": "Of the job."},
            "Retry-After": {"schema": {"type": "integer"}, "description": "When to look for the first time, seconds."},
        },
    }
}


_EVENT: dict[str, Any] = {
    "type": "object",
    "description": "Of each event.",
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
async def submit_job(
    request: Request,
    response: Response,
    context: Service,
    owner: Owner,
    options: Options = None,
    name: Name = None,
    idempotency_key: IdempotencyKey = None,
) -> JobStatus:
    """Upload a `.ply` and get a job that compresses it.

    The header is checked as soon as it has arrived, limits while the body does. Once this answers, the job is on disk
    and survives whatever happens to the server.
    """
    job, _ = await submit(context, request, owner, options=options, name=name, key=idempotency_key)
    return await _accepted(context, response, job)


@router.post(
    "/compress",
    operation_id="compress",
    summary="Compress a small scene while you wait",
    openapi_extra=_BODY,
    response_class=Response,
    responses={
        200: {
            "description": "The container. `Content-Location` is that of the result, `Link` of the job.",
            "content": {"application/zip": {"schema": {"type": "string", "format": "binary"}}},
        },
        **_ACCEPTED,
        **problems(*_REFUSALS, "crashed", "cancelled", "not-finished", "not-found"),
    },
)
async def compress_now(
    request: Request,
    context: Service,
    owner: Owner,
    options: Options = None,
    name: Name = None,
    idempotency_key: IdempotencyKey = None,
) -> Response:
    """Submit a `.ply` and answer with its container, if the job succeeds within `sync_seconds` of `/v1/limits`.

    After that time the job continues, and the answer is 202 with its status as JSON. A client whose `Accept` header
    excludes JSON gets a 409 problem instead (`not-finished`), with `Location`, so that a program that saves every
    successful answer as a container never saves a status.
    """
    job, _ = await submit(context, request, owner, options=options, name=name, key=idempotency_key)
    job = await finished(context, job, context.settings.sync_seconds, request)
    if job.state == State.SUCCEEDED:
        result = f"/v1/jobs/{job.id}/result"
        answer = container(context, job)
        answer.headers["Content-Location"] = result
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
            f"{MAX_WAIT_SECONDS:g}, then download /v1/jobs/{job.id}/result"
        )
        raise ProblemError("not-finished", text, headers={"Location": response.headers["Location"]})
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
    limit: Annotated[int, Query(ge=1, le=100, description="Jobs on a page.")] = 20,
    cursor: Annotated[str | None, Query(pattern="^[0-9]{1,18}$", description="The `next` of the page before.")] = None,
    state: Annotated[State | None, Query(description="Only jobs in this state.")] = None,
) -> JobPage:
    """The jobs of your key; where the service asks for none, all."""
    response.headers.update(NO_STORE)
    before = int(cursor) if cursor is not None else None
    jobs = await run_sync(lambda: context.store.listing(owner, limit=limit + 1, before=before, state=state))
    return JobPage(
        jobs=await show(context, *jobs[:limit]), next=str(jobs[limit - 1].number) if len(jobs) > limit else None
    )


@router.head("/jobs/{id}", include_in_schema=False)
@router.get(
    "/jobs/{id}",
    operation_id="status",
    summary="Look at a job",
    response_model_exclude_none=True,
    responses=problems("not-found"),
)
async def get_job(request: Request, context: Service, job: Found, response: Response, wait: Wait = 0) -> JobStatus:
    """Where it stands. With `wait`, the answer comes when the job has ended or the time is over."""
    if wait > 0:
        job = await finished(context, job, wait, request)
    response.headers.update(NO_STORE)
    if job.state in ACTIVE:
        response.headers["Retry-After"] = "1"
    return (await show(context, job))[0]


@router.get(
    "/jobs/{id}/events",
    operation_id="events",
    summary="Follow a job",
    response_class=StreamingResponse,
    responses={
        200: {
            "description": "Server-sent events until the job has ended: `state` with the job's status, `progress` with "
            "a stage, a fraction of it and, while it trains, a note. Ids count from 1 without gaps.",
            "content": {"text/event-stream": {"schema": _EVENT}},
        },
        204: {"description": "The job has ended, and `Last-Event-ID` was its last event."},
        **problems("not-found"),
    },
)
async def follow_job(
    context: Service,
    job: Found,
    last_event_id: Annotated[
        str | None, Header(pattern="^[0-9]{1,9}$", description="Where to go on after a broken connection.")
    ] = None,
) -> Response:
    """Everything that has happened to it, and what happens from now on, as server-sent events."""
    after = int(last_event_id or 0)
    if job.state not in ACTIVE and after >= job.last_event:
        return Response(status_code=204)
    return StreamingResponse(
        context.event_stream.stream(job, after),
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
async def cancel_job(context: Service, job: Found, response: Response) -> JobStatus:
    """Stop its work, now. A job that has ended already stays as it is."""
    await context.worker.cancel(job)
    response.headers.update(NO_STORE)
    return (await show(context, await fresh(context, job)))[0]


@router.delete(
    "/jobs/{id}",
    status_code=204,
    operation_id="delete",
    summary="Delete a job",
    responses={204: {"description": "It is gone."}, **problems("not-found")},
)
async def delete_job(context: Service, job: Found) -> Response:
    """Cancel it if need be, and remove everything there is of it."""
    await context.worker.cancel(job)
    context.decoder.stop(job.id)
    gone = {"upload_kept": False, "disk_bytes": 0, "reclaimable_bytes": 0}
    await run_sync(lambda: context.store.move(job.number, State.EXPIRED, **gone))
    await run_sync(context.storage.remove_job, job.id)  # now: a folder that no job owns would be kept
    await run_sync(context.store.forget, job.number)
    context.notifier.notify(job.id)
    context.notifier.notify(ended(job.id))
    log.info("job %s deleted", job.id)
    return Response(status_code=204)


async def _accepted(context: ServiceContainer, response: Response, job: Job) -> JobStatus:
    (status,) = await show(context, job)
    response.headers["Location"] = f"/v1/jobs/{job.id}"
    seconds = status.estimate.seconds_left if status.estimate else 0
    response.headers["Retry-After"] = str(max(1, min(60, round(seconds))))
    return status
