"""A clock that never jumps: a machine's own may be set forward by a year, and no result should expire from it."""

from __future__ import annotations

import time
from collections.abc import Callable
from datetime import UTC, datetime

MOST_BEHIND = 2 * 86400.0
"""Seconds."""


def ticks() -> float:
    """Seconds that pass even while the machine sleeps, where the system counts those."""
    return time.clock_gettime(time.CLOCK_BOOTTIME) if hasattr(time, "CLOCK_BOOTTIME") else time.monotonic()


class Clock:
    """Seconds since 1970 that grow as real time does, whatever is done to the machine's clock meanwhile.

    Args:
        wall: the machine's clock, read once.
        steady: one that only ever ticks.
    """

    def __init__(self, wall: Callable[[], float] = time.time, steady: Callable[[], float] = ticks) -> None:
        self._steady = steady
        self._offset = wall() - steady()

    def start_after(self, floor: float) -> None:
        """Do not fall behind ``floor``, the latest time that a former run has written down.

        Unless that is days ahead: then it was that run's clock which was wrong.
        """
        ahead = floor - self()
        if 0 < ahead < MOST_BEHIND:
            self._offset += ahead

    def __call__(self) -> float:
        """The time."""
        return self._offset + self._steady()


def as_datetime(seconds: float) -> datetime:
    """With its time zone, for people and JSON."""
    return datetime.fromtimestamp(seconds, UTC)
