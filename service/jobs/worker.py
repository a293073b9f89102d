"""The embedded worker: takes jobs in the task they came, gives each a process, records what came of it."""

from __future__ import annotations

import asyncio
import errno
import logging
from dataclasses import dataclass, field

from anyio.to_thread import run_sync
from sqlalchemy.exc import SQLAlchemyError

from service.core.metrics import Metrics
from service.core.models import Job, State
from service.core.notifier import JobNotifier, ended, wait
from service.core.schemas import JobOptions
from service.core.settings import ServiceSettings
from service.jobs.completion import JobCompletion
from service.jobs.runner import JobProcess, Outcome
from service.storage.database_health import error_text
from service.storage.job_storage import JobStorage
from service.storage.job_store import Store

log = logging.getLogger("kissgs.service")

IDLE_SECONDS = 1.0
"""How often an idle worker looks at the queue though nobody rang."""

QUEUE = "queue"
"""What is rung when a job is added."""


@dataclass
class Worker:
    """Runs jobs, ``settings.workers`` at a time, until :meth:`drain`."""

    settings: ServiceSettings
    store: Store
    storage: JobStorage
    notifier: JobNotifier
    metrics: Metrics
    ending: JobCompletion
    draining: bool = False
    _processes: dict[str, JobProcess] = field(default_factory=dict)
    _loops: list[asyncio.Task[None]] = field(default_factory=list)
    _looked: dict[int, float] = field(default_factory=dict)
    _complaints: set[str] = field(default_factory=set)

    def start(self) -> None:
        """Begin to take jobs."""
        self._loops = [asyncio.create_task(self._loop(i)) for i in range(self.settings.workers)]

    def health_problem(self) -> str | None:
        """Why the worker cannot be relied on; None if it can."""
        if self.draining:
            return "the service is stopping"
        now = asyncio.get_running_loop().time()
        for number, loop in enumerate(self._loops):
            if loop.done():
                return f"worker {number} has ended"
            if now - self._looked.get(number, now) > 10 * IDLE_SECONDS and not self._processes:
                return f"worker {number} has not looked at the queue for {now - self._looked[number]:.0f} s"
        return None

    async def drain(self) -> None:
        """Take no more jobs; give those that run some time; put back in the queue those that need more."""
        self.draining = True
        self.notifier.notify(QUEUE)
        if self._processes:
            patience, count = self.settings.drain_seconds, len(self._processes)
            log.info("waiting up to %g s for %d running jobs; Ctrl-C again ends them now", patience, count)
        if self._loops:
            await asyncio.wait(self._loops, timeout=self.settings.drain_seconds)
        self.kill_running()
        await asyncio.gather(*self._loops, return_exceptions=True)

    def kill_running(self) -> None:
        """Wait no longer for running jobs."""
        for process in self._processes.values():
            process.kill()

    async def cancel(self, job: Job) -> None:
        """End a job that has not ended yet: its process is gone, and so are its files, when this returns."""
        if not await run_sync(lambda: self.ending.end(job, State.CANCELLED, upload_kept=False, disk_bytes=0)):
            return
        process = self._processes.get(job.id)
        if process is not None:
            process.kill()
            await process.ended.wait()
        await run_sync(self.storage.remove_job, job.id)
        self.notifier.notify(job.id)
        self.notifier.notify(ended(job.id))

    # Running -------------------------------------------------------------------------------------------------------

    async def _loop(self, number: int) -> None:
        while not self.draining:
            self._looked[number] = asyncio.get_running_loop().time()
            subscribe = self.notifier.subscribe(QUEUE)
            try:
                job = await run_sync(self._claim)
            except (SQLAlchemyError, OSError) as error:
                self._complain("no job is started", error)
                await asyncio.sleep(IDLE_SECONDS)
                continue
            if self._complaints:
                log.info("the job database and the data folder can be used again")
                self._complaints.clear()
            if job is None:
                await wait(subscribe, IDLE_SECONDS)
            else:
                await self._run(job)

    def _claim(self) -> Job | None:
        self.storage.require()  # or jobs would fail one after the other for want of their uploads
        return self.store.claim()

    async def _run(self, job: Job) -> None:
        process = self._processes[job.id] = JobProcess(seconds=self.settings.job_seconds)
        log.info("job %s starts: %d Gaussians, %s", job.id, job.gaussians, job.preset)
        self.metrics.busy.inc()
        if job.starts == 1 and job.started_at is not None:
            self.metrics.waited.observe(job.started_at - job.created_at)
        self.notifier.notify(job.id)
        try:
            outcome = await self._follow(job, process)
        except Exception as error:
            log.exception("job %s: its process could not be run", job.id)
            outcome = _unrunnable(error)
        finally:
            del self._processes[job.id]
            process.ended.set()
            self.metrics.busy.dec()
        health_problem = await run_sync(self.storage.health_problem)
        if health_problem and outcome.kind in ("error", "crashed"):
            outcome = Outcome("postponed")  # no fault of the job
        await self._settle(job, outcome)

    async def _follow(self, job: Job, process: JobProcess) -> Outcome:
        current = await run_sync(self.store.get, job.id)  # it may have been cancelled before the process was known
        if current is None or current.state != State.RUNNING:
            return Outcome("stopped")
        work = await run_sync(self.storage.new_work, job.id)
        resumable = JobOptions.model_validate(job.options).resumable
        task = {
            "kind": "compress",
            "source": str(self.storage.upload(job.id)),
            "work": str(work),
            "settings": {name: value for name, value in job.options.items() if name != "evaluate"},
            "evaluate": job.options["evaluate"],
            "checkpoint": str(self.storage.checkpoint(job.id)) if resumable else None,
            "threads": self.settings.job_threads,
            "memory": int(self.settings.job_memory),
        }

        async def progress(stage: str, fraction: float, note: str) -> None:
            try:
                await run_sync(self.store.progress, job.number, stage, fraction, note)
            except SQLAlchemyError as error:  # a full disk: the job itself may yet succeed
                self._complain(f"job {job.id}: progress was not recorded", error)
            self.notifier.notify(job.id)

        return await process.run(task, progress)

    # How jobs end -----------------------------------------------------------------------------------------------------

    async def _settle(self, job: Job, outcome: Outcome) -> None:
        """Record how a job ended: again and again, if need be, because a job must not be lost to a full disk."""
        while True:
            try:
                await run_sync(self._record, job, outcome)
                break
            except (SQLAlchemyError, OSError) as error:
                if outcome.kind == "done" and await run_sync(self._is_final, error):
                    log.error("job %s: its result cannot be kept: %s", job.id, error_text(error))
                    outcome = _unrunnable(error)
                    continue
                self._complain(f"job {job.id}: its end was not recorded; trying again", error)
                if self.draining:  # the next start takes it up
                    return
                await asyncio.sleep(IDLE_SECONDS)
            except Exception:  # ours: this job must end all the same, and the worker must go on
                log.exception("job %s: its end could not be recorded as it was", job.id)
                if outcome is _FAULT:  # the next start takes it up
                    return
                outcome = _FAULT
        self.notifier.notify(job.id)
        self.notifier.notify(ended(job.id))
        if outcome.kind == "postponed":
            await asyncio.sleep(IDLE_SECONDS)
        self.notifier.notify(QUEUE)

    def _is_final(self, error: Exception) -> bool:
        """Whether the same would fail for ever, while everything else can go on."""
        return isinstance(error, OSError) and error.errno in _FINAL and self.storage.health_problem() is None

    def _complain(self, what: str, error: Exception) -> None:
        """Log what fails again and again once, until the queue can be read."""
        reason = f"{what}: {error_text(error)}"
        if reason not in self._complaints:
            log.error("%s", reason)
            self._complaints.add(reason)

    def _record(self, job: Job, outcome: Outcome) -> None:
        self.store.require()  # or the files would say what nobody wrote down
        self.storage.require()
        current = self.store.get(job.id)
        if current is None or current.state != State.RUNNING:  # cancelled or deleted meanwhile
            self.storage.remove_work(job.id)
            return
        if outcome.kind == "done":
            self.storage.keep_result(job.id)
        self.storage.remove_work(job.id)  # now: once the job is back in the queue, another worker may be at it
        match outcome.kind:
            case "done":
                self.ending.succeed(job, outcome.data)
            case "error":
                self.ending.fail(job, outcome.data["code"], outcome.data["detail"])
            case "stopped" | "postponed":
                self._put_back(job)
            case "crashed" if self.draining:  # whoever stops the service may have signalled its children, too
                self._put_back(job)
            case "crashed" if job.crashes == 0 and job.starts < self.settings.job_starts:
                log.warning("job %s is started again", job.id)
                self.metrics.restarts.inc()
                self.store.move(job.number, State.QUEUED, crashes=1)
            case "crashed":
                self.ending.fail(job, "crashed", outcome.data["detail"])

    def _put_back(self, job: Job) -> None:
        """Into the queue, as if it had never been started."""
        self.store.move(job.number, State.QUEUED, starts=job.starts - 1)


_PASSING = (errno.EMFILE, errno.ENFILE, errno.EAGAIN, errno.ENOMEM, errno.ENOSPC, errno.EDQUOT)
"""What the system lacks for the moment; no fault of the job."""

_FINAL = (errno.ENOENT, errno.ENOTDIR, errno.EISDIR, errno.EEXIST, errno.ENOTEMPTY, errno.ELOOP)
"""What lies in a job's folder is not what it should be: no time mends that."""

_FAULT = Outcome("error", {"code": "internal", "detail": "the job could not be run; please report it with the scene"})


def _unrunnable(error: Exception) -> Outcome:
    if isinstance(error, OSError) and error.errno in _PASSING:
        return Outcome("postponed")
    if isinstance(error, OSError):
        reason = (error.strerror or str(error)).lower()
        return Outcome(
            "error", {"code": "output", "detail": f"the job's files cannot be written: {reason}; try again later"}
        )
    return _FAULT
