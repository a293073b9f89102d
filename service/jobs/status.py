"""Status of jobs for clients, with estimates of waiting times, and their events as a stream that can be resumed."""

from __future__ import annotations

import itertools
import json
import statistics
import threading
from collections.abc import AsyncIterator, Iterable, Mapping
from dataclasses import dataclass

from anyio.to_thread import run_sync

from ..core.clock import as_datetime
from ..core.files import THUMBNAIL
from ..core.models import ACTIVE, Event, Job, State
from ..core.notifier import JobNotifier, wait
from ..core.presets import can_train, limited_seconds, usual_seconds
from ..core.schemas import CAPTURED, FINETUNED, TIMED, Estimate, JobOptions, JobStatus, Links, Progress, Sizes, Timings
from ..storage.job_records import Store


class QueueEstimator:
    """Estimates of positions and times, from one reading of the queue for each change of it."""

    def __init__(self, store: Store, workers: int) -> None:
        self._store, self._workers = store, workers
        self._lock = threading.Lock()
        self._changes: int | None = None
        self._latest: Queue | None = None

    def current(self) -> Queue:
        """Return the estimates at this moment."""
        with self._lock:
            changes = self._store.changes  # first, so that a change during the reading is read the next time
            if self._latest is None or changes != self._changes:
                self._latest, self._changes = Queue(self._store, self._workers), changes
            return self._latest


class Queue:
    """All active jobs at one time, the rates of recent ones, and what follows for their positions and times."""

    def __init__(self, store: Store, workers: int) -> None:
        self._store, self._workers = store, workers
        self._rates: dict[tuple[str, bool], float | None] = {}
        active, turns = store.active(), store.turns
        self._running = [job for job in active if job.state == State.RUNNING]
        self._positions: dict[int, int] = {}
        self._seconds_before: dict[int, float] = {}
        before = 0.0
        for job in _in_turn((job for job in active if job.state == State.QUEUED), turns):
            self._positions[job.number] = 1 + len(self._positions)
            self._seconds_before[job.number] = before
            before += self._remaining(job)

    @property
    def now(self) -> float:
        """The current time in seconds since 1970."""
        return self._store.clock()

    def _total(self, job: Job) -> float:
        """Estimate the seconds of a job from start to end, from recent jobs with equal preset and evaluation."""
        kind = _kind_without_limit(job), job.evaluate
        if kind not in self._rates:
            rates = self._store.rates(*kind)
            self._rates[kind] = statistics.median(rates) if rates else None
        rate = self._rates[kind]
        total = usual_seconds(*kind, job.gaussians) if rate is None else rate * job.gaussians
        if (limit := job.options.get("time_limit")) is not None:
            total = limited_seconds(*kind, job.gaussians, total, limit)
        return total

    def _remaining(self, job: Job) -> float:
        """Estimate the seconds that a queued or running job is still to run, from its progress if that is known."""
        if (end := self._store.ends.get(job.number)) is not None:
            return max(end - self.now, 0.0)
        total, started = self._total(job), job.started_at if job.state == State.RUNNING else None
        return max(total - (self.now - started if started is not None else 0.0), 0.1 * total, 0.5)

    def position(self, job: Job) -> int:
        """Return the position of a queued job; 1 is next."""
        return self._positions.get(job.number, 1)  # just started

    def seconds_left(self, job: Job) -> float:
        """Estimate the seconds until a queued or running job ends."""
        seconds = self._remaining(job)
        if job.state != State.QUEUED:
            return seconds
        before = sum(map(self._remaining, self._running)) + self._seconds_before.get(job.number, 0.0)
        return seconds + before / self._workers

    def seconds_to_room(self) -> float:
        """Estimate the seconds until the queue has room, 1 to 300."""
        return min(300.0, max(1.0, min(map(self._remaining, self._running), default=1.0) / self._workers))


_OF_RESULTS = ("source_format", "compacted", "finetuning", "invisible", "cleaned", "evaluation")
"""Entries of a result's summary that the status has under the same names."""


def job_status(job: Job, queue: Queue) -> JobStatus:
    """Return the current status of a job."""
    waits, runs, result = job.state == State.QUEUED, job.state == State.RUNNING, job.result or {}
    estimate = None
    if waits or runs:
        seconds = queue.seconds_left(job)
        estimate = Estimate(seconds_left=round(seconds, 1), ready_at=as_datetime(queue.now + seconds))
    return JobStatus(
        state=State(job.state),
        position=queue.position(job) if waits else None,
        progress=Progress(stage=job.stage, fraction=job.fraction, note=job.note) if runs and job.stage else None,
        estimate=estimate,
        options=JobOptions.stored(job.options),
        kept=result.get("count"),
        note=result.get("note") or None,
        sizes=_sizes(job),
        timings=_timings(job, queue.now),
        links=_links(job),
        expires_at=as_datetime(job.expires_at) if job.expires_at is not None else None,
        id=job.id,
        name=job.name,
        upload_bytes=job.upload_bytes,
        gaussians=job.gaussians,
        sh_degree=job.sh_degree,
        starts=job.starts,
        problem=job.problem,
        **{name: result.get(name) for name in _OF_RESULTS},
    )


def _kind_without_limit(job: Job) -> str:
    """Return the kind of the same job without a time limit, with fine-tuning where that is left to the time."""
    if not job.preset.endswith(TIMED):
        return job.preset
    open_to_tuning = job.options["finetune"]["enabled"] is None and CAPTURED not in job.preset and can_train()
    return job.preset.removesuffix(TIMED) + (FINETUNED if open_to_tuning else "")


def _sizes(job: Job) -> Sizes | None:
    if job.result is None:
        return None
    container = job.result["container"]["bytes"]
    return Sizes(
        container=container,
        files={name: file["stored"] for name, file in job.result["files"].items()},
        ratio=job.upload_bytes / container,
        bytes_per_gaussian=container / max(job.gaussians, 1),
    )


def _timings(job: Job, now: float) -> Timings:
    started, finished = job.started_at, job.finished_at
    until = finished if finished is not None else now
    return Timings(
        created_at=as_datetime(job.created_at),
        started_at=as_datetime(started) if started is not None else None,
        finished_at=as_datetime(finished) if finished is not None else None,
        queue_seconds=max(0.0, started - job.created_at) if started is not None else None,
        run_seconds=max(0.0, until - started) if started is not None and job.state != State.QUEUED else None,
        stages=job.result["seconds"] if job.result else None,
        cpu_seconds=job.result["cpu_seconds"] if job.result else None,
    )


def _links(job: Job) -> Links:
    here, done = f"/v1/jobs/{job.id}", job.state == State.SUCCEEDED
    return Links(
        self=here,
        events=f"{here}/events",
        cancel=f"{here}/cancel" if job.state in ACTIVE else None,
        result=f"{here}/result" if done else None,
        files=f"{here}/files/{{name}}" if done and (job.result or {}).get("files") else None,
        thumbnail=f"{here}/{THUMBNAIL}" if done and "thumbnail" in (job.result or {}) else None,
        decoded=f"{here}/decoded" if done else None,
        source=f"{here}/source" if done and job.upload_kept else None,
        report=f"{here}/report" if done else None,
        preview=f"/preview/{job.id}" if done else None,
    )


KEEPALIVE_SECONDS = 15.0  # without an event; then a comment is sent, so that the connection is not taken for dead
RETRY_MILLISECONDS = 1000  # delay after which a browser reconnects, milliseconds


@dataclass(frozen=True)
class EventStream:
    """Streams of job events to any number of clients."""

    store: Store
    notifier: JobNotifier
    queue: QueueEstimator

    async def stream(self, job: Job, after: int) -> AsyncIterator[str]:
        """Yield the events with a ``seq`` above ``after``, until the job ends or is deleted, or the service stops."""
        yield f"retry: {RETRY_MILLISECONDS}\n\n"
        while True:
            changed = self.notifier.subscribe(job.id)  # before reading, so that no later event is missed
            current, events = await run_sync(self._read, job, after)
            for seq, text in events:
                after = seq
                yield text
            ended = current is None or (after >= current.last_event and current.state not in ACTIVE)
            if ended or self.notifier.closing:
                return
            if not await wait(changed, KEEPALIVE_SECONDS):
                yield ": keep-alive\n\n"

    def _read(self, job: Job, after: int) -> tuple[Job | None, list[tuple[int, str]]]:
        """Return the job as it is now, None if it was deleted, and number and text of each event after ``after``."""
        current = self.store.get(job.id)
        return current, [(event.seq, self._text(event, current)) for event in self.store.events(job.number, after)]

    def _text(self, event: Event, current: Job | None) -> str:
        """Return the text of an event; only the latest state has the full status."""
        data = event.data
        if event.kind == "state" and current is not None and event.seq == current.last_event:
            status = job_status(current, self.queue.current())
            data = {**data, "job": status.model_dump(mode="json", exclude_none=True)}
        return f"id: {event.seq}\nevent: {event.kind}\ndata: {json.dumps(data)}\n\n"


def _in_turn(queued: Iterable[Job], turns: Mapping[str, int]) -> list[Job]:
    """Return queued jobs in the order in which :meth:`Store.claim` starts them: one of each owner, then the next ones.
    First is the owner whose ``turns``, the number of its last start, is the lowest; of one owner, the oldest job."""
    waiting: dict[str, list[Job]] = {}
    for job in sorted(queued, key=lambda job: job.number):
        waiting.setdefault(job.owner, []).append(job)
    owners = sorted(waiting.values(), key=lambda jobs: (turns.get(jobs[0].owner, 0), jobs[0].number))
    return [job for turn in itertools.zip_longest(*owners) for job in turn if job is not None]
