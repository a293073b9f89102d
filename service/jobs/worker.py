"""Worker: runs queued jobs in order of submission, each in a job process, and sees that their ends are recorded."""

from __future__ import annotations

import asyncio
import logging
from dataclasses import dataclass, field

from anyio.to_thread import run_sync
from sqlalchemy.exc import SQLAlchemyError

from ..core.metrics import Metrics
from ..core.models import Job, State
from ..core.notifier import JobNotifier, ended, wait
from ..core.settings import ServiceSettings
from ..storage.database_health import error_text
from ..storage.job_records import Store
from ..storage.job_storage import JobStorage
from .completion import LOST, JobCompletion
from .outcomes import INTERNAL_ERROR, OutcomeRecorder, outcome_of
from .runner import JobProcess, JobRunner, Outcome
from .workplace import Workplace, workplace

log = logging.getLogger("kissgs.service")

IDLE_SECONDS = 1.0
"""Seconds after which an idle worker reads the queue even without a notification."""

CANCEL_SECONDS, CANCEL_POLL_SECONDS = 10.0, 0.2
"""Maximum wait for another replica to end a cancelled job, and the interval between looks, seconds."""

LOST_SECONDS, MOST_LOST_SECONDS = 5.0, 60.0
"""Pause before a job is started again whose first start was lost, which doubles with every start; the longest one. On a
bad node that is free, starts fail at once: without pauses, the job would soon have none left."""

MOST_POSTPONED_SECONDS = 8.0
"""Longest pause of a worker after jobs that could not be started; the first is IDLE_SECONDS."""

REST_POLL_SECONDS = 0.1
"""Interval between looks whether a pause must end, seconds."""

CHECKPOINT_SECONDS = 30.0
"""Minimum seconds between two looks for new checkpoints that other replicas may need."""

QUEUE = "queue"
"""Name that is notified when a job is added to the queue."""


@dataclass
class Worker:
    """Runner of up to ``settings.workers`` jobs at a time, until :meth:`drain`."""

    settings: ServiceSettings
    store: Store
    storage: JobStorage
    notifier: JobNotifier
    metrics: Metrics
    completion: JobCompletion
    runner: JobRunner
    draining: bool = False
    _processes: dict[str, JobProcess] = field(default_factory=dict)
    _loops: list[asyncio.Task[None]] = field(default_factory=list)
    _last_poll: dict[int, float] = field(default_factory=dict)
    _logged: set[str] = field(default_factory=set)
    _busy: int = 0
    _abandoning: bool = False
    _waits: bool = False
    _postponed: int = 0
    _postponed_reason: str = ""

    def __post_init__(self) -> None:
        self._recorder = OutcomeRecorder(self.settings, self.store, self.storage, self.metrics, self.completion)

    def start(self) -> None:
        """Start to run jobs."""
        self._loops = [asyncio.create_task(self._loop(i)) for i in range(self.settings.workers)]

    def health_problem(self) -> str | None:
        """Return why the worker does not run jobs; None if it does."""
        if self.draining:
            return "the service is stopping"
        now = asyncio.get_running_loop().time()
        for number, loop in enumerate(self._loops):
            if loop.done():
                return f"worker {number} has ended"
            if now - self._last_poll.get(number, now) > 10 * IDLE_SECONDS and not self._processes:
                return f"worker {number} has not read the queue for {now - self._last_poll[number]:.0f} s"
        return self.runner.health_problem()

    async def drain(self) -> None:
        """Start no more jobs, wait up to ``drain_seconds`` for running ones, and requeue those that need longer.

        The server calls it, and so does the end of the application, which another server could run.
        """
        self.draining = True
        self.notifier.notify(QUEUE)
        if self._processes and not self._waits:
            self._waits = True
            seconds, count = self.settings.drain_seconds, len(self._processes)
            log.info("waiting up to %g s for %d running jobs; Ctrl-C again ends them now", seconds, count)
        if self._loops:
            await asyncio.wait(self._loops, timeout=self.settings.drain_seconds)
        self.kill_running()
        await asyncio.gather(*self._loops, return_exceptions=True)

    def kill_running(self) -> None:
        """Kill all job processes."""
        for process in self._processes.values():
            process.kill()

    async def cancel(self, job: Job) -> None:
        """Cancel a job that has not ended; on return, its process has ended and its files are removed."""
        if not await run_sync(lambda: self.completion.cancel(job)):
            return
        process = self._processes.get(job.id)
        if process is not None:
            process.kill()
            await process.ended.wait()
        elif self.storage.shared:
            await self._wait_for_other_replica(job.id)
        await run_sync(self.storage.remove_job, job.id)
        self.notifier.notify(job.id)
        self.notifier.notify(ended(job.id))

    async def _wait_for_other_replica(self, job_id: str) -> None:
        """Wait until the replica that runs a job has ended it; one that has died is not waited for."""
        for _ in range(round(CANCEL_SECONDS / CANCEL_POLL_SECONDS)):
            if not await run_sync(self.store.is_claimed, job_id):
                return
            await asyncio.sleep(CANCEL_POLL_SECONDS)

    def running_ids(self) -> set[str]:
        """Return the ids of all jobs with a process of this replica."""
        return set(self._processes)

    def kill(self, job_id: str) -> None:
        """Kill the process of a job, if it is running."""
        process = self._processes.get(job_id)
        if process is not None:
            process.kill()

    async def abandon(self) -> None:
        """End all jobs without recording it, because another replica has queued them again."""
        self._abandoning = True
        try:
            while self._busy:
                self.kill_running()
                await asyncio.sleep(CANCEL_POLL_SECONDS)
        finally:
            self._abandoning = False

    # Running -------------------------------------------------------------------------------------------------------

    async def _loop(self, number: int) -> None:
        while not self.draining:
            self._last_poll[number] = asyncio.get_running_loop().time()
            queued = self.notifier.subscribe(QUEUE)
            try:
                job = await run_sync(self._claim)
            except (SQLAlchemyError, OSError) as error:
                self._log_once("no job is started", error)
                await asyncio.sleep(IDLE_SECONDS)
                continue
            if self._logged:
                log.info("jobs can be started again")
                self._logged.clear()
            if job is None:
                await wait(queued, IDLE_SECONDS)
            else:
                self._busy += 1
                try:
                    await self._run(job)
                finally:
                    self._busy -= 1

    def _claim(self) -> Job | None:
        self.storage.check()  # else all queued jobs would fail, because their uploads cannot be read
        if problem := self.runner.health_problem():
            raise ConnectionError(problem)
        return self.store.claim()

    async def _run(self, job: Job) -> None:
        process = self._processes[job.id] = self.runner.process()
        log.info("job %s starts: %d Gaussians, %s", job.id, job.gaussians, job.preset)
        self.metrics.busy.inc()
        if job.starts == 1 and job.started_at is not None:
            self.metrics.waited.observe(job.started_at - job.created_at)
        self.notifier.notify(job.id)
        place = workplace(self.settings, self.storage, job)
        try:
            outcome = await self._follow(job, process, place)
            if outcome.kind == "lost" and job.starts < self.settings.job_starts:
                await self._rest(min(MOST_LOST_SECONDS, LOST_SECONDS * 2 ** (job.starts - 1)), process)
        except Exception as error:
            log.exception("job %s: its process could not be run", job.id)
            outcome = outcome_of(error)
        finally:
            if self._processes.get(job.id) is process:  # else another start of the job is running
                del self._processes[job.id]
            process.ended.set()
            self.metrics.busy.dec()
        storage_problem = await run_sync(self.storage.health_problem)
        if storage_problem and outcome.kind in ("error", "crashed", "lost"):
            outcome = Outcome("postponed")  # not caused by the job
        await self._finish(job, outcome, place)

    async def _rest(self, seconds: float, process: JobProcess | None = None) -> None:
        """Wait, but not while all jobs are being ended, or once the process of a job has been killed."""
        clock = asyncio.get_running_loop().time
        end = clock() + seconds
        while clock() < end and not (self.draining or self._abandoning or (process is not None and process.killed)):
            await asyncio.sleep(min(REST_POLL_SECONDS, seconds))

    async def _follow(self, job: Job, process: JobProcess, place: Workplace) -> Outcome:
        current = await run_sync(self.store.get, job.id)  # cancelled before its process was registered?
        if current is None or current.state != State.RUNNING:
            return Outcome("stopped")
        try:
            task = await run_sync(place.task)
        except FileNotFoundError:
            return Outcome("error", {"code": "internal", "detail": LOST})

        async def progress(stage: str, fraction: float, note: str) -> None:
            try:
                await run_sync(self.store.progress, job.number, stage, fraction, note)
            except SQLAlchemyError as error:  # for example a full disk; the job may still succeed
                self._log_once(f"job {job.id}: progress was not recorded", error)
            self.notifier.notify(job.id)

        keeping = asyncio.create_task(self._keep_checkpoints(job, place)) if place.stores_checkpoints else None
        try:
            return await process.run(task, progress)
        finally:
            if keeping is not None:
                keeping.cancel()
                await asyncio.gather(keeping, return_exceptions=True)

    async def _keep_checkpoints(self, job: Job, place: Workplace) -> None:
        """Store the checkpoints of a running job for other replicas, in at most a tenth of the time."""
        clock = asyncio.get_running_loop().time
        while True:
            await asyncio.sleep(CHECKPOINT_SECONDS)
            begun = clock()
            try:
                await run_sync(place.store_checkpoints)
            except OSError as error:  # the job may succeed without
                self._log_once(f"job {job.id}: its checkpoint was not stored", error)
            await asyncio.sleep(9 * (clock() - begun))

    # How jobs end -----------------------------------------------------------------------------------------------------

    async def _finish(self, job: Job, outcome: Outcome, place: Workplace) -> None:
        """Record how a job ended; retry while that fails, so that no job is lost because of a full disk."""
        while True:
            try:
                await run_sync(self._recorder.record, job, outcome, place, self.draining)
                break
            except (SQLAlchemyError, OSError) as error:
                if self._abandoning:
                    await run_sync(self.storage.remove_work, job.id)
                    return
                if outcome.kind == "done" and await run_sync(self._recorder.is_permanent, error):
                    log.error("job %s: its result cannot be kept: %s", job.id, error_text(error))
                    outcome = outcome_of(error)
                    continue
                self._log_once(f"job {job.id}: its end was not recorded; trying again", error)
                if self.draining:  # the next start of the service recovers the job
                    return
                await asyncio.sleep(IDLE_SECONDS)
            except Exception:  # a bug: the job must end nevertheless, and the worker continue
                log.exception("job %s: its outcome could not be recorded", job.id)
                if outcome is INTERNAL_ERROR:  # the next start of the service recovers the job
                    return
                outcome = INTERNAL_ERROR
        self.notifier.notify(job.id)
        self.notifier.notify(ended(job.id))
        if outcome.kind == "postponed":
            await self._rest_after_postponed(str(outcome.data.get("reason", "")))
        else:
            self._postponed, self._postponed_reason = 0, ""
        self.notifier.notify(QUEUE)

    async def _rest_after_postponed(self, reason: str) -> None:
        """Wait before the same job is tried again, longer each time; log every new reason once."""
        if reason and reason != self._postponed_reason:
            log.warning("jobs cannot be started and wait: %s", reason)
            self._postponed_reason = reason
        seconds = min(MOST_POSTPONED_SECONDS, IDLE_SECONDS * 2**self._postponed)
        self._postponed += 1
        await self._rest(seconds)

    def _log_once(self, what: str, error: Exception) -> None:
        """Log a repeated failure only once, until the queue can be read again."""
        reason = f"{what}: {error_text(error)}"
        if reason not in self._logged:
            log.error("%s", reason)
            self._logged.add(reason)
