"""The ASGI application: construction, errors as problem documents, start and stop, and its OpenAPI document."""

from __future__ import annotations

import asyncio
import contextlib
import logging
from collections.abc import AsyncIterator
from http import HTTPStatus
from typing import Any

from anyio.to_thread import run_sync
from fastapi import FastAPI, Request
from fastapi.exceptions import RequestValidationError
from fastapi.responses import JSONResponse
from fastapi.routing import APIRoute
from sqlalchemy.exc import SQLAlchemyError
from starlette.exceptions import HTTPException
from starlette.middleware.cors import CORSMiddleware

import kissgs

from ..core.clock import Clock
from ..core.metrics import Metrics
from ..core.notifier import JobNotifier
from ..core.problems import Problem, ProblemError, answer, disk_full, field_errors, unusable_database
from ..core.schemas import JobOptions
from ..core.settings import ServiceSettings, SettingsError
from ..jobs.admission import Admission
from ..jobs.container import ServiceContainer
from ..jobs.decoding import Decoder
from ..jobs.process import JobRunners
from ..jobs.status import EventStream, QueueEstimator
from ..jobs.upkeep import ExpiryTask, recover
from ..jobs.worker import JobCompletion, Worker
from ..storage.database import error_text, is_full
from ..storage.job_files import JobStorage
from ..storage.job_records import open_store
from .middleware import RequestMiddleware
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

log = logging.getLogger("kissgs.service")


def create_app(settings: ServiceSettings) -> FastAPI:
    """Create the service as an ASGI application. Opens its data folder and database and recovers unfinished jobs."""
    context = _build_and_recover(settings)
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
    app.openapi()  # generated at the start, not during a request
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


def _build_and_recover(settings: ServiceSettings) -> ServiceContainer:
    try:
        context = build(settings)
        try:
            recover(context)
        except BaseException:
            context.close()
            raise
    except kissgs.RunnerError as error:
        raise SettingsError(f"KISSGS_RUNNER: jobs cannot run on a Ray cluster: {error}") from error
    except OSError as error:
        raise SettingsError(f"KISSGS_DATA_DIR: cannot use {settings.data_dir}: {str(error).lower()}") from error
    except SQLAlchemyError as error:
        raise SettingsError(f"KISSGS_DATA_DIR: the job database cannot be used: {error_text(error)}") from error
    return context


def build(settings: ServiceSettings) -> ServiceContainer:
    """Create all parts of a service without starting them."""
    with contextlib.ExitStack() as opened:
        storage, clock = JobStorage(settings.data_dir), Clock()
        opened.callback(storage.close)
        store = open_store(storage, clock)
        opened.callback(store.close)
        runners = JobRunners.open(settings)
        opened.pop_all()  # the service closes them
    storage.remove_unfinished(store.ids())
    clock.start_after(store.meta_value("time") or 0.0)
    storage.keep_reserve()
    notifier, metrics = JobNotifier(), Metrics()
    metrics.queue_limit.set(settings.max_queue)
    completion = JobCompletion(settings, store, storage, metrics, clock)
    worker = Worker(settings, store, storage, notifier, metrics, completion, runners)
    queue = QueueEstimator(store, settings.workers)
    admission = Admission(settings, store, storage, queue)
    decoder = Decoder(settings, store, storage, admission, runners)
    event_stream = EventStream(store, notifier, queue)
    return ServiceContainer(
        settings, store, storage, notifier, metrics, clock, worker, queue, admission, decoder, event_stream
    )


@contextlib.asynccontextmanager
async def _lifespan(app: FastAPI) -> AsyncIterator[None]:
    context: ServiceContainer = app.state.context
    context.worker.start()
    expiry = ExpiryTask(context, context.clock())
    tasks = [asyncio.create_task(task) for task in (expiry.run(), expiry.heartbeat())]
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
    made = app.openapi

    def completed() -> dict[str, Any]:
        if app.openapi_schema is None:
            document = made()
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
            app.openapi_schema = document
        return app.openapi_schema

    app.openapi = completed  # type: ignore[method-assign]


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
