"""``Deadline``: the time until which work shall be finished, and ``Pace``: the steps that fit in until then."""

from __future__ import annotations

import time
from dataclasses import dataclass

SETTLING_STEPS = 3
"""Steps that :class:`Pace` leaves out of its mean: they load or compile what all others share."""


@dataclass(frozen=True, slots=True)
class Deadline:
    """Time until which work shall be finished.

    Attributes:
        end: that time on the clock of :func:`time.perf_counter`, seconds.
    """

    end: float

    @classmethod
    def after(cls, seconds: float) -> Deadline:
        """Return the deadline that is ``seconds`` from now."""
        return cls(time.perf_counter() + seconds)

    @property
    def seconds(self) -> float:
        """Seconds that are left; below 0 once they are over."""
        return self.end - time.perf_counter()

    def earlier(self, seconds: float) -> Deadline:
        """Return the deadline that is ``seconds`` before this one."""
        return Deadline(self.end - seconds)


class Pace:
    """Number of steps of equal work: as many as requested, or fewer if that many do not fit in before a deadline.

    Attributes:
        steps: the number of all steps, as far as is known now.
    """

    def __init__(self, steps: int, deadline: Deadline | None = None) -> None:
        """Prepare for ``steps`` steps, of which as many are made as ``deadline`` allows."""
        self.steps = steps
        self._requested, self._deadline = steps, deadline
        self._settled: tuple[int, float] | None = None

    def update(self, done: int) -> None:
        """Set :attr:`steps` after ``done`` of them, from the time that they have taken."""
        if self._deadline is None:
            return
        now = time.perf_counter()
        if self._settled is None and done >= SETTLING_STEPS:
            self._settled = done, now
        left, per_step = self._deadline.end - now, 0.0
        if self._settled is not None and done > self._settled[0]:
            per_step = (now - self._settled[1]) / (done - self._settled[0])
        fitting = max(left, 0.0) / per_step if per_step > 0 else (0.0 if left <= 0 else self._requested)
        self.steps = min(done + int(min(fitting, self._requested)), self._requested)
