"""Handling of Ctrl-C and SIGTERM while a command works."""

from __future__ import annotations

import contextlib
import os
import signal
import sys
import threading
from collections.abc import Callable, Iterator
from typing import TYPE_CHECKING

from kissgs.cli import interrupts
from kissgs.core.context import with_seconds_left
from kissgs.core.errors import StopSearch

if TYPE_CHECKING:
    from types import FrameType

    from kissgs.core.context import Progress


_STOPPING = (
    b"\nkissgs: stopping: completing the best result so far, if any, which may take minutes; Ctrl-C again aborts\n"
)


def unwinding(work: Callable[[], None]) -> None:
    """Run ``work`` so that a signal unwinds the stack before the process exits; before and after, it exits at once."""
    sys.unraisablehook = _raise_again
    try:
        interrupts.unwind_on_signal()
        try:
            work()
        finally:
            interrupts.exit_on_signal()
    except BaseException as error:
        if (number := interrupts.signal_behind(error)) is not None:
            interrupts.exit_by_signal(number)
        raise


def _raise_again(lost: sys.UnraisableHookArgs) -> None:
    """Send a signal again that arrived inside a finalizer, where Python prints and discards exceptions."""
    if isinstance(lost.exc_value, interrupts.Interrupted):
        threading.Timer(0.01, os.kill, (os.getpid(), lost.exc_value.args[0])).start()
    else:
        sys.__unraisablehook__(lost)


@contextlib.contextmanager
def stoppable(progress: Progress, searches: bool) -> Iterator[Progress]:
    """Yield a receiver with which one Ctrl-C ends a search for a goal with its best result, and a second one aborts."""
    if not searches:
        yield progress
        return
    pending: list[int] = []
    forward = with_seconds_left(progress)
    before = signal.getsignal(signal.SIGINT)

    def on_interrupt(number: int, frame: FrameType | None) -> None:
        pending.append(number)
        signal.signal(signal.SIGINT, before)
        os.write(2, _STOPPING)  # at once: the next progress event may take a while

    def receive(stage: str, fraction: float, note: str = "", seconds_left: float | None = None) -> None:
        if pending:
            pending.clear()
            raise StopSearch
        forward(stage, fraction, note, seconds_left)

    signal.signal(signal.SIGINT, on_interrupt)
    try:
        yield receive
    except StopSearch as error:
        interrupts.say_when_interrupted(lambda: f"nothing met the goal yet, and {interrupts.NOTHING_LEFT}")
        raise interrupts.Interrupted(signal.SIGINT) from error
    finally:
        signal.signal(signal.SIGINT, before)
