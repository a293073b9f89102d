"""Exit on Ctrl-C or SIGTERM. Imports only modules that Python has loaded already."""

from __future__ import annotations

import os
import signal
import sys

TYPE_CHECKING = False
if TYPE_CHECKING:
    from collections.abc import Callable
    from types import FrameType
    from typing import NoReturn

SIGNALS = (signal.SIGINT, signal.SIGTERM)
NOTHING_LEFT = "no partial file is left"

_says_what_is_left: list[Callable[[], str]] = [lambda: NOTHING_LEFT]


class Interrupted(BaseException):
    """Raised by Ctrl-C or SIGTERM: unwinds the whole stack, so that partial files are removed."""


def exit_on_signal() -> None:
    """Exit at once on SIGINT and SIGTERM: for the time before and after the work, when no file is being written."""
    for number in SIGNALS:
        signal.signal(number, lambda number, _: _exit(number))


def unwinding(work: Callable[[], None]) -> None:
    """Run ``work`` so that a signal unwinds the stack before the process exits; before and after, it exits at once."""
    sys.unraisablehook = _raise_again
    try:
        for number in SIGNALS:
            signal.signal(number, _interrupt)
        try:
            work()
        finally:
            exit_on_signal()
    except BaseException as error:
        cause: BaseException | None = error
        for _ in range(100):  # a library may have raised errors of its own in between
            if isinstance(cause, Interrupted):
                _exit(cause.args[0])
            cause = cause and (cause.__cause__ or cause.__context__)
        raise


def _interrupt(number: int, frame: FrameType | None) -> NoReturn:
    raise Interrupted(number)


def _raise_again(lost: sys.UnraisableHookArgs) -> None:
    """Send a signal again that arrived inside a finalizer, where Python prints and discards exceptions."""
    if isinstance(lost.exc_value, Interrupted):
        import threading

        threading.Timer(0.01, os.kill, (os.getpid(), lost.exc_value.args[0])).start()
    else:
        sys.__unraisablehook__(lost)


def say_when_interrupted(left: Callable[[], str]) -> None:
    """Set what the message of an interruption says about files."""
    _says_what_is_left[0] = left


def _exit(number: int) -> NoReturn:
    """Print a message and exit, without waiting for threads inside libwebp, which cannot be stopped."""
    try:
        left = _says_what_is_left[0]()
        os.write(2, f"kissgs: interrupted; {left}\n".encode())  # sys.stderr may hold an incomplete line
    finally:
        os._exit(128 + number)
