"""The decoded scene of a job: made when first asked for, in a process of its own, once."""

from __future__ import annotations

import asyncio
import json
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from anyio.to_thread import run_sync

from service.core.disk_estimates import BYTES_PER_GAUSSIAN
from service.core.models import Job, State
from service.core.problems import PROBLEM_TYPES, ProblemError
from service.core.settings import ServiceSettings
from service.jobs.admission import Admission
from service.jobs.runner import JobProcess
from service.storage.job_storage import JobStorage
from service.storage.job_store import Store


@dataclass(frozen=True)
class Decoder:
    """Decodes one container at a time: it is quick, and memory is set aside for jobs."""

    settings: ServiceSettings
    store: Store
    storage: JobStorage
    admission: Admission
    _turn: asyncio.Lock = field(default_factory=asyncio.Lock)
    _processes: dict[str, JobProcess] = field(default_factory=dict)

    async def scene(self, job: Job) -> tuple[Path, dict[str, Any]]:
        """The decoded ``.ply`` of a job that has succeeded, and its size and SHA-256.

        Raises:
            ProblemError: there is no room for it, its process failed, or the job went away meanwhile.
        """
        path, note = self.storage.decoded(job.id), self.storage.decoded(job.id).with_suffix(".json")
        if not path.exists():
            async with self._turn:
                if not path.exists():
                    await self._make(job)
        try:
            return path, json.loads(await run_sync(note.read_text))
        except OSError as error:
            raise _gone() from error

    async def _make(self, job: Job) -> None:
        size = 2000 + BYTES_PER_GAUSSIAN[job.sh_degree] * job.gaussians
        await run_sync(self.admission.reserve, size)
        work = None
        try:
            work = await run_sync(self.storage.new_work, job.id)
            await self._run(job, work)
            await run_sync(self.storage.keep_decoded, work, job.id)
            await run_sync(self._account, job)
        except (ProblemError, OSError) as error:
            current = await run_sync(self.store.get, job.id)
            if current is None or current.state != State.SUCCEEDED:
                raise _gone() from error
            raise
        finally:
            if work is not None:
                await run_sync(self.storage.discard, work)
            await run_sync(self.admission.release, size, 0)

    def _account(self, job: Job) -> None:
        spare = sum(path.stat().st_size for path in self.storage.reclaimable_files(job.id))
        self.store.update(job.number, disk_bytes=self.storage.job_bytes(job.id), reclaimable_bytes=spare)

    def stop(self, job_id: str) -> None:
        """End the decoding of a job, if it is going on."""
        process = self._processes.get(job_id)
        if process is not None:
            process.kill()

    async def _run(self, job: Job, work: Path) -> None:
        async def ignore(stage: str, fraction: float, note: str) -> None:
            pass

        task = {
            "kind": "decode",
            "source": str(self.storage.result(job.id) / "scene.zip"),
            "work": str(work),
            "threads": self.settings.job_threads,
            "memory": int(self.settings.job_memory),
        }
        process = self._processes[job.id] = JobProcess(seconds=self.settings.job_seconds)
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
