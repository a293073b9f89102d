"""Everything that can go wrong, as RFC 9457 problem documents with stable codes.

A code of the library (``kissgs.KissgsError.code``) keeps its name here; the others are the service's own.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any

from pydantic import BaseModel, ConfigDict, Field
from starlette.responses import JSONResponse

MEDIA_TYPE = "application/problem+json"


@dataclass(frozen=True, slots=True)
class ProblemType:
    """What all problems of one code have in common."""

    status: int
    title: str
    retryable: bool = False


PROBLEM_TYPES: dict[str, ProblemType] = {
    # The library's own.
    "invalid-scene": ProblemType(422, "The upload is not a usable Gaussian scene"),
    "invalid-container": ProblemType(422, "The bytes are not a SOG-XT container"),
    "unsupported": ProblemType(422, "Beyond a limit, or a feature that kissgs does not have"),
    "output": ProblemType(507, "The result could not be written", retryable=True),
    "cancelled": ProblemType(409, "The job was cancelled"),
    # What a job can meet.
    "time-limit": ProblemType(422, "The job took longer than a job may"),
    "memory-limit": ProblemType(422, "The job needed more memory than a job may have"),
    "crashed": ProblemType(500, "The job's process was ended from outside or crashed", retryable=True),
    "internal": ProblemType(500, "A fault of the service", retryable=True),
    # What a request can meet.
    "invalid-request": ProblemType(422, "The request is not one the service understands"),
    "bad-http": ProblemType(400, "The bytes are not a request of HTTP"),
    "unauthorized": ProblemType(401, "A key is needed"),
    "foreign": ProblemType(403, "The request comes from another site's page, or under another name"),
    "not-found": ProblemType(404, "There is no such thing here"),
    "method-not-allowed": ProblemType(405, "This cannot be done to it"),
    "media-type": ProblemType(415, "The body is of a type the service does not read"),
    "too-large": ProblemType(413, "The upload is larger than an upload may be"),
    "upload-timeout": ProblemType(408, "The upload came too slowly", retryable=True),
    "upload-aborted": ProblemType(400, "The upload ended before it was complete", retryable=True),
    "key-reused": ProblemType(422, "The Idempotency-Key belongs to another upload"),
    "not-finished": ProblemType(409, "The job has not ended yet", retryable=True),
    "not-succeeded": ProblemType(409, "The job has no result"),
    "gone": ProblemType(410, "It has expired and was removed"),
    "range": ProblemType(416, "The range lies outside the file"),
    "queue-full": ProblemType(429, "Too many jobs are waiting", retryable=True),
    "too-many-jobs": ProblemType(429, "This key has too many jobs waiting or running", retryable=True),
    "too-many-uploads": ProblemType(429, "Too many uploads at the same time", retryable=True),
    "disk-full": ProblemType(507, "There is no room for it", retryable=True),
    "stopping": ProblemType(503, "The service is stopping", retryable=True),
    "database": ProblemType(503, "The job database cannot be used", retryable=True),
}
"""Every code there is. A code never changes its meaning."""


class Problem(BaseModel):
    """RFC 9457: what is wrong, where, and how to mend it."""

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

    type: str = Field(description="Where this code is described.")
    title: str = Field(description="The same for all problems of this code.")
    status: int = Field(description="HTTP status.")
    detail: str = Field(description="One sentence: what is wrong, where, and how to mend it.")
    code: str = Field(description="Stable; that of kissgs' own exceptions where it is one.")
    retryable: bool = Field(description="Whether the same request may succeed later.")
    errors: list[dict[str, Any]] | None = Field(None, description="Where several fields are wrong: each of them.")


class ProblemError(Exception):
    """Raised anywhere below a route; answered as a problem document.

    Args:
        code: one of :data:`PROBLEM_TYPES`.
        detail: one sentence for the user.
        retry_after: seconds, sent as ``Retry-After``.
        headers: sent with the answer.
        errors: where several fields are wrong, each of them.
    """

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
    """The document of one problem."""
    kind = PROBLEM_TYPES[code]
    return Problem(
        type=f"/v1/problems/{code}",
        title=kind.title,
        status=kind.status,
        detail=detail,
        code=code,
        retryable=kind.retryable,
        errors=errors,
    )


def unusable_database() -> ProblemError:
    """The problem of a database that fails; the log and ``/readyz`` say more than clients are told."""
    return ProblemError("database", "the job database cannot be used for now; try again later", retry_after=5)


def answer(error: ProblemError) -> JSONResponse:
    """The answer that carries it."""
    body = error.problem.model_dump(mode="json", exclude_none=True)
    return JSONResponse(body, error.problem.status, headers=error.headers, media_type=MEDIA_TYPE)


def fields_of(errors: Iterable[Mapping[str, Any]]) -> tuple[str, list[dict[str, str]]]:
    """What pydantic says of several fields: as the beginning of a sentence, and one by one."""
    first = itertools.islice(errors, 20)  # whoever gets more wrong has other worries
    found = [{"field": ".".join(map(str, e["loc"]))[:200] or "options", "message": str(e["msg"])} for e in first]
    text = "; ".join(f"{item['field']}: {item['message'][:1].lower()}{item['message'][1:]}" for item in found[:5])
    return text, found
