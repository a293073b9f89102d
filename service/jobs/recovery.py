"""Recovery after a start: continue waiting and interrupted jobs, and complete interrupted removals.

The database may be an older copy than the data folder, so files of jobs that it does not know are never removed.
"""

from __future__ import annotations

import logging

from ..core.files import container_file
from ..core.models import Job, State
from .container import ServiceContainer

log = logging.getLogger("kissgs.service")


def recover(context: ServiceContainer) -> None:
    """Recover all jobs; call it before jobs are accepted or started."""
    store, storage = context.store, context.storage
    for job in store.in_state(State.QUEUED, State.RUNNING):
        _recover_job(context, job)
    known, failed = store.ids(), store.ids(State.FAILED)
    for job_id in sorted(storage.job_ids() & (known - store.ids(State.QUEUED, State.RUNNING, State.SUCCEEDED))):
        if job_id in failed and storage.result(job_id).exists():
            storage.set_aside(job_id, "holds a result, although the job failed according to the database,")
        else:
            storage.remove_job(job_id)
    storage.set_aside_unknown(store.ids())


def _recover_job(context: ServiceContainer, job: Job) -> None:
    store, storage, completion = context.store, context.storage, context.worker.completion
    summary = storage.read_result(job.id, container_file(job.options).name)
    if summary is None and storage.result(job.id).exists():
        log.warning("job %s: its result is damaged", job.id)
    if summary is not None:
        if job.state == State.QUEUED:
            log.warning("job %s: its result exists, although it is queued in the database", job.id)
            store.move(job.number, State.RUNNING)
        completion.succeed(job, summary)
    elif storage.upload_name(job.id) is None:
        completion.lose(job)
    elif job.state == State.RUNNING and job.starts >= context.settings.job_starts:
        detail = f"the service was ended {job.starts} times while the job ran; submit a scene with fewer Gaussians"
        completion.fail(job, "crashed", detail)
    elif job.state == State.RUNNING:
        store.move(job.number, State.QUEUED)
