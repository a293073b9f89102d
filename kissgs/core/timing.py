"""What work takes: wall time of each stage, processor time, memory."""

from __future__ import annotations

import sys
import time
from dataclasses import dataclass, field

from kissgs.core.progress import Progress


@dataclass
class Clock:
    """Passes progress on, and takes the time of each stage on the way."""

    receiver: Progress
    seconds: dict[str, float] = field(default_factory=dict)
    cpu_seconds: float = 0.0
    _stage: str | None = None
    _since: float = 0.0
    _cpu_since: float = field(default_factory=time.process_time)

    def __call__(self, stage: str, fraction: float, note: str = "") -> None:
        """Of a stage that may be a new one."""
        if stage != self._stage:
            self.stop()
            self._stage, self._since = stage, time.perf_counter()
        if note:  # receivers that know nothing of notes can follow all else
            self.receiver(stage, fraction, note)
        else:
            self.receiver(stage, fraction)

    def stop(self) -> None:
        """End the current stage."""
        if self._stage is not None:
            spent = time.perf_counter() - self._since
            self.seconds[self._stage] = self.seconds.get(self._stage, 0.0) + spent
            self._stage = None
        self.cpu_seconds = time.process_time() - self._cpu_since


def peak_memory() -> int:
    """Bytes, the largest resident set this process has had; 0 where the system does not say (Windows)."""
    try:
        import resource
    except ImportError:
        return 0
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak if sys.platform == "darwin" else peak * 1024
