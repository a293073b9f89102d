"""How jobs end: their files, their row, what is counted and logged of it."""

from __future__ import annotations

import logging
from dataclasses import dataclass
from typing import Any

from service.clock import Clock
from service.files import Folders
from service.metrics import Metrics
from service.models import Job, State
from service.problems import KINDS, problem
from service.settings import ServiceSettings
from service.store import Store

log = logging.getLogger("kissgs.service")


@dataclass(frozen=True, slots=True)
class Ending:
    """Brings jobs to an end. Its methods block on the disk and the database."""

    settings: ServiceSettings
    store: Store
    folders: Folders
    metrics: Metrics
    clock: Clock

    def succeed(self, job: Job, summary: dict[str, Any]) -> None:
        """The job's result is in its place."""
        upload = self.folders.upload(job.id)
        self.folders.discard_checkpoints(job.id)
        if not self.settings.keep_uploads:
            self.folders.discard(upload)
        kept = self.settings.keep_uploads and upload.is_file()
        values = {
            "result": summary,
            "upload_kept": kept,
            "spare_bytes": job.upload_bytes if kept else 0,
            "disk_bytes": self.folders.job_bytes(job.id),
        }
        if not self.end(job, State.SUCCEEDED, **values):
            self.folders.discard(self.folders.result(job.id))

    def fail(self, job: Job, code: str, detail: str) -> None:
        """The job has no result, and its files are of no more use."""
        if self._failed(job, code, detail):
            self.folders.remove_job(job.id)

    def lose(self, job: Job) -> None:
        """The job's upload has vanished. What there is of its files stays."""
        if self._failed(job, "internal", "the upload is no longer on the server's disk; submit the scene again"):
            self.folders.keep_aside(job.id, "has lost its upload")

    def end(self, job: Job, state: State, **values: Any) -> bool:  # noqa: ANN401
        """Set a job's last state, and ``values`` with it; False if it has ended before."""
        moved = self.store.move(job.number, state, expires_at=self.clock() + self.settings.keep_seconds, **values)
        current = self.store.get(job.id)
        if moved and current is not None:
            seconds = None if job.started_at is None else self.clock() - job.started_at
            self.metrics.job_ended(current, state, seconds)
            when = "before it was started" if seconds is None else f"after {seconds:.1f} s"
            log.info("job %s %s %s", job.id, state, when)
        return moved

    def _failed(self, job: Job, code: str, detail: str) -> bool:
        document = problem(code if code in KINDS else "internal", detail).model_dump(exclude_none=True)
        return self.end(job, State.FAILED, problem=document, upload_kept=False, disk_bytes=0)
