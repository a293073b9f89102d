"""Decoding of a job's container to a ``.ply``, on the first request, in a job process."""

from __future__ import annotations

import asyncio
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from anyio.to_thread import run_sync

from ..core.disk_estimates import BYTES_PER_GAUSSIAN
from ..core.formats import container_file
from ..core.models import Job, State
from ..core.problems import PROBLEM_TYPES, ProblemError
from ..core.settings import ServiceSettings
from ..storage.job_records import Store
from ..storage.job_storage import DECODED, JobStorage, StoredObject
from .admission import Admission
from .completion import result_folder
from .runner import DECODE, JobProcess, JobRunner


@dataclass(frozen=True)
class Decoder:
    """Decoder that handles one container at a time: decoding is quick, and memory is meant for jobs."""

    settings: ServiceSettings
    store: Store
    storage: JobStorage
    admission: Admission
    runner: JobRunner
    _lock: asyncio.Lock = field(default_factory=asyncio.Lock)
    _processes: dict[str, JobProcess] = field(default_factory=dict)

    async def scene(self, job: Job) -> tuple[StoredObject, dict[str, Any]]:
        """Return the decoded ``.ply`` of a succeeded job, and its size and SHA-256 by name.

        Raises:
            ProblemError: the disk is full, the decoding failed, or the job was deleted or has expired meanwhile.
        """
        try:
            described = await run_sync(self.storage.read_decoded, job.id)
            if described is None:
                async with self._lock:
                    described = await run_sync(self.storage.read_decoded, job.id)
                    if described is None:
                        await self._decode(job)
                        described = await run_sync(self.storage.read_decoded, job.id)
            if described is not None:
                return await run_sync(self.storage.open, job.id, DECODED), described
        except OSError as error:
            raise _gone() from error
        raise _gone()

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
                if self.storage.shared:
                    await run_sync(self.storage.remove_work, job.id)
            await run_sync(self.admission.release, size, 0)

    def _keep(self, work: Path, job: Job) -> None:
        self.store.take_claim(job.id)
        self.storage.keep_decoded(work, job.id)
        current = self.store.get(job.id)
        if current is None or current.state != State.SUCCEEDED:  # another replica has removed the files before
            self.storage.remove_job(job.id)
            self.store.drop_claim(job.id)
            raise _gone()
        reclaimable = self.storage.reclaimable_bytes(job.id)
        self.store.update(job.number, disk_bytes=self.storage.job_bytes(job.id), reclaimable_bytes=reclaimable)
        self.store.drop_claim(job.id)

    def stop(self, job_id: str) -> None:
        """Kill the decoding of a job, if it is running."""
        process = self._processes.get(job_id)
        if process is not None:
            process.kill()

    async def _run(self, job: Job, work: Path) -> None:
        async def ignore(stage: str, fraction: float, note: str) -> None:
            pass

        name = f"{result_folder(job)}/{container_file(job.options).name}"
        source = await run_sync(self.storage.fetch, job.id, name, work)
        task = {
            "function": DECODE,
            "source": str(source),
            "work": str(work),
        }
        process = self._processes[job.id] = self.runner.process()
        try:
            outcome = await process.run(task, ignore)
        finally:
            del self._processes[job.id]
        if outcome.kind == "stopped":
            raise _gone()
        if outcome.kind != "done":
            code = outcome.data.get("code", "crashed")
            raise ProblemError(
                code if code in PROBLEM_TYPES else "internal", outcome.data.get("detail", "it was ended")
            )


def _gone() -> ProblemError:
    return ProblemError("gone", "the job was deleted or has expired meanwhile; submit the scene again")
