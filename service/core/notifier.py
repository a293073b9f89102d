"""Waking those who wait for a job: long polls, event streams, the worker."""

from __future__ import annotations

import asyncio
from weakref import WeakValueDictionary


class JobNotifier:
    """Rings are heard by all who wait at that moment. Take a :meth:`subscribe` first, then look, then wait."""

    def __init__(self) -> None:
        self._waiting: WeakValueDictionary[str, asyncio.Event] = WeakValueDictionary()
        self.closing = False

    def subscribe(self, name: str) -> asyncio.Event:
        """What is set at the next ring for ``name``."""
        event = self._waiting.get(name)
        if event is None:
            event = asyncio.Event()
            self._waiting[name] = event
            if self.closing:
                event.set()
        return event

    def notify(self, name: str) -> None:
        """Wake who waits for ``name``."""
        event = self._waiting.pop(name, None)
        if event is not None:
            event.set()

    def close(self) -> None:
        """Wake everyone: the service is stopping."""
        self.closing = True
        for event in list(self._waiting.values()):
            event.set()


def ended(job_id: str) -> str:
    """What is rung when a job has ended: who waits for that need not wake for every step of its work."""
    return f"end of {job_id}"


async def wait(event: asyncio.Event, seconds: float) -> bool:
    """Wait for a ring, so long at most; whether there was one."""
    try:
        async with asyncio.timeout(seconds):
            await event.wait()
    except TimeoutError:
        return False
    return True
