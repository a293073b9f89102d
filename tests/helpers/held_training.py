"""Training that waits at a checkpoint until it is interrupted, so that no test depends on how fast it trains."""

import time

PROGRAM = """
import os
import time
from pathlib import Path

from kissgs.core.context import JobProgress
from kissgs.training.checkpoint import Checkpoint

folder, saved, save = Path({folder!r}), [], Checkpoint.save


def save_and_wait(self, state):
    save(self, state)
    saved.append(len(saved))
    (folder / f"saves-{{os.getpid()}}").write_text(str(len(saved)))
    while len(saved) == {saves} and (folder / "hold").exists():
        (folder / "waiting").touch()
        time.sleep(0.01)


Checkpoint.save = save_and_wait
JobProgress.__call__ = lambda job, stage, fraction, note="": job._receive(stage, fraction, note, None)  # of the stage
Checkpoint.due = property(lambda self: True)  # after every step
"""


class HeldTraining:
    """Training that saves a checkpoint after every step, and waits after one; its process runs ``program`` first."""

    def __init__(self, folder, saves):
        """Let it wait after so many ``saves``; ``folder`` belongs to it."""
        self._folder = folder
        (folder / "hold").touch()
        self.program = PROGRAM.format(folder=str(folder), saves=saves)

    def wait(self, seconds=300):
        """Wait until training waits."""
        end = time.monotonic() + seconds
        while not (self._folder / "waiting").exists():
            assert time.monotonic() < end, "training has not come so far"
            time.sleep(0.02)

    @property
    def saves_by_process(self):
        """Number of checkpoints saved by each process, in the order of their last ones."""
        files = sorted(self._folder.glob("saves-*"), key=lambda path: path.stat().st_mtime_ns)
        return [int(path.read_text()) for path in files]

    def release(self):
        """Let training run to its end, in its process or in the next one."""
        (self._folder / "hold").unlink()
