"""Ctrl-C and requests to end, on the command line."""

from __future__ import annotations

import contextlib
import os
import signal
import sys
import threading
from collections.abc import Callable, Iterator
from typing import TYPE_CHECKING

from kissgs.cli.interrupts import Interrupted, end, leave_when_told, reason_of_end, unwind_when_told
from kissgs.core.errors import StopSearch

if TYPE_CHECKING:
    from types import FrameType

    from kissgs.core.progress import Progress


ENOUGH = b"\nkissgs: enough: the best so far is taken, if there is one; Ctrl-C again: nothing is\n"


def unwinding(work: Callable[[], None]) -> None:
    """Do it; meanwhile, a request to end unwinds everything first. Before and after, it ends the process at once."""
    sys.unraisablehook = _again
    try:
        unwind_when_told()
        try:
            work()
        finally:
            leave_when_told()
    except BaseException as error:
        number = reason_of_end(error)
        if number is not None:
            end(number)
        raise


def _again(lost: sys.UnraisableHookArgs) -> None:
    """A signal that arrives inside a finalizer is printed and forgotten by Python: it is sent once more."""
    if isinstance(lost.exc_value, Interrupted):
        threading.Timer(0.01, os.kill, (os.getpid(), lost.exc_value.args[0])).start()
    else:
        sys.__unraisablehook__(lost)


@contextlib.contextmanager
def stoppable(progress: Progress, searches: bool) -> Iterator[Progress]:
    """While a goal is sought, the first Ctrl-C ends the search with what it has found; another one ends all."""
    if not searches:
        yield progress
        return
    told: list[int] = []
    before = signal.getsignal(signal.SIGINT)

    def heard(number: int, frame: FrameType | None) -> None:
        told.append(number)
        signal.signal(signal.SIGINT, before)
        os.write(2, ENOUGH)  # at once: it may take a while until progress is told

    def receive(stage: str, fraction: float, note: str = "") -> None:
        if told:
            told.clear()
            raise StopSearch
        progress(stage, fraction, note)

    signal.signal(signal.SIGINT, heard)
    try:
        yield receive
    except StopSearch as error:
        raise Interrupted(signal.SIGINT) from error
    finally:
        signal.signal(signal.SIGINT, before)
