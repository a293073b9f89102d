"""What the service says of itself: limits, presets, problems, version, health, metrics."""

from __future__ import annotations

from typing import Annotated

from anyio.to_thread import run_sync
from fastapi import APIRouter, Path, Response
from sqlalchemy.exc import SQLAlchemyError

import kissgs
from service.core.metrics import CONTENT_TYPE
from service.core.presets import can_train, presets
from service.core.problems import PROBLEM_TYPES, ProblemError
from service.core.schemas import Health, Limits, Presets, ProblemKind, Version
from service.http.routes.common import MAX_WAIT_SECONDS, NO_STORE, problems
from service.jobs.container import Service, ServiceContainer
from service.storage.database_health import error_text
from service.storage.job_storage import ORPHANED

router = APIRouter()

API_VERSION = "1.0"
CONTAINER = "SOG-XT"


@router.get("/v1/limits", tags=["facts"], operation_id="limits", summary="What is accepted")
async def get_limits(context: Service) -> Limits:
    """Ask before uploading: whatever is beyond these is refused."""
    settings = context.settings
    return Limits(
        formats=["ply", "compressed.ply"],
        max_upload_bytes=settings.max_upload_bytes,
        max_header_bytes=settings.max_header_bytes,
        max_gaussians=settings.max_gaussians,
        max_sh_degree=3,
        max_queue=settings.max_queue,
        max_jobs_per_key=settings.max_jobs_per_key if settings.keys else None,
        max_uploads=settings.max_uploads,
        job_seconds=settings.job_seconds,
        job_memory_bytes=settings.job_memory,
        keep_seconds=settings.keep_seconds,
        sync_seconds=settings.sync_seconds,
        max_wait_seconds=MAX_WAIT_SECONDS,
        keys_required=bool(settings.keys),
        training=can_train(),
    )


@router.get("/v1/presets", tags=["facts"], operation_id="presets", summary="What can be chosen")
async def get_presets() -> Presets:
    """All presets, with what each costs and gives, and every setting that options may replace."""
    return presets()


@router.get("/v1/problems", tags=["facts"], operation_id="problems", summary="What can go wrong")
async def get_problems() -> list[ProblemKind]:
    """Every code that a problem document may have."""
    return [_kind(code) for code in PROBLEM_TYPES]


@router.get(
    "/v1/problems/{code}",
    tags=["facts"],
    operation_id="problem",
    summary="What a code means",
    responses=problems("not-found"),
)
async def get_problem(code: Annotated[str, Path(description="Of a problem.", max_length=64)]) -> ProblemKind:
    """Where the `type` of a problem document leads."""
    if code not in PROBLEM_TYPES:
        raise ProblemError("not-found", f"there is no code {code!r}; GET /v1/problems lists all")
    return _kind(code)


@router.head("/version", include_in_schema=False)
@router.get("/version", tags=["health"], operation_id="version", summary="Which software this is")
async def get_version() -> Version:
    """Of the library, of this interface, and the kind of containers."""
    return Version(kissgs=kissgs.__version__, api=API_VERSION, container=CONTAINER)


@router.head("/livez", include_in_schema=False)
@router.get("/livez", tags=["health"], operation_id="livez", summary="Whether the process is alive")
async def get_livez() -> Health:
    """It answers: it is. Restart it when it does not."""
    return Health(ready=True, checks={"process": "ok"})


@router.head("/readyz", include_in_schema=False)
@router.get(
    "/readyz",
    tags=["health"],
    operation_id="readyz",
    summary="Whether it can take jobs",
    responses={503: {"model": Health, "description": "Some part does not do its work."}},
)
async def get_readyz(context: Service, response: Response) -> Health:
    """Tests the worker's loop, the database and the disk. Send requests elsewhere while it is not ready."""
    health_problem = {
        "worker": context.worker.health_problem(),
        "database": await run_sync(_database_problem, context),
        "disk": await run_sync(_disk_problem, context),
    }
    ready = not any(health_problem.values())
    checks = {part: text or "ok" for part, text in health_problem.items()}
    if orphaned := await run_sync(context.storage.count_orphaned):
        checks["orphaned"] = f"folders that no job owns lie in jobs/{ORPHANED} of the data folder: {orphaned}"
    response.status_code = 200 if ready else 503
    response.headers.update(NO_STORE)
    return Health(ready=ready, checks=checks)


@router.get(
    "/metrics",
    tags=["health"],
    operation_id="metrics",
    summary="Figures for Prometheus",
    response_class=Response,
    responses={200: {"content": {CONTENT_TYPE: {"schema": {"type": "string"}}}, "description": "OpenMetrics."}},
)
async def get_metrics(context: Service) -> Response:
    """Queue, states, durations of jobs and stages, bytes, ratios, requests. None of them names a client."""
    counts, disk = await run_sync(lambda: (context.store.counts(), context.store.disk_bytes()))
    context.metrics.uploads.set(context.admission.uploads)
    return Response(context.metrics.text(counts, disk), media_type=CONTENT_TYPE)


def _kind(code: str) -> ProblemKind:
    kind = PROBLEM_TYPES[code]
    return ProblemKind(code=code, status=kind.status, title=kind.title, retryable=kind.retryable)


def _database_problem(context: ServiceContainer) -> str | None:
    health_problem = context.store.health_problem()
    if health_problem is None:
        try:
            context.store.heartbeat()
        except SQLAlchemyError as error:
            health_problem = error_text(error)
    return None if health_problem is None else f"the job database cannot be used: {health_problem}"


def _disk_problem(context: ServiceContainer) -> str | None:
    needed = context.settings.min_free_bytes
    if health_problem := context.storage.health_problem():
        return health_problem
    try:
        free = context.storage.free_bytes()
    except OSError as error:
        return f"the data folder cannot be used: {(error.strerror or str(error)).lower()}"
    return None if free >= needed else f"{free:,} bytes are free, {needed:,} are to stay free"
