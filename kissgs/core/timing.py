"""Wall time by stage, processor time and peak memory."""

from __future__ import annotations

import contextlib
import sys
import time
from dataclasses import dataclass, field
from pathlib import Path

from kissgs.core.progress import Progress


@dataclass
class StageTimer:
    """Receiver that forwards progress events and measures the time of each stage.

    Attributes:
        receiver: receiver of the events.
        seconds: wall time by stage, seconds.
        cpu_seconds: processor time of this process, seconds, up to the last :meth:`stop`.
    """

    receiver: Progress
    seconds: dict[str, float] = field(default_factory=dict)
    cpu_seconds: float = 0.0
    _stage: str | None = None
    _since: float = 0.0
    _cpu_since: float = field(default_factory=time.process_time)

    def __call__(self, stage: str, fraction: float, note: str = "") -> None:
        """Forward an event; a new stage ends the current one."""
        if stage != self._stage:
            self.stop()
            self._stage, self._since = stage, time.perf_counter()
        if note:  # without a note, receivers with two parameters work too
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
    """Return the peak resident memory of this process, bytes; 0 where the system does not report it (Windows).

    Linux lets a process begin with the peak of the one that started it in ``getrusage``, so the peak of the memory that
    it maps itself is read there.
    """
    with contextlib.suppress(OSError, StopIteration):
        status = Path("/proc/self/status").read_text().splitlines()
        return 1024 * int(next(line for line in status if line.startswith("VmHWM:")).split()[1])
    try:
        import resource
    except ImportError:
        return 0
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak if sys.platform == "darwin" else peak * 1024
