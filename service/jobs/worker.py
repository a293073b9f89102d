"""Worker: runs queued jobs in order of submission, each in a job process, and records how they end."""

from __future__ import annotations

import asyncio
import errno
import logging
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, TypeVar

from anyio.to_thread import run_sync
from sqlalchemy.exc import SQLAlchemyError

import kissgs
from kissgs.runners import Outcome

from ..core.files import container_file
from ..core.metrics import Metrics
from ..core.models import ACTIVE, Job, State
from ..core.notifier import JobNotifier, wait
from ..core.problems import problem
from ..core.schemas import JobOptions
from ..core.settings import ServiceSettings
from ..storage.database import error_text, is_full
from ..storage.job_files import CAPTURE, JobStorage
from ..storage.job_records import Store
from .process import COMPRESS, POSTPONED, JobProcess, JobRunners, postponed

T = TypeVar("T")

log = logging.getLogger("kissgs.service")


_TRANSIENT_ERRNOS = (errno.EMFILE, errno.ENFILE, errno.EAGAIN, errno.ENOMEM, errno.ENOSPC, errno.EDQUOT)
"""Errors from a temporary lack of resources, not caused by the job."""

_PERMANENT_ERRNOS = (errno.ENOENT, errno.ENOTDIR, errno.EISDIR, errno.EEXIST, errno.ENOTEMPTY, errno.ELOOP)
"""Errors from unexpected content of a job's folder, which do not go away."""

INTERNAL_ERROR = Outcome(
    "error",
    code="internal",
    message="the job could not be run because of an error in the service; please report it with the scene",
)
"""Outcome of a bug."""

LOST = "the upload is no longer on the server's disk; submit the scene again"


@dataclass(frozen=True, slots=True)
class JobCompletion:
    """Recorder of the end of jobs; methods block on the disk and the database."""

    settings: ServiceSettings
    store: Store
    storage: JobStorage
    metrics: Metrics

    def record(self, job: Job, outcome: Outcome, work: Path | None, stopping: bool) -> None:
        """Record how a start of a job ended, and whether it is started again; the call can be repeated if it fails.
        ``job`` is as it was started, ``work`` the folder of this start, if it has got one."""
        self.store.monitor.check_files()  # else files would change without a record in the database
        self.storage.check()
        current = self.store.get(job.id)
        if current is None or current.state not in ACTIVE:  # cancelled or deleted meanwhile, or recorded already
            self.storage.remove_work(job.id)
            if current is not None and current.state == State.FAILED:
                self.storage.remove_job(job.id)
            return
        if current.state == State.QUEUED or current.started_at != job.started_at:  # recorded already: started again
            if work is not None:
                self.storage.discard(work)
            return
        if outcome.kind == "done" and work is not None:
            self.storage.keep_result(job.id, work)
        self.storage.remove_work(job.id)  # before requeueing, because another worker may then run the job
        crashed, lost, again = outcome.kind == "crashed", outcome.kind == "lost", job.starts < self.settings.job_starts
        if outcome.kind == "done":
            self.succeed(job, outcome.result)
        elif outcome.kind == "cancelled" or outcome.code in POSTPONED or (crashed and stopping):
            # The start does not count. A supervisor that stops the service may have sent the signal to job processes.
            self.store.move(job.number, State.QUEUED, starts=job.starts - 1)
        elif (crashed and job.crashes == 0 and again) or (lost and (stopping or again)):
            log.warning("job %s is started again%s", job.id, " elsewhere" if lost else "")
            self.metrics.restarts.inc()
            self.store.move(job.number, State.QUEUED, crashes=job.crashes + crashed)
        else:
            self.fail(job, outcome.code, outcome.message)

    def is_permanent(self, error: Exception) -> bool:
        """Return whether a retry would always fail, because of this job's folder alone."""
        return isinstance(error, OSError) and error.errno in _PERMANENT_ERRNOS and self.storage.health_problem() is None

    def succeed(self, job: Job, summary: dict[str, Any]) -> None:
        """Record success of a job whose result is complete."""
        self.storage.discard_checkpoints(job.id)
        kept = self.storage.upload(job.id) is not None
        values = {
            "result": summary,
            "upload_kept": kept,
            "reclaimable_bytes": self.storage.reclaimable_bytes(job.id) if kept else 0,
            "disk_bytes": self.storage.job_bytes(job.id),
        }
        if not self.end(job, State.SUCCEEDED, **values):
            current = self.store.get(job.id)
            if current is None or current.state != State.SUCCEEDED:  # cancelled at the same moment
                self.storage.remove_job(job.id)

    def fail(self, job: Job, code: str, detail: str, *, lost: bool = False) -> None:
        """Record failure of a job and remove its files; if it has ``lost`` its upload, move others to the orphaned
        folder."""
        document = problem(code, detail).model_dump(exclude_none=True)
        if not self.end(job, State.FAILED, problem=document, upload_kept=False, disk_bytes=0):
            return
        if lost:
            self.storage.set_aside(job.id, "has lost its upload")
        else:
            self.storage.remove_job(job.id)

    def end(self, job: Job, state: State, **values: Any) -> bool:  # noqa: ANN401
        """Set a job's final state and the columns ``values``; return False if it has already ended."""
        moved = self.store.move(job.number, state, expires_at=self.store.clock() + self.settings.keep_seconds, **values)
        current = self.store.get(job.id)
        if moved and current is not None:
            seconds = None if job.started_at is None else self.store.clock() - job.started_at
            self.metrics.job_ended(current, state, seconds)
            when = "before it was started" if seconds is None else f"after {seconds:.1f} s"
            log.info("job %s %s %s", job.id, state, when)
        return moved

    def cancel(self, job: Job) -> bool:
        """Record that a job was cancelled, also on a full disk; return False if it has already ended."""
        return self._despite_full_disk(lambda: self.end(job, State.CANCELLED, upload_kept=False, disk_bytes=0))

    def expire(self, number: int, job_id: str, **values: Any) -> None:  # noqa: ANN401
        """Record that an ended job has expired, with the columns ``values``, and remove its files. On a full disk the
        files go first, because the record needs space."""
        gone: dict[str, Any] = {"upload_kept": False, "disk_bytes": 0, "reclaimable_bytes": 0, **values}
        try:
            self.store.move(number, State.EXPIRED, **gone)
        except SQLAlchemyError as error:
            if not is_full(error):
                raise
            self.storage.remove_job(job_id)
            self._despite_full_disk(lambda: self.store.move(number, State.EXPIRED, **gone))
        self.storage.remove_job(job_id)

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


def outcome_of(error: Exception) -> Outcome:
    """Return the outcome of a job whose process could not be run, or whose result could not be kept."""
    if isinstance(error, OSError) and error.errno in _TRANSIENT_ERRNOS:
        return postponed()
    if isinstance(error, OSError):
        reason = (error.strerror or str(error)).lower()
        return Outcome("error", code="output", message=f"the job's files cannot be written: {reason}; try again later")
    return INTERNAL_ERROR


IDLE_SECONDS = 1.0  # seconds after which an idle worker reads the queue even without a notification

LOST_SECONDS, MOST_LOST_SECONDS = 5.0, 60.0
"""Pause before a job is started again whose first start was lost, which doubles with every start; the longest one. On a
bad node that is free, starts fail at once: without pauses, the job would soon have none left."""

MOST_POSTPONED_SECONDS = 8.0  # longest pause after jobs that could not be started; the first is IDLE_SECONDS
REST_POLL_SECONDS = 0.1  # interval between looks whether a pause must end, seconds
CHECKPOINT = "checkpoint.npz"  # name of a job's checkpoint; that of fine-tuning after compaction has the same beginning
QUEUE = "queue"  # name that is notified when a job is added to the queue


@dataclass
class Worker:
    """Runner of up to ``settings.workers`` jobs at a time, until :meth:`drain`."""

    settings: ServiceSettings
    store: Store
    storage: JobStorage
    notifier: JobNotifier
    metrics: Metrics
    completion: JobCompletion
    runners: JobRunners
    draining: bool = False
    _processes: dict[str, JobProcess] = field(default_factory=dict)
    _loops: list[asyncio.Task[None]] = field(default_factory=list)
    _last_poll: dict[int, float] = field(default_factory=dict)
    _logged: set[str] = field(default_factory=set)
    _waits: bool = False
    _postponed: int = 0
    _postponed_reason: str = ""

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
        return self.runners.health_problem()

    async def drain(self) -> None:
        """Start no more jobs, wait up to ``drain_seconds`` for running ones, and requeue those that need longer. The
        server calls it, and so does the end of the application, which another server could run."""
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
        await run_sync(self.storage.remove_job, job.id)
        self.notifier.notify_end(job.id)

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
                await self._run(job)

    def _claim(self) -> Job | None:
        self.storage.check()  # else all queued jobs would fail, because their uploads cannot be read
        if problem := self.runners.health_problem():
            raise ConnectionError(problem)
        return self.store.claim()

    async def _run(self, job: Job) -> None:
        process = self._processes[job.id] = JobProcess(self.runners)
        log.info("job %s starts: %d Gaussians, %s", job.id, job.gaussians, job.preset)
        self.metrics.busy.inc()
        if job.starts == 1 and job.started_at is not None:
            self.metrics.waited.observe(job.started_at - job.created_at)
        self.notifier.notify(job.id)
        try:
            outcome = await self._follow(job, process)
            if outcome.kind == "lost" and outcome.code not in POSTPONED and job.starts < self.settings.job_starts:
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
            outcome = postponed()  # not caused by the job
        await self._finish(job, outcome, process.work)

    async def _rest(self, seconds: float, process: JobProcess | None = None) -> None:
        """Wait, but not while all jobs are being ended, or once the process of a job has been killed."""
        clock = asyncio.get_running_loop().time
        end = clock() + seconds
        while clock() < end and not (self.draining or (process is not None and process.killed)):
            await asyncio.sleep(min(REST_POLL_SECONDS, seconds))

    async def _follow(self, job: Job, process: JobProcess) -> Outcome:
        current = await run_sync(self.store.get, job.id)  # cancelled before its process was registered?
        if current is None or current.state != State.RUNNING:
            return Outcome("cancelled")
        upload = await run_sync(self.storage.upload, job.id)
        if upload is None or (job.options.get("capture") and not await run_sync(self.storage.capture_files, job.id)):
            return Outcome("error", code="internal", message=LOST)
        process.work = await run_sync(self.storage.new_work, job.id)
        task = await run_sync(self._task, job, upload.name, process.work)

        async def progress(stage: str, fraction: float, note: str, left: float | None) -> None:
            try:
                await run_sync(self.store.progress, job.number, stage, fraction, note, left)
            except SQLAlchemyError as error:  # for example a full disk; the job may still succeed
                self._log_once(f"job {job.id}: progress was not recorded", error)
            self.notifier.notify(job.id)

        return await process.run(task, progress)

    def _task(self, job: Job, upload: str, work: Path) -> dict[str, Any]:
        """Return the task of a start, whose result goes to ``work`` in the job's folder."""
        options = JobOptions.stored(job.options)
        checkpoints = self.storage.checkpoints(job.id) if options.resumable else []
        return {
            "function": COMPRESS,
            "folder": str(work.parent),
            "files": [upload, *self.storage.capture_files(job.id), *checkpoints],
            "source": upload,
            "views": CAPTURE if options.capture else None,
            "force_views": options.force_views,
            "work": work.name,
            "checkpoint": CHECKPOINT if options.resumable else None,
            "settings": options.model_dump(mode="json", include=set(kissgs.Settings.model_fields)),
            "format": options.format,
            "container": container_file(job.options).name,
            "evaluate": options.evaluate,
            "origin": options.origin,
        }

    # How jobs end -----------------------------------------------------------------------------------------------------

    async def _finish(self, job: Job, outcome: Outcome, work: Path | None) -> None:
        """Record how a job ended; retry while that fails, so that no job is lost because of a full disk."""
        while True:
            try:
                await run_sync(self.completion.record, job, outcome, work, self.draining)
                break
            except (SQLAlchemyError, OSError) as error:
                if outcome.kind == "done" and await run_sync(self.completion.is_permanent, error):
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
        self.notifier.notify_end(job.id)
        if outcome.code in POSTPONED:  # the same job is tried again, after a longer pause each time
            if outcome.message not in ("", self._postponed_reason):
                log.warning("jobs cannot be started and wait: %s", outcome.message)
                self._postponed_reason = outcome.message
            seconds = min(MOST_POSTPONED_SECONDS, IDLE_SECONDS * 2**self._postponed)
            self._postponed += 1
            await self._rest(seconds)
        else:
            self._postponed, self._postponed_reason = 0, ""
        self.notifier.notify(QUEUE)

    def _log_once(self, what: str, error: Exception) -> None:
        """Log a repeated failure only once, until the queue can be read again."""
        reason = f"{what}: {error_text(error)}"
        if reason not in self._logged:
            log.error("%s", reason)
            self._logged.add(reason)
