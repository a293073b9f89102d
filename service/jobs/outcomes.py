"""``OutcomeRecorder``: what the outcome of a job's process means for the job: its end, or another start."""

from __future__ import annotations

import errno
import logging
from dataclasses import dataclass

from ..core.metrics import Metrics
from ..core.models import ACTIVE, Job, State
from ..core.settings import ServiceSettings
from ..storage.job_records import Store
from ..storage.job_storage import JobStorage
from ..storage.object_store import ObjectStoreError
from .completion import JobCompletion, has_result
from .runner import Outcome
from .workplace import Workplace

log = logging.getLogger("kissgs.service")

_TRANSIENT_ERRNOS = (errno.EMFILE, errno.ENFILE, errno.EAGAIN, errno.ENOMEM, errno.ENOSPC, errno.EDQUOT)
"""Errors from a temporary lack of resources, not caused by the job."""

_PERMANENT_ERRNOS = (errno.ENOENT, errno.ENOTDIR, errno.EISDIR, errno.EEXIST, errno.ENOTEMPTY, errno.ELOOP)
"""Errors from unexpected content of a job's folder, which do not go away."""

INTERNAL_ERROR = Outcome(
    "error",
    {
        "code": "internal",
        "detail": "the job could not be run because of an error in the service; please report it with the scene",
    },
)
"""Outcome of a bug."""


@dataclass(frozen=True, slots=True)
class OutcomeRecorder:
    """Recorder of outcomes; methods block on the disk and the database."""

    settings: ServiceSettings
    store: Store
    storage: JobStorage
    metrics: Metrics
    completion: JobCompletion

    def record(self, job: Job, outcome: Outcome, place: Workplace, stopping: bool) -> None:
        """Record how a start of a job ended, and whether it is started again; the call can be repeated if it fails.

        Args:
            job: the job, as it was started.
            outcome: of its process.
            place: files of this start.
            stopping: whether the service is stopping.

        Raises:
            OSError: the files cannot be stored or removed.
            SQLAlchemyError: the database fails.
        """
        self.store.check()  # else files would change without a record in the database
        self.storage.check()
        current = self.store.get(job.id)
        if current is None or current.state not in ACTIVE:  # cancelled or deleted meanwhile, or recorded already
            kept = has_result(current, place.folder)
            place.clear(kept=kept)
            if current is not None and kept:
                self.completion.settle(current, place.folder, keep_upload=current.upload_kept)
            elif current is not None and current.state == State.FAILED:
                self.storage.remove_job(job.id)
            self.store.drop_claim(job.id)
            return
        if current.state == State.QUEUED or current.started_at != job.started_at:  # recorded already: started again
            place.abandon()
            return
        if outcome.kind not in ("done", "error") and (summary := place.finished()) is not None:
            outcome = Outcome("done", summary)
        if outcome.kind == "done":
            place.keep()
        elif outcome.kind != "error":  # it may continue elsewhere
            place.store_checkpoints()
        place.clear(kept=outcome.kind == "done")  # before requeueing, because another worker may then run the job
        match outcome.kind:
            case "done":
                self.completion.succeed(job, outcome.data, place.folder)
            case "stopped" | "postponed":
                self._requeue(job)
            case "crashed" if stopping:  # a supervisor may also have sent the signal to job processes
                self._requeue(job)
            case "crashed" if job.crashes == 0 and job.starts < self.settings.job_starts:
                log.warning("job %s is started again", job.id)
                self.metrics.restarts.inc()
                self.store.move(job.number, State.QUEUED, crashes=1)
            case "lost" if stopping or job.starts < self.settings.job_starts:
                log.warning("job %s is started again elsewhere", job.id)
                self.metrics.restarts.inc()
                self.store.move(job.number, State.QUEUED)
            case "error" | "crashed" | "lost":
                self.completion.fail(job, outcome.data["code"], outcome.data["detail"])
        current = self.store.get(job.id)
        if current is None or current.state not in ACTIVE:  # cancelled at the same moment, so the claim is still held
            self.store.drop_claim(job.id)

    def _requeue(self, job: Job) -> None:
        """Return a job to the queue without counting its start."""
        self.store.move(job.number, State.QUEUED, starts=job.starts - 1)

    def is_permanent(self, error: Exception) -> bool:
        """Return whether a retry would always fail, because of this job's folder alone."""
        return isinstance(error, OSError) and error.errno in _PERMANENT_ERRNOS and self.storage.health_problem() is None


def outcome_of(error: Exception) -> Outcome:
    """Return the outcome of a job whose process could not be run, or whose result could not be kept."""
    if isinstance(error, ObjectStoreError) or (isinstance(error, OSError) and error.errno in _TRANSIENT_ERRNOS):
        return Outcome("postponed")
    if isinstance(error, OSError):
        reason = (error.strerror or str(error)).lower()
        return Outcome(
            "error", {"code": "output", "detail": f"the job's files cannot be written: {reason}; try again later"}
        )
    return INTERNAL_ERROR
