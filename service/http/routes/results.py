"""Routes of a job's files: container, its single files, decoded scene, upload, report."""

from __future__ import annotations

import logging
from collections.abc import Callable
from pathlib import PurePath
from typing import Annotated, Any

from anyio.to_thread import run_sync
from fastapi import APIRouter, Path, Response

from ...core.formats import CONTAINER_FILES, container_file
from ...core.models import Job, State
from ...core.problems import ProblemError, unusable_storage
from ...jobs.completion import result_folder
from ...jobs.container import Service, ServiceContainer
from ...storage.job_storage import StoredObject
from ...storage.object_store import ObjectStoreError
from ..file_response import StoredFile, described, removed
from .common import RequestedJob, problems

log = logging.getLogger("kissgs.service")

router = APIRouter(prefix="/v1/jobs/{id}", tags=["results"])

_MEDIA_TYPES = {".webp": "image/webp", ".json": "application/json", ".yaml": "application/yaml"}

CONTAINER_TYPES = tuple(file.media_type for file in CONTAINER_FILES.values())
"""Media types of containers."""

_PRIVATE = {"Cache-Control": "private, no-cache"}
_FOREVER = {"Cache-Control": "private, max-age=31536000, immutable"}
"""Headers of container files, which never change."""

_UNREADY = ("not-found", "not-finished", "not-succeeded", "gone", "range", "storage")


def _file_answers(media_types: str, *codes: str) -> dict[int | str, dict[str, Any]]:
    headers = {
        "ETag": {"schema": {"type": "string"}, "description": "SHA-256 of the file."},
        "Repr-Digest": {"schema": {"type": "string"}, "description": "RFC 9530 digest of the whole file."},
        "Accept-Ranges": {"schema": {"type": "string"}, "description": "bytes"},
    }
    full = {
        **headers,
        "Content-Digest": {"schema": {"type": "string"}, "description": "RFC 9530 digest of this response."},
    }
    binary, json = {"type": "string", "format": "binary"}, {"type": "object"}
    content = {name: {"schema": json if name == "application/json" else binary} for name in media_types.split()}
    return {
        200: {"description": "The file.", "content": content, "headers": full},
        206: {
            "description": "The requested range.",
            "content": {name: {"schema": binary} for name in content},
            "headers": headers,
        },
        304: {"description": "The file matches `If-None-Match`."},
        **problems(*_UNREADY, *codes),
    }


async def get_result(context: Service, job: RequestedJob) -> Response:
    """The container, `.zip` (SOG-XT) or `.sog` as the options say, until the job expires."""
    return await container(context, job)


async def get_file(
    context: Service, job: RequestedJob, name: Annotated[str, Path(description="One of `sizes.files` of the job.")]
) -> Response:
    """One file of the container, for readers that need only some. It never changes and may be cached."""
    _ready(job)
    entry = described(job.result or {}, ("files", name))
    media_type = _MEDIA_TYPES.get(PurePath(name).suffix, "application/octet-stream")
    file = await _open(context, job, f"{result_folder(job)}/files/{name}")
    return StoredFile(file, sha256=entry["sha256"], media_type=media_type, headers=_FOREVER)


async def get_decoded(context: Service, job: RequestedJob) -> Response:
    """The container decoded to a `.ply`, on the first request."""
    _ready(job)
    file, entry = await context.decoder.scene(job)
    media_type = "application/octet-stream"
    download = f"{job.name}.decoded.ply"
    return StoredFile(file, sha256=entry["sha256"], media_type=media_type, download=download, headers=_PRIVATE)


async def get_source(context: Service, job: RequestedJob) -> Response:
    """The uploaded scene, for comparisons, unless it was removed to free disk space."""
    _ready(job)
    name = await run_sync(context.storage.upload_name, job.id) if job.upload_kept else None
    if name is None:
        raise ProblemError("gone", "the upload was removed to free disk space; the result is still available")
    media_type, download = "application/octet-stream", f"{job.name}{PurePath(name).suffix}"
    file = await _open(context, job, name)
    return StoredFile(file, sha256=job.upload_sha256, media_type=media_type, download=download, headers=_PRIVATE)


async def get_report(context: Service, job: RequestedJob) -> Response:
    """The report of the compression, as from the library."""
    _ready(job)
    entry = described(job.result or {}, ("report",))
    file = await _open(context, job, f"{result_folder(job)}/report.json")
    return StoredFile(file, sha256=entry["sha256"], media_type="application/json", headers=_PRIVATE)


async def container(context: ServiceContainer, job: Job) -> StoredFile:
    """Return the response with the container of a succeeded job.

    Raises:
        ProblemError: the job has not succeeded.
    """
    _ready(job)
    entry = described(job.result or {}, ("container",))
    kind = container_file(job.options)
    file, download = await _open(context, job, f"{result_folder(job)}/{kind.name}"), f"{job.name}{kind.ending}"
    return StoredFile(file, sha256=entry["sha256"], media_type=kind.media_type, download=download, headers=_PRIVATE)


async def _open(context: ServiceContainer, job: Job, name: str) -> StoredObject:
    try:
        return await run_sync(context.storage.open, job.id, name)
    except FileNotFoundError as error:
        raise removed() from error
    except ObjectStoreError as error:
        log.error("job %s: %s cannot be read: %s", job.id, name, error)
        raise unusable_storage() from error


def _ready(job: Job) -> None:
    match job.state:
        case State.SUCCEEDED:
            return
        case State.QUEUED | State.RUNNING:
            text = f"the job is {job.state}; follow it at /v1/jobs/{job.id}/events or try again later"
            raise ProblemError("not-finished", text, retry_after=2)
        case State.EXPIRED:
            raise ProblemError("gone", "the job has expired and its files were removed; submit the scene again")
        case State.FAILED:
            reason = (job.problem or {}).get("detail", "")
            raise ProblemError("not-succeeded", f"the job failed: {reason}")
        case _:
            raise ProblemError("not-succeeded", "the job was cancelled; submit the scene again")


def _add(endpoint: Callable[..., Any], path: str, summary: str, media_types: str, *codes: str) -> None:
    """Add documented GET and HEAD routes of a file."""
    name = endpoint.__name__.removeprefix("get_")
    for method, operation in (("GET", name), ("HEAD", f"{name}_head")):
        router.add_api_route(
            path,
            endpoint,
            methods=[method],
            operation_id=operation,
            summary=summary if method == "GET" else f"{summary}: headers only",
            response_class=Response,
            responses=_file_answers(media_types, *codes),
        )


_add(
    get_result,
    "/result",
    "Download the container",
    " ".join(CONTAINER_TYPES),
)
_add(get_file, "/files/{name}", "Download one file of the container", " ".join(_MEDIA_TYPES.values()))
_add(
    get_decoded,
    "/decoded",
    "Download the decoded scene",
    "application/octet-stream",
    "disk-full",
    "memory-limit",
    "crashed",
    "time-limit",
)
_add(get_source, "/source", "Download the upload", "application/octet-stream")
_add(get_report, "/report", "Download the report", "application/json")
