"""The ASGI application: construction, errors as problem documents, start and stop, its OpenAPI document; and middleware
for every request: host and origin checks, request ids, security headers, metrics and access log."""

from __future__ import annotations

import asyncio
import contextlib
import logging
import re
import time
import uuid
from collections.abc import AsyncIterator
from http import HTTPStatus
from typing import Any

from anyio.to_thread import run_sync
from fastapi import FastAPI, Request
from fastapi.exceptions import RequestValidationError
from fastapi.responses import JSONResponse
from fastapi.routing import APIRoute
from sqlalchemy.exc import SQLAlchemyError
from starlette.datastructures import Headers, MutableHeaders
from starlette.exceptions import HTTPException
from starlette.middleware.cors import CORSMiddleware
from starlette.types import ASGIApp, Message, Receive, Scope, Send

import kissgs

from ..core.metrics import Metrics
from ..core.problems import Problem, ProblemError, answer, disk_full, field_errors, unusable_database
from ..core.schemas import JobOptions
from ..core.settings import ServiceSettings, SettingsError
from ..jobs.container import ServiceContainer
from ..storage.database import error_text, is_full
from .routes import facts, jobs, page, results

DESCRIPTION = """\
Upload a 3D Gaussian Splatting scene (`.ply`, `.sog`, `.spz`, `.splat`, `.ksplat`, `.glb`), follow the job, download a
SOG-XT container of a few megabytes.

    curl -F file=@scene.ply -F 'options={"preset": "balanced"}' localhost:8000/v1/jobs
    curl 'localhost:8000/v1/jobs/ID?wait=30'
    curl --fail -OJ localhost:8000/v1/jobs/ID/result

Errors are RFC 9457 problem documents. `code` is stable, `detail` has the remedy, and `/v1/problems` lists all codes.
"""

_JOB_OPERATIONS = ("status", "events", "cancel", "delete", "result", "file", "thumbnail", "decoded", "source", "report")
"""Operations with the id of a job as a parameter."""

ROUTERS = (jobs.router, results.router, facts.router, page.router)

log, access_log = logging.getLogger("kissgs.service"), logging.getLogger("kissgs.access")


def create_app(settings: ServiceSettings) -> FastAPI:
    """Create the service as an ASGI application. Opens its data folder and database and recovers unfinished jobs."""
    context = _opened(settings)
    app = FastAPI(
        title="kissgs",
        version=facts.API_VERSION,
        lifespan=_lifespan,
        docs_url=None,
        redoc_url=None,
        openapi_url="/openapi.json",
        redirect_slashes=False,
        separate_input_output_schemas=False,
    )
    app.state.context = context
    for router in ROUTERS:
        app.include_router(router)
    app.mount("/static", page.RevalidatedFiles(directory=page.STATIC), name="static")
    _describe(app, keys_required=bool(settings.keys))
    _answer_errors(app)
    if settings.cors_origins:
        app.add_middleware(
            CORSMiddleware,
            allow_origins=settings.cors_origins,
            allow_methods=["GET", "HEAD", "POST", "DELETE"],
            allow_headers=[
                *("Authorization", "Content-Type", "Idempotency-Key", "Last-Event-ID", "X-Request-ID"),
                *("If-None-Match", "If-Range", "Range"),
            ],
            expose_headers=[
                *("Location", "Link", "Retry-After", "X-Request-ID", "Content-Location", "Content-Disposition"),
                *("ETag", "Content-Digest", "Repr-Digest", "Content-Range"),
            ],
        )
    app.add_middleware(RequestMiddleware, metrics=context.metrics, settings=settings)
    return app


def _opened(settings: ServiceSettings) -> ServiceContainer:
    try:
        return ServiceContainer(settings)
    except kissgs.RunnerError as error:
        raise SettingsError(f"KISSGS_RUNNER: jobs cannot run on a Ray cluster: {error}") from error
    except OSError as error:
        raise SettingsError(f"KISSGS_DATA_DIR: cannot use {settings.data_dir}: {str(error).lower()}") from error
    except SQLAlchemyError as error:
        raise SettingsError(f"KISSGS_DATA_DIR: the job database cannot be used: {error_text(error)}") from error


@contextlib.asynccontextmanager
async def _lifespan(app: FastAPI) -> AsyncIterator[None]:
    context: ServiceContainer = app.state.context
    context.worker.start()
    tasks = [asyncio.create_task(task) for task in (context.keep_sweeping(), context.keep_time())]
    try:
        yield
    finally:
        context.notifier.close()
        await context.worker.drain()
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)
        await run_sync(context.close)


def _answer_errors(app: FastAPI) -> None:
    @app.exception_handler(ProblemError)
    async def expected(request: Request, error: ProblemError) -> JSONResponse:
        return answer(error)

    @app.exception_handler(RequestValidationError)
    async def invalid(request: Request, error: RequestValidationError) -> JSONResponse:
        text, found = field_errors(error.errors())
        return answer(ProblemError("invalid-request", f"{text}; see /openapi.json", errors=found))

    @app.exception_handler(HTTPException)
    async def plain(request: Request, error: HTTPException) -> JSONResponse:
        headers = dict(error.headers or {})
        match error.status_code:
            case HTTPStatus.NOT_FOUND:
                text = f"{request.scope['path'][:200]} does not exist; /openapi.json lists all paths"
                return answer(ProblemError("not-found", text))
            case HTTPStatus.METHOD_NOT_ALLOWED:
                # Of all routes with this path: FastAPI names the methods of the first one.
                routes = [route for router in ROUTERS for route in router.routes if isinstance(route, APIRoute)]
                fitting = [r.methods or set() for r in routes if r.path_regex.match(request.scope["path"])]
                allowed = ", ".join(sorted(set().union(*fitting))) or "GET, HEAD"
                text = f"{request.method[:20]} is not allowed for this path; use {allowed}"
                return answer(ProblemError("method-not-allowed", text, headers={"Allow": allowed}))
            case _:
                return answer(ProblemError("invalid-request", f"{error.detail}; see /openapi.json", headers=headers))

    @app.exception_handler(kissgs.KissgsError)
    async def library(request: Request, error: kissgs.KissgsError) -> JSONResponse:
        return answer(ProblemError(error.code, str(error)))

    @app.exception_handler(SQLAlchemyError)
    async def database(request: Request, error: SQLAlchemyError) -> JSONResponse:
        log.error("the job database failed: %s", error)
        if is_full(error):
            return answer(disk_full("the server's disk is full; try again later"))
        return answer(unusable_database())


def _describe(app: FastAPI, *, keys_required: bool) -> None:
    """Complete the OpenAPI document: schemas of errors and of form fields, links to the operations on a new job, and
    authorization, which is optional unless keys are required."""
    app.description = DESCRIPTION
    document = app.openapi()
    schemas = document["components"]["schemas"]
    for model in (Problem, JobOptions):
        schema = model.model_json_schema(ref_template="#/components/schemas/{model}")
        schemas.update(schema.pop("$defs", {}))
        schemas[model.__name__] = schema
    for unused in ("HTTPValidationError", "ValidationError"):
        schemas.pop(unused, None)
    for path in document["paths"].values():
        for operation in path.values():
            _complete(operation, keys_required)
    app.openapi = lambda: document  # type: ignore[method-assign]  # FastAPI would generate it again when routes change


def _complete(operation: dict[str, Any], keys_required: bool) -> None:
    if "security" in operation and not keys_required:
        operation["security"].append({})
    for parameter in operation.get("parameters", []):  # an absent parameter is not null
        choices = [choice for choice in parameter["schema"].pop("anyOf", []) if choice != {"type": "null"}]
        parameter["schema"] |= choices[0] if choices else {}
    made = operation["responses"].get("202")
    if made is not None:
        for name in _JOB_OPERATIONS:
            parameters = {"id": "$response.body#/id", **({"name": "meta.json"} if name == "file" else {})}
            made.setdefault("links", {})[name] = {"operationId": name, "parameters": parameters}


PAGE_POLICY = (
    "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' data: blob:; connect-src 'self'; "
    "form-action 'none'; base-uri 'none'; frame-ancestors 'none'"
)
"""Content-Security-Policy of the pages: no external resources, no embedding in frames."""

SECURITY_HEADERS = {
    "X-Content-Type-Options": "nosniff",
    "Referrer-Policy": "no-referrer",
    "Cross-Origin-Resource-Policy": "same-origin",
}
"""Headers of every answer. The last keeps pages of other sites from embedding images and files of jobs; it does not
concern the requests of scripts, which CORS permits or not."""

METHODS = ("GET", "HEAD", "POST", "DELETE", "OPTIONS", "PUT", "PATCH")


class RequestMiddleware:
    """ASGI middleware around the application; metrics have the template of a route as a label, never client input."""

    def __init__(self, app: ASGIApp, metrics: Metrics, settings: ServiceSettings) -> None:
        self._app, self._metrics, self._settings = app, metrics, settings

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Serve one request."""
        if scope["type"] != "http":
            await self._app(scope, receive, send)
            return
        headers = Headers(scope=scope)
        given = headers.get("x-request-id", "")
        request_id = given if re.fullmatch(r"[A-Za-z0-9._-]{1,64}", given) else uuid.uuid4().hex[:16]
        scope.setdefault("state", {})["request_id"] = request_id
        begun, status = time.perf_counter(), 0

        async def sending(message: Message) -> None:
            nonlocal status
            if message["type"] == "http.response.start":
                status = message["status"]
                self._metrics.latency.labels(_route(scope)).observe(time.perf_counter() - begun)
                answered = MutableHeaders(scope=message)
                answered["X-Request-ID"] = request_id
                answered.update(SECURITY_HEADERS)
                answered.setdefault("Content-Security-Policy", PAGE_POLICY)  # the preview page has its own
            await send(message)

        try:
            refusal = self._refusal(scope["method"], headers)
            await (self._app if refusal is None else answer(refusal))(scope, receive, sending)
        except Exception:
            log.exception("request %s failed", request_id)
            if status == 0:
                text = f"an internal error of the service; report it with the request id {request_id}"
                await answer(ProblemError("internal", text))(scope, receive, sending)
        finally:
            method = scope["method"] if scope["method"] in METHODS else "other"
            self._metrics.requests.labels(method, _route(scope), status).inc()
            target = scope.get("raw_path", b"").decode("ascii", "replace")
            spent = 1e3 * (time.perf_counter() - begun)
            access_log.info("%s %s %d %.0f ms %s", method, target[:500], status, spent, request_id)

    def _refusal(self, method: str, headers: Headers) -> ProblemError | None:
        """Return the error for a foreign host name (DNS rebinding) or a foreign origin (CSRF); None to allow. Requests
        without an ``Origin`` header do not come from a page of another site."""
        host = headers.get("host", "")
        name = host.rpartition(":")[0] if re.search(r":[0-9]*$", host) else host
        if not self._settings.answers_to(name.strip("[]").lower()):
            text = f"the host name {host[:100]!r} is not accepted; the operator can add it to KISSGS_NAMES"
            return ProblemError("foreign", text)
        origin = headers.get("origin")
        if method in ("GET", "HEAD", "OPTIONS") or origin is None or origin.lower() in self._settings.cors_origins:
            return None
        if "*" in self._settings.cors_origins or origin.lower().partition(":")[2] == f"//{host.lower()}":
            return None
        text = f"pages of {origin[:100]!r} may not use this service; the operator can add it to KISSGS_CORS_ORIGINS"
        return ProblemError("foreign", text)


def _route(scope: Scope) -> str:
    route = scope.get("route")
    return str(getattr(route, "path", "none"))
