"""Routes about the service itself: limits, presets, problem types, version, health, metrics."""

from __future__ import annotations

import asyncio
from dataclasses import asdict
from typing import Annotated

from anyio.to_thread import run_sync
from fastapi import APIRouter, Path, Response
from sqlalchemy.exc import SQLAlchemyError

import kissgs
from kissgs.formats import DOUBLE_ENDINGS, UPLOADS

from ...core.files import CONTAINER_FILES
from ...core.metrics import CONTENT_TYPE
from ...core.presets import can_train, presets
from ...core.problems import PROBLEM_TYPES, ProblemError
from ...core.schemas import Health, Limits, Presets, ProblemKind, Version
from ...jobs.container import ServiceContainer
from ...storage.database import error_text
from ...storage.job_files import ORPHANED
from .common import MAX_WAIT_SECONDS, NO_STORE, Service, problems

router = APIRouter()

API_VERSION = "1.0"


@router.get("/v1/limits", tags=["facts"], operation_id="limits", summary="Get the limits")
async def get_limits(context: Service) -> Limits:
    """Limits of uploads and jobs; requests beyond them are refused."""
    settings = context.settings
    limits = {
        **settings.model_dump(include=set(Limits.model_fields)),  # those of the same name
        "formats": [ending.removeprefix(".") for ending in (*UPLOADS.values(), *DOUBLE_ENDINGS)],
        "containers": list(CONTAINER_FILES),
        "max_header_bytes": settings.max_header_bytes,
        "max_sh_degree": 3,
        "max_jobs_per_key": settings.max_jobs_per_key if settings.keys else None,
        "job_memory_bytes": settings.job_memory,
        "sync_seconds": settings.sync_seconds,
        "max_wait_seconds": MAX_WAIT_SECONDS,
        "keys_required": bool(settings.keys),
        "training": can_train(),
    }
    return Limits.model_validate(limits)


@router.get("/v1/presets", tags=["facts"], operation_id="presets", summary="List the presets")
async def get_presets() -> Presets:
    """All presets, with the typical size, time and quality of each, and all values that each states."""
    return presets()


@router.get("/v1/problems", tags=["facts"], operation_id="problems", summary="List the problem types")
async def get_problems() -> list[ProblemKind]:
    """All codes that a problem document can have."""
    return [ProblemKind(code=code, **asdict(kind)) for code, kind in PROBLEM_TYPES.items()]


@router.get(
    "/v1/problems/{code}",
    tags=["facts"],
    operation_id="problem",
    summary="Get a problem type",
    responses=problems("not-found"),
)
async def get_problem(code: Annotated[str, Path(description="Code of a problem type.", max_length=64)]) -> ProblemKind:
    """Description of a problem type; the `type` of a problem document links to it."""
    if code not in PROBLEM_TYPES:
        raise ProblemError("not-found", f"there is no code {code!r}; GET /v1/problems lists all")
    return ProblemKind(code=code, **asdict(PROBLEM_TYPES[code]))


@router.head("/version", include_in_schema=False)
@router.get("/version", tags=["health"], operation_id="version", summary="Get the version")
async def get_version() -> Version:
    """Versions of the library and of this API, and the default container format."""
    return Version(kissgs=kissgs.__version__, api=API_VERSION, container="SOG-XT")


@router.head("/livez", include_in_schema=False)
@router.get("/livez", tags=["health"], operation_id="livez", summary="Check that the process is alive")
async def get_livez() -> Health:
    """Always succeeds; restart the service if there is no response."""
    return Health(ready=True, checks={"process": "ok"})


@router.head("/readyz", include_in_schema=False)
@router.get(
    "/readyz",
    tags=["health"],
    operation_id="readyz",
    summary="Check that jobs can be accepted",
    responses={503: {"model": Health, "description": "A check has failed."}},
)
async def get_readyz(context: Service, response: Response) -> Health:
    """Checks of the worker, the database and the disk, at most two seconds old; route requests elsewhere while one of
    them fails."""
    health = await _health(context)
    response.status_code = 200 if health.ready else 503
    response.headers.update(NO_STORE)
    return health


READY_SECONDS = 2.0  # of a check's result: each check writes to the disk, and anybody may ask for one


async def _health(context: ServiceContainer) -> Health:
    """Return the latest result of the checks, or that of new ones."""
    latest, clock = context.readiness, asyncio.get_running_loop().time
    async with latest.lock:
        if latest.found is None or clock() - latest.checked > READY_SECONDS:
            found = {
                "worker": context.worker.health_problem(),
                "database": await run_sync(_database_problem, context),
                "disk": await run_sync(_disk_problem, context),
            }
            checks = {part: text or "ok" for part, text in found.items()}
            if count := await run_sync(context.storage.count_orphaned):
                checks["orphaned"] = f"folders without a job in jobs/{ORPHANED} of the data folder: {count}"
            latest.found = Health(ready=not any(found.values()), checks=checks)
            latest.checked = clock()
        return latest.found


@router.get(
    "/metrics",
    tags=["health"],
    operation_id="metrics",
    summary="Get metrics for Prometheus",
    response_class=Response,
    responses={200: {"content": {CONTENT_TYPE: {"schema": {"type": "string"}}}, "description": "OpenMetrics."}},
)
async def get_metrics(context: Service) -> Response:
    """Metrics of the queue, jobs, stages, sizes and requests; none identifies a client."""
    counts, disk = await run_sync(lambda: (context.store.counts(), context.store.disk_bytes()))
    context.metrics.uploads.set(context.admission.uploads)
    return Response(context.metrics.text(counts, disk), media_type=CONTENT_TYPE)


def _database_problem(context: ServiceContainer) -> str | None:
    problem = context.store.monitor.health_problem()
    if problem is None:
        try:
            context.store.heartbeat()
        except SQLAlchemyError as error:
            problem = error_text(error)
    return None if problem is None else f"the job database cannot be used: {problem}"


def _disk_problem(context: ServiceContainer) -> str | None:
    needed = context.settings.min_free_bytes
    if problem := context.storage.health_problem():
        return problem
    try:
        free = context.storage.free_bytes()
    except OSError as error:
        return f"the data folder cannot be used: {(error.strerror or str(error)).lower()}"
    low = f"the disk has {free:,} free bytes, fewer than KISSGS_MIN_FREE_BYTES ({needed:,}); free some space"
    return None if free >= needed else low
