"""The ASGI application: construction, conversion of errors to problem documents, start and stop."""

from __future__ import annotations

import asyncio
import contextlib
import logging
from collections.abc import AsyncIterator
from http import HTTPStatus

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
from ..core.problems import ProblemError, answer, field_errors, unusable_database
from ..core.settings import ServiceSettings, SettingsError
from ..jobs.admission import Admission
from ..jobs.completion import JobCompletion
from ..jobs.container import ServiceContainer
from ..jobs.decoding import Decoder
from ..jobs.event_stream import EventStream
from ..jobs.expiry import ExpiryTask
from ..jobs.recovery import recover
from ..jobs.replica_watch import ReplicaWatch
from ..jobs.runner import JobRunner
from ..jobs.status import QueueEstimator
from ..jobs.worker import Worker
from ..storage.database_health import error_text, is_full
from ..storage.folder_binding import open_store
from ..storage.job_files import FolderStorage
from ..storage.s3_storage import S3Storage
from .middleware import RequestMiddleware
from .openapi import describe
from .routes import facts, jobs, page, preview, results

ROUTERS = (jobs.router, results.router, facts.router, page.router, preview.router)

log = logging.getLogger("kissgs.service")


def create_app(settings: ServiceSettings) -> FastAPI:
    """Create the service as an ASGI application. Opens its data folder and database and recovers unfinished jobs.

    Raises:
        SettingsError: the data folder or the database cannot be used.
    """
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
    describe(app, keys_required=bool(settings.keys))
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
            if context.storage.shared:
                ReplicaWatch(context).recover()
            else:
                recover(context)
        except BaseException:
            context.worker.runner.close()
            context.store.close()
            context.storage.close()
            raise
    except kissgs.RunnerError as error:
        raise SettingsError(f"KISSGS_RUNNER: jobs cannot run on a Ray cluster: {error}") from error
    except OSError as error:
        raise SettingsError(f"KISSGS_DATA_DIR: cannot use {settings.data_dir}: {str(error).lower()}") from error
    except SQLAlchemyError as error:
        raise SettingsError(f"KISSGS_DATABASE_URL: the job database cannot be used: {error_text(error)}") from error
    return context


def build(settings: ServiceSettings) -> ServiceContainer:
    """Create all parts of a service without starting them."""
    storage = S3Storage(settings.storage, settings.data_dir) if settings.storage else FolderStorage(settings.data_dir)
    clock = Clock()
    try:
        runner = JobRunner.open(settings)  # first, because a replica that connects for long has no heartbeat meanwhile
    except BaseException:
        storage.close()
        raise
    try:
        store = open_store(settings, storage, clock)
    except BaseException:
        runner.close()
        storage.close()
        raise
    storage.remove_unfinished(store.ids())
    clock.start_after(store.latest_time())
    storage.keep_reserve()
    notifier, metrics = JobNotifier(), Metrics()
    metrics.queue_limit.set(settings.max_queue)
    completion = JobCompletion(settings, store, storage, metrics, clock)
    worker = Worker(settings, store, storage, notifier, metrics, completion, runner)
    queue = QueueEstimator(store, settings.workers)
    admission = Admission(settings, store, storage, queue)
    decoder = Decoder(settings, store, storage, admission, runner)
    event_stream = EventStream(store, notifier, queue)
    return ServiceContainer(
        settings, store, storage, notifier, metrics, clock, worker, queue, admission, decoder, event_stream
    )


@contextlib.asynccontextmanager
async def _lifespan(app: FastAPI) -> AsyncIterator[None]:
    context: ServiceContainer = app.state.context
    context.worker.start()
    expiry = ExpiryTask(context, context.clock())
    watch = ReplicaWatch(context)
    running = (watch.heartbeat(), watch.follow()) if context.storage.shared else (expiry.heartbeat(),)
    tasks = [asyncio.create_task(task) for task in (expiry.run(), *running)]
    try:
        yield
    finally:
        context.notifier.close()
        await context.worker.drain()
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)
        await run_sync(context.worker.runner.close)
        context.store.close()
        context.storage.close()


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
                return answer(
                    ProblemError(
                        "not-found", f"{request.scope['path'][:200]} does not exist; /openapi.json lists all paths"
                    )
                )
            case HTTPStatus.METHOD_NOT_ALLOWED:
                allowed = _allowed(request.scope["path"])
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
            return answer(ProblemError("disk-full", "the server's disk is full; try again later", retry_after=600))
        return answer(unusable_database())


def _allowed(path: str) -> str:
    """List the methods of all routes with this path; FastAPI lists only those of the first route."""
    routes = [route for router in ROUTERS for route in router.routes if isinstance(route, APIRoute)]
    fitting = [route.methods or set() for route in routes if route.path_regex.match(path)]
    return ", ".join(sorted(set().union(*fitting))) or "GET, HEAD"
