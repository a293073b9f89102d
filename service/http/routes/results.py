"""Routes of results, whose files are sent with ranges, conditional requests and checksums."""

from __future__ import annotations

import base64
import re
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Annotated, Any, TypeVar
from urllib.parse import quote

from anyio.to_thread import run_sync
from fastapi import APIRouter, Response
from fastapi import Path as PathParameter
from starlette.datastructures import Headers, MutableHeaders
from starlette.responses import FileResponse
from starlette.types import Message, Receive, Scope, Send

from ...core.files import CONTAINER_FILES, THUMBNAIL, container_file
from ...core.models import Job, State
from ...core.problems import ProblemError
from .common import RequestedJob, Service, problems


class StoredFile(FileResponse):
    """Starlette's response for an immutable file, with a strong ETag, digests and ``If-None-Match``.

    Of ranges, it sends a single valid one; others are ignored, as RFC 9110 permits. ``download`` is the file name for
    saving in a browser; None lets the browser show the file.
    """

    def __init__(
        self, path: Path, *, sha256: str, media_type: str, download: str | None = None, cached: str = "no-cache"
    ) -> None:
        digest = f"sha-256=:{base64.b64encode(bytes.fromhex(sha256)).decode()}:"
        fixed = {"ETag": f'"{sha256}"', "Content-Digest": digest, "Repr-Digest": digest}
        fixed["Cache-Control"] = f"private, {cached}"
        if download is not None:
            plain = download.encode("ascii", "replace").decode().replace("?", "_").replace('"', "_").replace("\\", "_")
            extended = quote(download, safe="")  # RFC 6266
            fixed["Content-Disposition"] = f"attachment; filename=\"{plain}\"; filename*=UTF-8''{extended}"
        try:
            found = path.stat()
        except FileNotFoundError as error:
            raise ProblemError("gone", "the file was removed during the request; submit the scene again") from error
        super().__init__(path, media_type=media_type, headers=fixed, stat_result=found)
        self._size = found.st_size

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Send 304 if the client has the current file, else the file or the requested range of it."""
        asked = Headers(scope=scope)
        reads = scope["method"] in ("GET", "HEAD")
        if reads and _names(", ".join(asked.getlist("if-none-match")), self.headers["etag"]):
            kept = ("etag", "cache-control", "content-location")
            same = {name: value for name, value in self.headers.items() if name in kept}
            await Response(status_code=304, headers=same)(scope, receive, send)
            return

        async def corrected(message: Message) -> None:
            if message["type"] == "http.response.start" and message["status"] != 200:
                if message["status"] == 416:
                    text = f"the range is outside the file, which has {self._size} bytes; request a range within it"
                    raise ProblemError("range", text, headers={"Content-Range": f"bytes */{self._size}"})
                del MutableHeaders(raw=message["headers"])["content-digest"]  # it would be that of the whole file
            await send(message)

        if not _is_range(asked.getlist("range")):
            scope = {**scope, "headers": [(name, value) for name, value in scope["headers"] if name != b"range"]}
        await super().__call__(scope, receive, corrected)


def _names(header: str, etag: str) -> bool:
    tags = [tag.strip().removeprefix("W/") for tag in header.split(",")]
    return header.strip() == "*" or etag in tags


def _is_range(headers: list[str]) -> bool:
    """Return whether this is a single range of bytes."""
    pattern = r"\s*bytes\s*=\s*([0-9]{0,18})\s*-\s*([0-9]{0,18})\s*"
    found = re.fullmatch(pattern, headers[0], re.IGNORECASE) if len(headers) == 1 else None
    if not found or not (found[1] or found[2]):
        return False
    return not (found[1] and found[2] and int(found[1]) > int(found[2]))


router = APIRouter(prefix="/v1/jobs/{id}", tags=["results"])

Endpoint = TypeVar("Endpoint", bound=Callable[..., Any])

BINARY = "application/octet-stream"
_MEDIA_TYPES = {".webp": "image/webp", ".json": "application/json", ".yaml": "application/yaml"}

CONTAINER_TYPES = tuple(dict.fromkeys(file.media_type for file in CONTAINER_FILES.values()))  # of results

_FOREVER = "max-age=31536000, immutable"  # of container files, which never change

_UNREADY = ("not-found", "not-finished", "not-succeeded", "gone", "range")


def _file_answers(media_types: str, *codes: str) -> dict[int | str, dict[str, Any]]:
    headers = {
        "ETag": {"schema": {"type": "string"}, "description": "SHA-256 of the file."},
        "Repr-Digest": {"schema": {"type": "string"}, "description": "RFC 9530 digest of the whole file."},
        "Accept-Ranges": {"schema": {"type": "string"}, "description": "bytes"},
    }
    digest = {"schema": {"type": "string"}, "description": "RFC 9530 digest of this response."}
    binary, json = {"type": "string", "format": "binary"}, {"type": "object"}
    content = {name: {"schema": json if name == "application/json" else binary} for name in media_types.split()}
    return {
        200: {"description": "The file.", "content": content, "headers": {**headers, "Content-Digest": digest}},
        206: {
            "description": "The requested range.",
            "content": {name: {"schema": binary} for name in content},
            "headers": headers,
        },
        304: {"description": "The file matches `If-None-Match`."},
        **problems(*_UNREADY, *codes),
    }


def _route(path: str, summary: str, media_types: str, *codes: str) -> Callable[[Endpoint], Endpoint]:
    """Make a function the documented GET and HEAD routes of a file."""

    def add(endpoint: Endpoint) -> Endpoint:
        name = endpoint.__name__.removeprefix("get_")
        for method, operation, text in (("GET", name, summary), ("HEAD", f"{name}_head", f"{summary}: headers only")):
            router.add_api_route(
                path,
                endpoint,
                methods=[method],
                operation_id=operation,
                summary=text,
                response_class=Response,
                responses=_file_answers(media_types, *codes),
            )
        return endpoint

    return add


@_route("/result", "Download the container", " ".join(CONTAINER_TYPES))
async def get_result(context: Service, job: RequestedJob) -> StoredFile:
    """The container, `.zip` (SOG-XT) or `.sog`, or the `.spz` or `.compressed.ply`, until the job expires."""
    sha256, kind = _result(job)["container"]["sha256"], container_file(job.options)
    file, download = context.storage.result(job.id) / kind.name, f"{job.name}{kind.ending}"
    return await _stored(file, sha256=sha256, media_type=kind.media_type, download=download)


@_route("/files/{name}", "Download one file of the container", " ".join(_MEDIA_TYPES.values()))
async def get_file(
    context: Service,
    job: RequestedJob,
    name: Annotated[str, PathParameter(description="One of `sizes.files` of the job.")],
) -> Response:
    """One file of the container, for readers that need only some. It never changes and may be cached."""
    files = _result(job)["files"]
    if name not in files:
        raise ProblemError("not-found", f"the job has no file {name[:80]!r}; sizes.files of its status lists all files")
    media_type = _MEDIA_TYPES.get(Path(name).suffix, BINARY)
    file = context.storage.result(job.id) / "files" / name
    return await _stored(file, sha256=files[name]["sha256"], media_type=media_type, cached=_FOREVER)


@_route("/thumbnail.webp", "Download an image of the result", "image/webp")
async def get_thumbnail(context: Service, job: RequestedJob) -> Response:
    """The result, drawn from the camera that its container records, with at most 320 pixels a side."""
    entry = _result(job).get("thumbnail")
    if entry is None:
        raise ProblemError(
            "not-found", "the result has no thumbnail: it shows nothing, drawing it failed, or an older version made it"
        )
    file = context.storage.result(job.id) / THUMBNAIL
    return await _stored(file, sha256=entry["sha256"], media_type="image/webp", cached=_FOREVER)


@_route("/decoded", "Download the decoded scene", BINARY, "disk-full", "memory-limit", "crashed", "time-limit")
async def get_decoded(context: Service, job: RequestedJob) -> Response:
    """The result decoded to a `.ply`, on the first request."""
    _result(job)
    file = await context.decoder.scene(job)
    sha256, download = file.stem.rpartition("-")[2], f"{job.name}.decoded.ply"
    return await _stored(file, sha256=sha256, media_type=BINARY, download=download)


@_route("/source", "Download the upload", BINARY)
async def get_source(context: Service, job: RequestedJob) -> Response:
    """The uploaded scene, for comparisons, unless it was removed to free disk space."""
    _result(job)
    file = await run_sync(context.storage.upload, job.id)
    if file is None or not job.upload_kept:
        raise ProblemError("gone", "the upload was removed to free disk space; the result is still available")
    download = f"{job.name}{file.suffix}"
    return await _stored(file, sha256=job.upload_sha256, media_type=BINARY, download=download)


@_route("/report", "Download the report", "application/json")
async def get_report(context: Service, job: RequestedJob) -> Response:
    """The report of the compression, as from the library."""
    sha256 = _result(job)["report"]["sha256"]
    file = context.storage.result(job.id) / "report.json"
    return await _stored(file, sha256=sha256, media_type="application/json")


async def _stored(path: Path, **values: Any) -> StoredFile:  # noqa: ANN401
    return await run_sync(partial(StoredFile, path, **values))  # it reads the file's size


def _result(job: Job) -> dict[str, Any]:
    """Return the summary of a succeeded job's result."""
    match job.state:
        case State.SUCCEEDED:
            return job.result or {}
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
