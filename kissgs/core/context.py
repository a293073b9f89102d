"""``Context`` of long work: its threads and device, the receiver of its progress events, and its deadline."""

from __future__ import annotations

import time
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import Literal, Protocol, runtime_checkable

from kissgs.core.errors import StopSearch

# Progress events of long work: one callback for the command line, the service and tests.


@runtime_checkable
class Progress(Protocol):
    """Receives progress events.

    To stop the work, raise :class:`kissgs.Cancelled` from the call; to end a search for a goal with the best result so
    far, raise :class:`kissgs.StopSearch`.
    """

    def __call__(self, stage: str, fraction: float, note: str = "", /) -> None:
        """Receive an event.

        Args:
            stage: name of the current stage ("read", "order", "codebook", …).
            fraction: fraction of that stage that is done, 0 to 1.
            note: text for the user: the state of training (Gaussians, loss, PSNR) and of a search for a goal; empty in
                other stages.
        """


def silent(stage: str, fraction: float, note: str = "") -> None:
    """Ignore every event; the default receiver."""


def ignore_stop_search(progress: Progress) -> Progress:
    """Return a receiver that ignores :class:`StopSearch`: once the search is over, the work is completed."""

    def receive(stage: str, fraction: float, note: str = "") -> None:
        with suppress(StopSearch):
            progress(stage, fraction, note)

    return receive


@dataclass(slots=True, eq=False)
class SearchNote:
    """Receiver that puts the state of a search before the notes of the events."""

    progress: Progress
    note: str = ""  # the state, changed by the search

    def __call__(self, stage: str, fraction: float, note: str = "") -> None:
        """See :class:`Progress`."""
        self.progress(stage, fraction, "; ".join(filter(None, [self.note, note])))


# ``Deadline``: the time until which work shall be finished, and ``Pace``: the steps that fit in until then.

SETTLING_STEPS = 3  # steps that Pace leaves out of its mean: they load or compile what all others share


@dataclass(frozen=True, slots=True)
class Deadline:
    """Time until which work shall be finished."""

    end: float  # on the clock of :func:`time.perf_counter`, seconds

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
    """Number of steps of equal work: as many as requested, or fewer if that many do not fit in before a deadline."""

    def __init__(self, steps: int, deadline: Deadline | None = None) -> None:
        """Prepare for ``steps`` steps, of which as many are made as ``deadline`` allows."""
        self.steps = steps
        """The number of all steps, as far as is known now."""
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


# ``Context``: what all functions of long work receive.

Device = Literal["cpu", "cuda"]  # device of training and of the rasteriser for images


@dataclass(frozen=True, slots=True)
class Context:
    """Threads, device, receiver of progress events and deadline of some work."""

    threads: int = 0  # 0 means one per processor; no result depends on it
    device: Device = "cpu"
    progress: Progress = silent
    deadline: Deadline | None = None  # until then training makes as many steps as fit in; None for all steps

    def stage(self, name: str) -> Context:
        """Return the context for a part of stage ``name``; other stages in it count as fraction 0."""

        def receive(stage: str, fraction: float, note: str = "") -> None:
            self.progress(name, fraction if stage == name else 0.0)

        return replace(self, progress=receive)


DEFAULT_CONTEXT = Context()


def load_kernels(progress: Progress = silent) -> None:
    """Load numba; ``progress`` receives the stage "kernels", during which and after which kernels may be compiled."""
    progress("kernels", 0.0)
    from kissgs.core import numba_kernels  # noqa: F401

    progress("kernels", 1.0)
