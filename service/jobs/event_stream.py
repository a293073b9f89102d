"""A job's events as a stream that can be taken up again where it broke off."""

from __future__ import annotations

import asyncio
import json
from collections.abc import AsyncIterator
from dataclasses import dataclass, field
from weakref import WeakValueDictionary

from anyio.to_thread import run_sync

from service.core.models import ACTIVE, Event, Job
from service.core.notifier import JobNotifier, wait
from service.jobs.status import QueueEstimator, job_status
from service.storage.job_store import Store

SILENCE_SECONDS = 15.0
"""After which a comment is sent, so that nobody takes the connection for dead."""

RETRY_MILLISECONDS = 1000
"""When a browser connects again after a broken connection."""


class _Feed:
    """The events of one job, read once for all who follow it."""

    def __init__(self) -> None:
        self.events: list[Event] = []
        self.job: Job | None = None
        self.turn = asyncio.Lock()
        self.subscribe = asyncio.Event()
        self.subscribe.set()  # nothing has been read


@dataclass(frozen=True)
class EventStream:
    """Streams events of jobs to any number of clients."""

    store: Store
    notifier: JobNotifier
    workers: int
    _feeds: WeakValueDictionary[str, _Feed] = field(default_factory=WeakValueDictionary)

    async def stream(self, job: Job, after: int) -> AsyncIterator[str]:
        """Events from ``after`` on, until the job has ended, is gone, or the service stops."""
        yield f"retry: {RETRY_MILLISECONDS}\n\n"
        feed = self._feeds.get(job.id)
        if feed is None:
            feed = self._feeds[job.id] = _Feed()
        while True:
            await self._refresh(feed, job)
            current = feed.job
            for event in feed.events[after:]:  # ids count from 1 without gaps
                after = event.seq
                yield await self._spelled(event, current)
            if (
                current is None
                or (after >= current.last_event and current.state not in ACTIVE)
                or self.notifier.closing
            ):
                return
            if not await wait(feed.subscribe, SILENCE_SECONDS):
                yield ": still here\n\n"

    async def _refresh(self, feed: _Feed, job: Job) -> None:
        """Read what is new, unless another listener has just done so."""
        async with feed.turn:
            if feed.subscribe.is_set():
                subscribe = self.notifier.subscribe(
                    job.id
                )  # before reading: what happens meanwhile is read the next time
                feed.job, new = await run_sync(self._look, job, len(feed.events))
                feed.events += new
                feed.subscribe = subscribe

    def _look(self, job: Job, after: int) -> tuple[Job | None, list[Event]]:
        current = self.store.get(job.id)
        return current, self.store.events(job.number, after)

    async def _spelled(self, event: Event, current: Job | None) -> str:
        data = event.data
        if event.kind == "state" and current is not None and event.seq == current.last_event:  # the whole story, once
            status = await run_sync(job_status, current, QueueEstimator(self.store, self.workers))
            data = {**data, "job": status.model_dump(mode="json", exclude_none=True)}
        return f"id: {event.seq}\nevent: {event.kind}\ndata: {json.dumps(data)}\n\n"
