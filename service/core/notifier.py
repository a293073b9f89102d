"""Notification of tasks that wait for a job: long polls, event streams and the worker."""

from __future__ import annotations

import asyncio
from weakref import WeakValueDictionary

ID_CHARS = 32
"""Characters of a job's id; other names are shorter."""

_ENDED = "end of "


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

    def job_ids(self) -> set[str]:
        """Return the ids of all jobs that have subscribers."""
        names = (name.removeprefix(_ENDED) for name in list(self._waiting))
        return {name for name in names if len(name) == ID_CHARS}

    def close(self) -> None:
        """Wake all subscribers, because the service is stopping."""
        self.closing = True
        for event in list(self._waiting.values()):
            event.set()


def ended(job_id: str) -> str:
    """Return the name that is notified once a job has ended, for subscribers that do not need its progress."""
    return f"{_ENDED}{job_id}"


async def wait(event: asyncio.Event, seconds: float) -> bool:
    """Wait for a notification for at most ``seconds``; return whether there was one."""
    try:
        async with asyncio.timeout(seconds):
            await event.wait()
    except TimeoutError:
        return False
    return True
