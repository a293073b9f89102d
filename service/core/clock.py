"""A clock that never jumps: setting the machine's clock must not make results expire."""

from __future__ import annotations

import time
from collections.abc import Callable

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
