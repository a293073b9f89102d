"""How much memory a call takes: what it trusts of a damaged file shows there."""

import threading
import tracemalloc
from collections.abc import Callable

ATTEMPTS = 3
"""Whatever another thread of the process holds is counted, too: a test before this one may have left one at work. A
call that takes too much does so every time."""


def takes_less_than(limit: float, call: Callable[[], object]) -> bool:
    """Whether Python and NumPy hold fewer than ``limit`` bytes while ``call`` runs; it may be run several times."""
    return any(_peak(call) < limit for _ in range(ATTEMPTS))


def _peak(call: Callable[[], object]) -> int:
    tracemalloc.start()
    try:
        call()
        return tracemalloc.get_traced_memory()[1]
    finally:
        # After an error, a task that had begun may still run; stopping amid it can crash Python 3.11 (gh-128679).
        for thread in threading.enumerate():
            if thread.name.startswith("ThreadPoolExecutor"):
                thread.join()
        tracemalloc.stop()
