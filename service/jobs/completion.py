"""``JobCompletion``: the end of jobs in files, database, metrics and log."""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, TypeVar

from sqlalchemy.exc import SQLAlchemyError

from ..core.clock import Clock
from ..core.metrics import Metrics
from ..core.models import Job, State
from ..core.problems import PROBLEM_TYPES, problem
from ..core.settings import ServiceSettings
from ..storage.database_health import is_full
from ..storage.job_records import Store
from ..storage.job_storage import RESULT, JobStorage

T = TypeVar("T")

log = logging.getLogger("kissgs.service")


LOST = "the upload is no longer on the server's disk; submit the scene again"


@dataclass(frozen=True, slots=True)
class JobCompletion:
    """Recorder of the end of jobs; methods block on the disk and the database."""

    settings: ServiceSettings
    store: Store
    storage: JobStorage
    metrics: Metrics
    clock: Clock

    def succeed(self, job: Job, summary: dict[str, Any], folder: str, *, dead: str | None = None) -> None:
        """Record success of a job whose result is complete, in a folder of its files; for ``dead``, see ``move``."""
        keep, shared = self.settings.keep_uploads, self.storage.shared
        if shared:  # another replica may have taken the job over, so nothing is removed before the end is recorded
            kept = keep and self.storage.upload_name(job.id) is not None
        else:
            kept = self.storage.settle(job.id, folder, keep_upload=keep)
        values = {
            "result": summary if folder == RESULT else {**summary, "folder": folder},
            "upload_kept": kept,
            "reclaimable_bytes": job.upload_bytes if kept else 0,
            "disk_bytes": self.storage.job_bytes(job.id),
        }
        if self.end(job, State.SUCCEEDED, dead=dead, **values):
            self.settle(job, folder, keep_upload=kept)
            self.store.drop_claim(job.id)
        elif not has_result(self.store.get(job.id), folder):  # else another replica has recorded this very result
            self.storage.remove_result(job.id, folder)

    def settle(self, job: Job, folder: str, *, keep_upload: bool) -> None:
        """Remove what a succeeded job does not need beside its result; the call can be repeated."""
        if self.storage.shared:
            self.storage.settle(job.id, folder, keep_upload=keep_upload)
            self.store.update(job.number, disk_bytes=self.storage.job_bytes(job.id))

    def fail(self, job: Job, code: str, detail: str, *, dead: str | None = None) -> None:
        """Record failure of a job and remove its files; for ``dead``, see ``move``."""
        if self._failed(job, code, detail, dead):
            self.storage.remove_job(job.id)

    def lose(self, job: Job) -> None:
        """Record failure of a job whose upload is missing; other files move to the orphaned folder."""
        if self._failed(job, "internal", LOST):
            self.storage.set_aside(job.id, "has lost its upload")

    def end(self, job: Job, state: State, **values: Any) -> bool:  # noqa: ANN401
        """Set a job's final state and the columns ``values``; return False if it has already ended."""
        moved = self.store.move(job.number, state, expires_at=self.clock() + self.settings.keep_seconds, **values)
        current = self.store.get(job.id)
        if moved and current is not None:
            seconds = None if job.started_at is None else self.clock() - job.started_at
            self.metrics.job_ended(current, state, seconds)
            when = "before it was started" if seconds is None else f"after {seconds:.1f} s"
            log.info("job %s %s %s", job.id, state, when)
        return moved

    def cancel(self, job: Job) -> bool:
        """Record that a job was cancelled, also on a full disk; return False if it has already ended."""
        return self._despite_full_disk(lambda: self.end(job, State.CANCELLED, upload_kept=False, disk_bytes=0))

    def expire(self, number: int, job_id: str, **values: Any) -> bool:  # noqa: ANN401
        """Record that an ended job has expired, with the columns ``values``, and remove its files.

        On a full disk the files go first, because the record needs space. Returns whether the files are removed.
        """
        gone: dict[str, Any] = {"upload_kept": False, "disk_bytes": 0, "reclaimable_bytes": 0, **values}
        try:
            self.store.move(number, State.EXPIRED, **gone)
        except SQLAlchemyError as error:
            if not is_full(error):
                raise
            self.storage.remove_job(job_id)
            self._despite_full_disk(lambda: self.store.move(number, State.EXPIRED, **gone))
        return self.storage.remove_job(job_id)

    def forget(self, number: int) -> None:
        """Remove the record of a job, also on a full disk."""
        self._despite_full_disk(lambda: self.store.forget(number))
        self.storage.keep_reserve()

    def _despite_full_disk(self, change: Callable[[], T]) -> T:
        """Make a change of the database, if necessary with the reserve of disk space."""
        try:
            return change()
        except SQLAlchemyError as error:
            if not (is_full(error) and self.storage.free_reserve()):
                raise
        return change()

    def _failed(self, job: Job, code: str, detail: str, dead: str | None = None) -> bool:
        document = problem(code if code in PROBLEM_TYPES else "internal", detail).model_dump(exclude_none=True)
        return self.end(job, State.FAILED, dead=dead, problem=document, upload_kept=False, disk_bytes=0)


def result_folder(job: Job) -> str:
    """Return the name of the folder of a succeeded job's result."""
    return str((job.result or {}).get("folder", RESULT))


def has_result(job: Job | None, folder: str) -> bool:
    """Return whether a job has succeeded with the result in this folder."""
    return job is not None and job.state == State.SUCCEEDED and result_folder(job) == folder
