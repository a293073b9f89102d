"""Exit on Ctrl-C or SIGTERM. Imports only modules that Python has loaded already."""

from __future__ import annotations

import os
import signal

TYPE_CHECKING = False
if TYPE_CHECKING:
    from collections.abc import Callable
    from types import FrameType
    from typing import NoReturn


class Interrupted(BaseException):
    """Raised by Ctrl-C or SIGTERM: unwinds the whole stack, so that partial files are removed."""


def exit_on_signal() -> None:
    """Exit at once on SIGINT and SIGTERM: for the time before and after the work, when no file is being written."""
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda number, _: exit_by_signal(number))


def unwind_on_signal() -> None:
    """Raise :class:`Interrupted` on SIGINT and SIGTERM."""

    def interrupt(number: int, frame: FrameType | None) -> NoReturn:
        raise Interrupted(number)

    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, interrupt)


def signal_behind(error: BaseException | None) -> int | None:
    """Return the number of the signal that caused an error, also if a library has raised its own error in between."""
    for _ in range(100):
        if error is None or isinstance(error, Interrupted):
            break
        error = error.__cause__ or error.__context__
    return error.args[0] if isinstance(error, Interrupted) else None


NOTHING_LEFT = "no partial file is left"

_says_what_is_left: list[Callable[[], str]] = [lambda: NOTHING_LEFT]


def say_when_interrupted(left: Callable[[], str]) -> None:
    """Set what the message of an interruption says about files."""
    _says_what_is_left[0] = left


def exit_by_signal(number: int) -> NoReturn:
    """Print a message and exit, without waiting for threads inside libwebp, which cannot be stopped."""
    try:
        left = _says_what_is_left[0]()
        os.write(2, f"kissgs: interrupted; {left}\n".encode())  # sys.stderr may hold an incomplete line
    finally:
        os._exit(128 + number)
