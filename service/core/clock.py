"""A clock that never jumps, since setting the machine's clock must not make results expire; and notification of tasks
that wait for a job: long polls, event streams and the worker."""

from __future__ import annotations

import asyncio
import time
from collections.abc import Callable
from weakref import WeakValueDictionary

MAX_CLOCK_LEAD_SECONDS = 2 * 86400.0  # of a recorded time over this clock; beyond it, its clock was wrong


def ticks() -> float:
    """Return the seconds of a monotonic clock, including suspended time where the system counts it."""
    return time.clock_gettime(time.CLOCK_BOOTTIME) if hasattr(time, "CLOCK_BOOTTIME") else time.monotonic()


class Clock:
    """Seconds since 1970 that advance with real time, independent of later changes to the machine's clock."""

    def __init__(self, wall: Callable[[], float] = time.time, steady: Callable[[], float] = ticks) -> None:
        self._steady = steady
        self._offset = wall() - steady()

    def start_after(self, floor: float) -> None:
        """Advance to at least ``floor``, the latest time recorded by a previous run. A floor more than
        :data:`MAX_CLOCK_LEAD_SECONDS` ahead is ignored: the clock of that run was wrong."""
        ahead = floor - self()
        if 0 < ahead < MAX_CLOCK_LEAD_SECONDS:
            self._offset += ahead

    def __call__(self) -> float:
        """Return the current time in seconds since 1970."""
        return self._offset + self._steady()


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
