"""Decoding of a job's container to a ``.ply``, on the first request, in a job process."""

from __future__ import annotations

import asyncio
from dataclasses import dataclass, field
from pathlib import Path

from anyio.to_thread import run_sync

from ..core.files import BYTES_PER_GAUSSIAN, container_file
from ..core.models import Job, State
from ..core.problems import PROBLEM_TYPES, ProblemError
from ..core.settings import ServiceSettings
from ..storage.job_files import RESULT, JobStorage
from ..storage.job_records import Store
from .admission import Admission
from .process import DECODE, JobProcess, JobRunners


@dataclass(frozen=True)
class Decoder:
    """Decoder that handles one container at a time: decoding is quick, and memory is meant for jobs."""

    settings: ServiceSettings
    store: Store
    storage: JobStorage
    admission: Admission
    runners: JobRunners
    _lock: asyncio.Lock = field(default_factory=asyncio.Lock)
    _processes: dict[str, JobProcess] = field(default_factory=dict)

    async def scene(self, job: Job) -> Path:
        """Return the path of the decoded ``.ply`` of a succeeded job, whose name ends in its SHA-256."""
        try:
            found = await run_sync(self.storage.decoded, job.id)
            if found is None:
                async with self._lock:
                    if await run_sync(self.storage.decoded, job.id) is None:
                        await self._decode(job)
                    found = await run_sync(self.storage.decoded, job.id)
        except OSError as error:
            raise _gone() from error
        if found is None:
            raise _gone()
        return found

    async def _decode(self, job: Job) -> None:
        size = 2000 + BYTES_PER_GAUSSIAN[job.sh_degree] * job.gaussians
        await run_sync(self.admission.reserve, size)
        work = None
        try:
            work = await run_sync(self.storage.new_work, job.id)
            await self._run(job, work)
            await run_sync(self._keep, work, job)
        except (ProblemError, OSError) as error:
            current = await run_sync(self.store.get, job.id)
            if current is None or current.state != State.SUCCEEDED:
                raise _gone() from error
            raise
        finally:
            if work is not None:
                await run_sync(self.storage.discard, work)
            await run_sync(self.admission.release, size, 0)

    def _keep(self, work: Path, job: Job) -> None:
        self.storage.keep_decoded(work, job.id)
        reclaimable = self.storage.reclaimable_bytes(job.id)
        self.store.update(job.number, disk_bytes=self.storage.job_bytes(job.id), reclaimable_bytes=reclaimable)

    def stop(self, job_id: str) -> None:
        """Kill the decoding of a job, if it is running."""
        process = self._processes.get(job_id)
        if process is not None:
            process.kill()

    async def _run(self, job: Job, work: Path) -> None:
        source = f"{RESULT}/{container_file(job.options).name}"
        task = {"function": DECODE, "folder": str(work.parent), "files": [source], "source": source, "work": work.name}
        process = self._processes[job.id] = JobProcess(self.runners)
        try:
            outcome = await process.run(task)
        finally:
            del self._processes[job.id]
        if outcome.kind == "cancelled":
            raise _gone()
        if outcome.kind != "done":
            code = outcome.code if outcome.code in PROBLEM_TYPES else "internal"
            raise ProblemError(code, outcome.message or "it was ended")


def _gone() -> ProblemError:
    return ProblemError("gone", "the job was deleted or has expired meanwhile; submit the scene again")
