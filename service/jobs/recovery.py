"""Taking up what a former service left: jobs that were waiting or running, and removals that were cut off.

The database may be an older copy than the data folder. What lies on the disk is never removed because of what the
database does not know yet.
"""

from __future__ import annotations

import json
import logging
from pathlib import Path
from typing import Any

from service.core.models import Job, State
from service.jobs.container import ServiceContainer
from service.storage.job_storage import JobStorage

log = logging.getLogger("kissgs.service")


def recover(context: ServiceContainer) -> None:
    """To be called before anything is accepted or started."""
    store, storage = context.store, context.storage
    for job in store.in_state(State.QUEUED, State.RUNNING):
        _take_up(context, job)
    known, failed = store.ids(), store.ids(State.FAILED)
    for job_id in sorted(storage.held() & (known - store.ids(State.QUEUED, State.RUNNING, State.SUCCEEDED))):
        _finish_removal(storage, job_id, failed=job_id in failed)
    if count := storage.set_aside_unknown(known):
        place = storage.orphaned
        log.warning("folders of jobs that the database does not know were set aside in %s: %d", place, count)


def _take_up(context: ServiceContainer, job: Job) -> None:
    store, storage, ending = context.store, context.storage, context.worker.ending
    result = storage.result(job.id)
    summary = read_summary(result)
    if summary is None and result.exists():
        log.warning("job %s: its result is damaged", job.id)
    if summary is not None:
        if job.state == State.QUEUED:
            log.warning("job %s: its result is there, although the database says that it waits", job.id)
            store.move(job.number, State.RUNNING)
        ending.succeed(job, summary)
    elif not storage.upload(job.id).is_file():
        ending.lose(job)
    elif job.state == State.RUNNING and job.starts >= context.settings.job_starts:
        detail = f"the service was ended {job.starts} times while the job ran; submit a scene with fewer Gaussians"
        ending.fail(job, "crashed", detail)
    elif job.state == State.RUNNING:
        store.move(job.number, State.QUEUED)


def _finish_removal(storage: JobStorage, job_id: str, *, failed: bool) -> None:
    """Remove what an ended job has left; but for a result of one that is said to have failed."""
    if failed and storage.result(job_id).exists():
        storage.keep_aside(job_id, "holds a result, although the database says that it failed,")
    else:
        storage.remove_job(job_id)


def read_summary(result: Path) -> dict[str, Any] | None:
    """What a whole result says of itself; None if there is none, or if it is damaged."""
    try:
        summary: dict[str, Any] = json.loads((result / "summary.json").read_text(encoding="utf-8"))
        files = {name: entry["bytes"] for name, entry in summary["files"].items()}
        sizes = {result / "files" / name: size for name, size in files.items()}
        sizes |= {
            result / "scene.zip": summary["container"]["bytes"],
            result / "report.json": summary["report"]["bytes"],
        }
        whole = all(path.stat().st_size == size for path, size in sizes.items())
        return summary if whole and {"count", "seconds", "cpu_seconds"} <= summary.keys() else None
    except (OSError, ValueError, LookupError, TypeError, AttributeError, RecursionError):
        return None
