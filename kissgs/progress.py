"""How long work reports itself: one callback, used alike by the command line, the service and tests."""

from typing import Protocol, runtime_checkable


@runtime_checkable
class Progress(Protocol):
    """Receives progress events. To stop the work, raise :class:`kissgs.Cancelled` from the call."""

    def __call__(self, stage: str, fraction: float, note: str = "", /) -> None:
        """``stage`` names what is being done ("read", "order", "codebook", …); ``fraction`` of that stage, 0 to 1.

        ``note`` is for people: what training has come to (Gaussians, loss, PSNR). Other stages say nothing.
        """


def silent(stage: str, fraction: float, note: str = "") -> None:
    """The default receiver: ignores every event."""


def as_stage(stage: str, progress: Progress) -> Progress:
    """Passes everything on as the one stage of that name; stages of others with no fraction of it."""

    def receive(inner: str, fraction: float, note: str = "") -> None:
        progress(stage, fraction if inner == stage else 0.0)

    return receive
