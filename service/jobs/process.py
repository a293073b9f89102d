"""``JobProcess``: one start of a job, or a decoding, as a work item of a runner on this machine or on a Ray cluster;
and ``Decoder``, which decodes the container of a job to a ``.ply`` on the first request."""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Awaitable, Callable
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any

from anyio.to_thread import run_sync

import kissgs
from kissgs import runners
from kissgs.runners import Outcome, Resources, Runner, WorkItem
from kissgs.runners.process import LocalRunner
from kissgs.runners.ray_runner import RayRunner

from ..core.files import BYTES_PER_GAUSSIAN, container_file
from ..core.models import Job, State
from ..core.problems import ProblemError
from ..core.settings import ServiceSettings
from ..storage.job_files import RESULT, JobStorage
from ..storage.job_records import Store
from .admission import Admission
from .job_process import without_paths

log = logging.getLogger("kissgs.service")

COMPRESS, DECODE, UNPACK = "job_process:compress", "job_process:decode", "archive:unpack"
"""Functions of this package that tasks name."""

UNUSABLE_NODES = "the machines that run jobs cannot work on this one; try again later"
UNUSABLE_MACHINE = "the job's files cannot be used on this machine; try again later"
"""Sentences for clients about nodes of a cluster, and about this machine, whose names and faults are in the log."""

OnProgress = Callable[[str, float, str, float | None], Awaitable[None]]
"""Gets stage, fraction of the job (0 to 1), a note or "", and the seconds left, None while they are unknown."""


POSTPONED = (runners.UNREACHABLE, runners.NOT_STARTED)  # codes of "lost" outcomes of jobs that cannot run at the moment


def postponed(reason: str = "") -> Outcome:
    """Return the outcome of a job that cannot run at the moment."""
    return Outcome("lost", code=runners.NOT_STARTED, message=reason)


class JobRunners:
    """The runners of all jobs, and what each of them requests. ``local`` decodes and unpacks, which is quick and for
    which a request waits: no job of a cluster delays it."""

    def __init__(self, settings: ServiceSettings) -> None:
        """Open the runner that the settings name."""
        self.settings = settings
        self.local: Runner = LocalRunner()
        address = settings.ray_address
        self.runner = self.local if address is None else RayRunner(address)

    def health_problem(self) -> str | None:
        """Return why no job can run at the moment; None if jobs can."""
        return self.runner.health_problem() or self.runner.refusal(self.request())

    def close(self) -> None:
        """End all jobs and release everything."""
        self.runner.close()
        self.local.close()

    def runner_of(self, task: dict[str, Any]) -> Runner:
        """Return the runner of a task."""
        return self.runner if task["function"] == COMPRESS else self.local

    def request(self, *, trains: bool = False) -> Resources:
        """Return what a job requests: on a cluster, by default all processors of its smallest node."""
        settings = self.settings
        cpus = settings.job_threads or 1
        if settings.ray_address is not None and not settings.job_threads:
            cpus = max(1, int(min((node.cpus for node in self.runner.nodes), default=0)))
        return Resources(cpus, int(settings.job_memory), settings.job_gpus if trains else 0)

    def item(self, task: dict[str, Any]) -> WorkItem:
        """Return the work item of a task; see :mod:`service.jobs.job_process`. It is not started again when its node is
        lost: the database counts the starts of jobs."""
        wanted = kissgs.Settings.model_validate(task.get("settings", {}))
        requested = self.request(trains=wanted.compact.enabled or bool(wanted.finetune.enabled))
        threads = self.settings.job_threads if self.runner_of(task) is self.local else int(requested.cpus)
        return WorkItem(
            f"{__package__}.{task['function']}",
            {**task, "threads": threads, "device": "cuda" if requested.gpus else "cpu"},
            requested,
            seconds=self.settings.capture_seconds if task["function"] == UNPACK else self.settings.job_seconds,
            memory_limit=int(self.settings.job_memory),
            folder=task["folder"],
            files=tuple(task["files"]),
            retries=0,
        )


class JobProcess:
    """One job process; call :meth:`run` once. Its result goes to ``work``."""

    def __init__(self, job_runners: JobRunners) -> None:
        self._runner = job_runners
        self._end: Callable[[], None] = lambda: None  # ends the process, once there is one
        self._used = job_runners.local
        self.killed = False
        self.work: Path | None = None
        self.ended = asyncio.Event()  # set by the worker

    def kill(self) -> None:
        """Kill the process now, or as soon as it has started."""
        self.killed = True
        self._end()

    async def run(self, task: dict[str, Any], on_progress: OnProgress | None = None) -> Outcome:
        """Run a task (see :mod:`service.jobs.job_process`); if the caller is cancelled, the process is killed."""
        if self.killed:
            return Outcome("cancelled")
        item, self._used = self._runner.item(task), self._runner.runner_of(task)
        if item.resources.gpus and self._used.refusal(item.resources):
            return self._refused(item.resources)
        loop, events = asyncio.get_running_loop(), asyncio.Queue[tuple[str, float, str, float | None] | None]()

        def receive(stage: str, fraction: float, note: str = "", seconds_left: float | None = None) -> None:
            loop.call_soon_threadsafe(events.put_nowait, (stage, fraction, note, seconds_left))

        running = self._used.submit(item, receive)
        self._end = partial(self._used.cancel, running)
        outcome = asyncio.wrap_future(running)
        outcome.add_done_callback(lambda _: events.put_nowait(None))
        try:
            while (event := await events.get()) is not None:
                if on_progress is not None:
                    await on_progress(*event)
        finally:
            self._end()
            await asyncio.wait([outcome])
        return self._outcome(outcome.result(), task)

    def _refused(self, resources: Resources) -> Outcome:
        """Return the outcome of training that no node can run: an error only if the cluster answers and has nodes."""
        if problem := self._runner.health_problem():
            return postponed(problem)
        refusal = self._used.refusal(resources)  # once more, because the cluster may have been connected again only now
        if refusal is None or self._runner.health_problem():
            return postponed()
        message = f"training is not possible at the moment: {refusal}; try again later"
        return Outcome("error", code="unsupported", message=message)

    def _outcome(self, outcome: Outcome, task: dict[str, Any]) -> Outcome:
        """Return the outcome in the words of the service, without paths of its files."""
        if outcome.log:
            log.error("a job's process failed: %s\n%s", outcome.message, outcome.log)
        if outcome.kind in ("done", "cancelled") or outcome.code in POSTPONED:
            return outcome
        if outcome.code == runners.NODE_UNUSABLE:  # another node of a cluster may be able to work
            log.warning("a job could not run on %s: %s", outcome.node or "its machine", outcome.message)
            if self._used is self._runner.local:
                return Outcome("error", code="output", message=UNUSABLE_MACHINE)
            return Outcome("lost", code="internal", message=UNUSABLE_NODES)
        if outcome.kind == "lost":
            log.warning("a job was lost: %s", outcome.message)
            message = "the machine that ran the job was lost; submit the scene again"
            return replace(outcome, code="crashed", message=message)
        if outcome.kind == "crashed":
            return replace(outcome, code="crashed", message=f"{outcome.message}; submit the scene again")
        seconds = f"{self._runner.settings.job_seconds:g} s"
        messages = {
            runners.TIME_LIMIT: f"the job took longer than {seconds}; choose a faster preset or fewer Gaussians",
            runners.MEMORY_LIMIT: "the job exceeded its memory limit; submit a scene with fewer Gaussians",
            runners.INTERNAL: "the job failed because of an error in kissgs; please report it with the scene",
        }
        return replace(outcome, message=messages.get(outcome.code) or without_paths(outcome.message, task))


@dataclass(frozen=True)
class Decoder:
    """Decoder that handles one container at a time: decoding is quick, and memory is meant for jobs."""

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
            raise ProblemError(outcome.code, outcome.message or "it was ended")


def _gone() -> ProblemError:
    return ProblemError("gone", "the job was deleted or has expired meanwhile; submit the scene again")
