"""Processor time and peak memory of each stage, from its progress events."""

from __future__ import annotations

import time
from dataclasses import dataclass, field

from kissgs.core.progress import Progress
from kissgs.core.timing import peak_memory, reset_peak_memory


@dataclass
class StageResources:
    """Receiver that forwards progress events and measures each stage.

    The peak memory of this process begins anew with every stage, where the system can do that (Linux); elsewhere the
    peak of a stage includes those of the stages before it.

    Attributes:
        receiver: receiver of the events.
        cpu_seconds: processor time of this process by stage, all threads, seconds.
        peak_memory: largest resident set of this process by stage, bytes.
    """

    receiver: Progress
    cpu_seconds: dict[str, float] = field(default_factory=dict)
    peak_memory: dict[str, int] = field(default_factory=dict)
    _stage: str | None = None
    _since: float = 0.0

    def __call__(self, stage: str, fraction: float, note: str = "") -> None:
        """Forward an event; a new stage ends the current one."""
        if stage != self._stage:
            self.start(stage)
        if note:
            self.receiver(stage, fraction, note)
        else:
            self.receiver(stage, fraction)

    def start(self, stage: str) -> None:
        """Begin a stage, and end the current one."""
        self.stop()
        reset_peak_memory()
        self._stage, self._since = stage, time.process_time()

    def stop(self) -> None:
        """End the current stage."""
        stage, self._stage = self._stage, None
        if stage is not None:
            spent = time.process_time() - self._since
            self.cpu_seconds[stage] = self.cpu_seconds.get(stage, 0.0) + spent
            self.peak_memory[stage] = max(self.peak_memory.get(stage, 0), peak_memory())
