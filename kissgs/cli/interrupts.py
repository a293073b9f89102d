"""How ``kissgs`` ends on Ctrl-C or a request to end. Imports only what Python has loaded already."""

from __future__ import annotations

import os
import signal

TYPE_CHECKING = False
if TYPE_CHECKING:
    from types import FrameType
    from typing import NoReturn


class Interrupted(BaseException):
    """Ctrl-C or a request to end: unwinds everything, so that no half-written file stays."""


def leave_when_told() -> None:
    """Have requests to end take effect at once: while nothing is written yet, or any more."""
    signal.signal(signal.SIGINT, _leave)
    signal.signal(signal.SIGTERM, _leave)


def unwind_when_told() -> None:
    """Have requests to end unwind everything."""
    signal.signal(signal.SIGINT, _interrupt)
    signal.signal(signal.SIGTERM, _interrupt)


def reason_of_end(error: BaseException | None) -> int | None:
    """Number of the signal that led to an error, perhaps by way of others: some libraries raise their own instead."""
    for _ in range(100):
        if error is None or isinstance(error, Interrupted):
            break
        error = error.__cause__ or error.__context__
    return error.args[0] if isinstance(error, Interrupted) else None


def end(number: int) -> NoReturn:
    """Say so and leave, without waiting for threads inside libwebp, which cannot be stopped, and need not be."""
    try:
        os.write(2, b"kissgs: interrupted; nothing half-written is left\n")  # sys.stderr may be amid a line
    finally:
        os._exit(128 + number)


def _leave(number: int, frame: FrameType | None) -> NoReturn:
    end(number)


def _interrupt(number: int, frame: FrameType | None) -> NoReturn:
    raise Interrupted(number)
