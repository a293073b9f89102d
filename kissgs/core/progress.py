"""Progress events of long work: one callback for the command line, the service and tests."""

from contextlib import suppress
from typing import Protocol, runtime_checkable

from kissgs.core.errors import StopSearch


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


def as_stage(stage: str, progress: Progress) -> Progress:
    """Return a receiver that reports all events as ``stage``; inner stages of other names count as fraction 0."""

    def receive(inner: str, fraction: float, note: str = "") -> None:
        progress(stage, fraction if inner == stage else 0.0)

    return receive


def ignore_stop_search(progress: Progress) -> Progress:
    """Return a receiver that ignores :class:`StopSearch`: once the search is over, the work is completed."""

    def receive(stage: str, fraction: float, note: str = "") -> None:
        with suppress(StopSearch):
            progress(stage, fraction, note)

    return receive


class SearchNote:
    """Receiver that puts the state of a search before the notes of the events.

    Attributes:
        note: state of the search; changed by it.
    """

    def __init__(self, progress: Progress) -> None:
        self.note = ""
        self._progress = progress

    def __call__(self, stage: str, fraction: float, note: str = "") -> None:
        """See :class:`Progress`."""
        self._progress(stage, fraction, "; ".join(filter(None, [self.note, note])))
