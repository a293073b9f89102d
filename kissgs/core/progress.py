"""How long work reports itself: one callback, used alike by the command line, the service and tests."""

from contextlib import suppress
from typing import Protocol, runtime_checkable

from kissgs.core.errors import StopSearch


@runtime_checkable
class Progress(Protocol):
    """Receives progress events.

    To stop the work, raise :class:`kissgs.Cancelled` from the call; to end a search for a goal with the best that it
    has found, :class:`kissgs.StopSearch`.
    """

    def __call__(self, stage: str, fraction: float, note: str = "", /) -> None:
        """``stage`` names what is being done ("read", "order", "codebook", …); ``fraction`` of that stage, 0 to 1.

        ``note`` is for people: what training has come to (Gaussians, loss, PSNR), and where a search for a goal stands.
        Other stages say nothing.
        """


def silent(stage: str, fraction: float, note: str = "") -> None:
    """The default receiver: ignores every event."""


def as_stage(stage: str, progress: Progress) -> Progress:
    """Passes everything on as the one stage of that name; stages of others with no fraction of it."""

    def receive(inner: str, fraction: float, note: str = "") -> None:
        progress(stage, fraction if inner == stage else 0.0)

    return receive


def until_the_end(progress: Progress) -> Progress:
    """Passes everything on to one who may have had enough: once the search is over, work is finished nevertheless."""

    def receive(stage: str, fraction: float, note: str = "") -> None:
        with suppress(StopSearch):
            progress(stage, fraction, note)

    return receive


class Annotated:
    """Passes everything on, with a word of where a search stands before the work's own.

    Attributes:
        note: that word.
    """

    def __init__(self, progress: Progress) -> None:
        self.note = ""
        self._progress = progress

    def __call__(self, stage: str, fraction: float, note: str = "") -> None:
        """See :class:`Progress`."""
        self._progress(stage, fraction, "; ".join(filter(None, [self.note, note])))
