"""Notification of tasks that wait for a job: long polls, event streams and the worker."""

from __future__ import annotations

import asyncio
from weakref import WeakValueDictionary


class JobNotifier:
    """Wakes all current subscribers of a name. Call :meth:`subscribe` first, then read the job, then wait."""

    def __init__(self) -> None:
        self._waiting: WeakValueDictionary[str, asyncio.Event] = WeakValueDictionary()
        self.closing = False

    def subscribe(self, name: str) -> asyncio.Event:
        """Return the event that the next :meth:`notify` for ``name`` sets."""
        event = self._waiting.get(name)
        if event is None:
            event = asyncio.Event()
            self._waiting[name] = event
            if self.closing:
                event.set()
        return event

    def notify(self, name: str) -> None:
        """Wake all subscribers of ``name``."""
        event = self._waiting.pop(name, None)
        if event is not None:
            event.set()

    def notify_end(self, job_id: str) -> None:
        """Wake all subscribers of a job, also those that wait for its end alone."""
        self.notify(job_id)
        self.notify(ended(job_id))

    def close(self) -> None:
        """Wake all subscribers, because the service is stopping."""
        self.closing = True
        for event in list(self._waiting.values()):
            event.set()


def ended(job_id: str) -> str:
    """Return the name that is notified once a job has ended, for subscribers that do not need its progress."""
    return f"end of {job_id}"


async def wait(event: asyncio.Event, seconds: float) -> bool:
    """Wait for a notification for at most ``seconds``; return whether there was one."""
    try:
        async with asyncio.timeout(seconds):
            await event.wait()
    except TimeoutError:
        return False
    return True
