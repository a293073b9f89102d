"""How long work reports itself: one callback, used alike by the command line, the service and tests."""

from typing import Protocol, runtime_checkable


@runtime_checkable
class Progress(Protocol):
    """Receives progress events. To stop the work, raise :class:`kissgs.Cancelled` from the call."""

    def __call__(self, stage: str, fraction: float) -> None:
        """``stage`` names what is being done ("read", "order", "codebook", …); ``fraction`` of that stage, 0 to 1."""


def silent(stage: str, fraction: float) -> None:
    """The default receiver: ignores every event."""
