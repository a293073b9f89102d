"""All errors of the service, as RFC 9457 problem documents with stable codes. Codes of the library
(``kissgs.KissgsError.code``) keep their names; the other codes belong to the service."""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass
from typing import Any

from pydantic import BaseModel, ConfigDict, Field
from starlette.responses import JSONResponse

MEDIA_TYPE = "application/problem+json"


@dataclass(frozen=True, slots=True)
class ProblemType:
    """HTTP status, title and retryability shared by all problems of one code."""

    status: int
    title: str
    retryable: bool = False


PROBLEM_TYPES: dict[str, ProblemType] = {
    # Errors of the library.
    "invalid-scene": ProblemType(422, "The upload is not a valid Gaussian scene"),
    "invalid-views": ProblemType(422, "The capture, its cameras or its photographs cannot be used"),
    "invalid-container": ProblemType(422, "The file is not a valid container"),
    "unsupported": ProblemType(422, "The scene exceeds a limit or needs an unsupported feature"),
    "output": ProblemType(507, "The result could not be written", retryable=True),
    "cancelled": ProblemType(409, "The job was cancelled"),
    # Errors of jobs.
    "time-limit": ProblemType(422, "The job exceeded the time limit"),
    "memory-limit": ProblemType(422, "The job exceeded the memory limit"),
    "crashed": ProblemType(500, "The job's process crashed or was killed", retryable=True),
    "internal": ProblemType(500, "Internal error of the service", retryable=True),
    # Errors of requests.
    "invalid-request": ProblemType(422, "The request is invalid"),
    "bad-http": ProblemType(400, "The bytes are not a valid HTTP request"),
    "unauthorized": ProblemType(401, "A valid key is required"),
    "foreign": ProblemType(403, "The request comes from another site or uses an unknown host name"),
    "not-found": ProblemType(404, "The resource does not exist"),
    "method-not-allowed": ProblemType(405, "The method is not allowed for this resource"),
    "media-type": ProblemType(415, "The media type of the body is not supported"),
    "too-large": ProblemType(413, "The upload exceeds the size limit"),
    "upload-timeout": ProblemType(408, "The upload was too slow", retryable=True),
    "upload-aborted": ProblemType(400, "The upload ended before it was complete", retryable=True),
    "key-reused": ProblemType(422, "The Idempotency-Key was used for another submission"),
    "not-finished": ProblemType(409, "The job has not ended yet", retryable=True),
    "not-succeeded": ProblemType(409, "The job has no result"),
    "gone": ProblemType(410, "The files have expired or were removed"),
    "range": ProblemType(416, "The requested range is outside the file"),
    "queue-full": ProblemType(429, "Too many jobs are waiting", retryable=True),
    "too-many-jobs": ProblemType(429, "This key has too many jobs waiting or running", retryable=True),
    "too-many-uploads": ProblemType(429, "Too many simultaneous uploads", retryable=True),
    "disk-full": ProblemType(507, "The server has not enough disk space", retryable=True),
    "stopping": ProblemType(503, "The service is stopping", retryable=True),
    "database": ProblemType(503, "The job database cannot be used", retryable=True),
}
"""All problem codes. The meaning of a code never changes."""


class Problem(BaseModel):
    """RFC 9457 problem document: cause and remedy of an error."""

    model_config = ConfigDict(
        json_schema_extra={
            "examples": [
                {
                    "type": "/v1/problems/queue-full",
                    "title": "Too many jobs are waiting",
                    "status": 429,
                    "detail": "100 jobs are waiting, which is the limit; try again in 60 s",
                    "code": "queue-full",
                    "retryable": True,
                }
            ]
        }
    )

    type: str = Field(description="Path of the description of this code.")
    title: str = Field(description="Summary, identical for all problems of this code.")
    status: int = Field(description="HTTP status code.")
    detail: str = Field(description="One sentence with the cause, the limit and the remedy.")
    code: str = Field(description="Stable code; equal to that of the kissgs exception, if the library raised one.")
    retryable: bool = Field(description="Whether the same request may succeed later.")
    errors: list[dict[str, Any]] | None = Field(None, description="Every invalid field, if there are several.")


class ProblemError(Exception):
    """Error that the service answers with a problem document: a code of :data:`PROBLEM_TYPES` and one sentence."""

    def __init__(
        self,
        code: str,
        detail: str,
        *,
        retry_after: float | None = None,
        headers: dict[str, str] | None = None,
        errors: list[dict[str, Any]] | None = None,
    ) -> None:
        super().__init__(detail)
        self.problem = problem(code, detail, errors=errors)
        self.headers = dict(headers or {})
        if retry_after is not None:
            self.headers["Retry-After"] = str(max(1, round(retry_after)))


def problem(code: str, detail: str, *, errors: list[dict[str, Any]] | None = None) -> Problem:
    """Build the document of one problem; a code that is not in :data:`PROBLEM_TYPES` becomes ``internal``."""
    code = code if code in PROBLEM_TYPES else "internal"
    kind = asdict(PROBLEM_TYPES[code])
    return Problem(type=f"/v1/problems/{code}", detail=detail, code=code, errors=errors, **kind)


def invalid(detail: str) -> ProblemError:
    """Return the problem of an invalid request."""
    return ProblemError("invalid-request", detail)


def disk_full(detail: str) -> ProblemError:
    """Return the problem of a full disk."""
    return ProblemError("disk-full", detail, retry_after=600)


def unusable_database() -> ProblemError:
    """Return the problem of a failing database; its cause appears only in the log and in ``/readyz``."""
    return ProblemError("database", "the job database cannot be used for now; try again later", retry_after=5)


def answer(error: ProblemError) -> JSONResponse:
    """Build the HTTP response for a problem."""
    body = error.problem.model_dump(mode="json", exclude_none=True)
    return JSONResponse(body, error.problem.status, headers=error.headers, media_type=MEDIA_TYPE)


def field_errors(errors: Iterable[Mapping[str, Any]]) -> tuple[str, list[dict[str, str]]]:
    """Convert pydantic errors to a text for a sentence and to a list with the field and message of each."""
    first = itertools.islice(errors, 20)  # enough to correct a request
    found = [{"field": ".".join(map(str, e["loc"]))[:200] or "options", "message": str(e["msg"])} for e in first]
    text = "; ".join(f"{item['field']}: {item['message'][:1].lower()}{item['message'][1:]}" for item in found[:5])
    return text, found
