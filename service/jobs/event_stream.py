"""Server-sent events of a job, as a stream that clients can resume after a lost connection."""

from __future__ import annotations

import asyncio
import json
from collections.abc import AsyncIterator
from dataclasses import dataclass, field
from typing import Any
from weakref import WeakValueDictionary

from anyio.to_thread import run_sync

from ..core.models import ACTIVE, Event, Job
from ..core.notifier import JobNotifier, wait
from ..storage.job_records import Store
from .status import QueueEstimator, job_status

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
