"""Status of jobs for clients, with estimates of waiting times, and their events as a stream that can be resumed."""

from __future__ import annotations

import asyncio
import heapq
import json
import statistics
import threading
from collections import deque
from collections.abc import AsyncIterator, Iterable, Mapping
from dataclasses import dataclass, field
from typing import Any
from weakref import WeakValueDictionary

from anyio.to_thread import run_sync

from ..core.clock import as_datetime
from ..core.models import ACTIVE, Event, Job, State
from ..core.notifier import JobNotifier, wait
from ..core.presets import can_train, limited_seconds, usual_seconds
from ..core.schemas import FINETUNED, TIMED, Estimate, JobOptions, JobStatus, Links, Progress, Sizes, Timings
from ..storage.job_records import Store


class QueueEstimator:
    """Estimates of positions and times, from one reading of the queue for each change of it."""

    def __init__(self, store: Store, workers: int) -> None:
        self._store, self._workers = store, workers
        self._lock = threading.Lock()
        self._changes: int | None = None
        self._latest: _Queue | None = None

    def current(self) -> QueueEstimates:
        """Return the estimates at this moment."""
        with self._lock:
            changes = self._store.changes  # first, so that a change during the reading is read the next time
            if self._latest is None or changes != self._changes:
                self._latest, self._changes = _Queue(self._store, self._workers), changes
            return QueueEstimates(self._latest, self._store.clock())


class _Queue:
    """All active jobs at one time, and the rates of recent ones."""

    def __init__(self, store: Store, workers: int) -> None:
        self._store = store
        self._rates: dict[tuple[str, bool], float | None] = {}
        self.workers = workers
        active, turns = store.active(), store.turns
        self.running = [(self.total(job), job.started_at) for job in active if job.state == State.RUNNING]
        self.positions: dict[int, int] = {}
        self.seconds_before: dict[int, float] = {}
        before = 0.0
        for job in _in_turn((job for job in active if job.state == State.QUEUED), turns):
            self.positions[job.number] = 1 + len(self.positions)
            self.seconds_before[job.number] = before
            before += _remaining(self.total(job), 0.0)

    def total(self, job: Job) -> float:
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


class QueueEstimates:
    """Estimates at one moment, ``now`` in seconds since 1970."""

    def __init__(self, queue: _Queue, now: float) -> None:
        self.now, self._queue = now, queue
        self._running = [_remaining(total, now - (now if began is None else began)) for total, began in queue.running]

    def position(self, job: Job) -> int:
        """Return the position of a queued job; 1 is next."""
        return self._queue.positions.get(job.number, 1)  # just started

    def seconds_left(self, job: Job) -> float:
        """Estimate the seconds until a queued or running job ends."""
        runs = job.state == State.RUNNING and job.started_at is not None
        seconds = _remaining(self._queue.total(job), self.now - (job.started_at or self.now) if runs else 0.0)
        if job.state != State.QUEUED:
            return seconds
        before = self._queue.seconds_before.get(job.number, 0.0)
        return seconds + (sum(self._running) + before) / self._queue.workers

    def seconds_to_room(self) -> float:
        """Estimate the seconds until the queue has room, 1 to 300."""
        return min(300.0, max(1.0, min(self._running, default=1.0) / self._queue.workers))


def _remaining(total: float, spent: float) -> float:
    return max(total - spent, 0.1 * total, 0.5)  # a running job is never taken for done


def job_status(job: Job, queue: QueueEstimates) -> JobStatus:
    """Return the current status of a job."""
    waits, runs, result = job.state == State.QUEUED, job.state == State.RUNNING, job.result or {}
    return JobStatus(
        id=job.id,
        name=job.name,
        state=State(job.state),
        position=queue.position(job) if waits else None,
        progress=Progress(stage=job.stage, fraction=job.fraction, note=job.note) if runs and job.stage else None,
        estimate=_estimate(job, queue) if waits or runs else None,
        options=JobOptions.model_validate(job.options),
        upload_bytes=job.upload_bytes,
        source_format=result.get("source_format"),
        gaussians=job.gaussians,
        sh_degree=job.sh_degree,
        kept=result.get("count"),
        compacted=result.get("compacted"),
        finetuning=result.get("finetuning"),
        note=result.get("note") or None,
        invisible=result.get("invisible"),
        cleaned=result.get("cleaned"),
        evaluation=result.get("evaluation"),
        sizes=_sizes(job),
        timings=_timings(job, queue.now),
        starts=job.starts,
        problem=job.problem,
        links=_links(job),
        expires_at=as_datetime(job.expires_at) if job.expires_at is not None else None,
    )


def _kind_without_limit(job: Job) -> str:
    """Return the kind of the same job without a time limit, with fine-tuning where that is left to the time."""
    if not job.preset.endswith(TIMED):
        return job.preset
    open_to_tuning = job.options["finetune"]["enabled"] is None and can_train()
    return job.preset.removesuffix(TIMED) + (FINETUNED if open_to_tuning else "")


def _estimate(job: Job, queue: QueueEstimates) -> Estimate:
    seconds = queue.seconds_left(job)
    return Estimate(seconds_left=round(seconds, 1), ready_at=as_datetime(queue.now + seconds))


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
        files=f"{here}/files/{{name}}" if done else None,
        decoded=f"{here}/decoded" if done else None,
        source=f"{here}/source" if done and job.upload_kept else None,
        report=f"{here}/report" if done else None,
        preview=f"/preview/{job.id}" if done else None,
    )


KEEPALIVE_SECONDS = 15.0
"""Seconds without an event after which a comment is sent, so that the connection is not taken for dead."""

RETRY_MILLISECONDS = 1000
"""Delay after which a browser reconnects, milliseconds."""


class _Feed:
    """Events of one job, read from the database once for all its clients."""

    def __init__(self) -> None:
        self.events: list[Event] = []
        self.job: Job | None = None
        self.lock = asyncio.Lock()
        self.changed = asyncio.Event()
        self.changed.set()  # nothing has been read


@dataclass(frozen=True)
class EventStream:
    """Streams of job events to any number of clients."""

    store: Store
    notifier: JobNotifier
    queue: QueueEstimator
    _feeds: WeakValueDictionary[str, _Feed] = field(default_factory=WeakValueDictionary)

    async def stream(self, job: Job, after: int) -> AsyncIterator[str]:
        """Yield the events with a ``seq`` above ``after``, until the job ends or is deleted, or the service stops."""
        yield f"retry: {RETRY_MILLISECONDS}\n\n"
        feed = self._feeds.get(job.id)
        if feed is None:
            feed = self._feeds[job.id] = _Feed()
        while True:
            await self._refresh(feed, job)
            current = feed.job
            for event in feed.events[after:]:  # ids count from 1 without gaps
                after = event.seq
                yield await self._format(event, current)
            if (
                current is None
                or (after >= current.last_event and current.state not in ACTIVE)
                or self.notifier.closing
            ):
                return
            if not await wait(feed.changed, KEEPALIVE_SECONDS):
                yield ": keep-alive\n\n"

    async def _refresh(self, feed: _Feed, job: Job) -> None:
        """Read new events, unless another client's request has just done so."""
        async with feed.lock:
            if feed.changed.is_set():
                changed = self.notifier.subscribe(job.id)  # before reading, so that no later event is missed
                feed.job, new = await run_sync(self._read, job, len(feed.events))
                feed.events += new
                feed.changed = changed

    def _read(self, job: Job, after: int) -> tuple[Job | None, list[Event]]:
        current = self.store.get(job.id)
        return current, self.store.events(job.number, after)

    def _status(self, job: Job) -> dict[str, Any]:
        return job_status(job, self.queue.current()).model_dump(mode="json", exclude_none=True)

    async def _format(self, event: Event, current: Job | None) -> str:
        data = event.data
        if (
            event.kind == "state" and current is not None and event.seq == current.last_event
        ):  # the full status is sent with the latest event only
            data = {**data, "job": await run_sync(self._status, current)}
        return f"id: {event.seq}\nevent: {event.kind}\ndata: {json.dumps(data)}\n\n"


def _in_turn(queued: Iterable[Job], turns: Mapping[str, int]) -> list[Job]:
    """Return queued jobs in the order in which :meth:`Store.claim` starts them.

    The owners take turns, first the one whose ``turns``, the number of its last start, is the lowest; of one owner, the
    oldest job is first.
    """
    waiting: dict[str, deque[Job]] = {}
    for job in sorted(queued, key=lambda job: job.number):
        waiting.setdefault(job.owner, deque()).append(job)
    heads = [(turns.get(owner, 0), jobs[0].number, owner) for owner, jobs in waiting.items()]
    heapq.heapify(heads)
    order: list[Job] = []
    latest = max(turns.values(), default=0)
    while heads:
        _, _, owner = heapq.heappop(heads)
        order.append(waiting[owner].popleft())
        if waiting[owner]:
            heapq.heappush(heads, (latest + len(order), waiting[owner][0].number, owner))
    return order
