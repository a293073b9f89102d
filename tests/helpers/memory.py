"""Memory use of a call, which reveals unchecked counts from damaged files."""

import threading
import tracemalloc
from collections.abc import Callable

ATTEMPTS = 3
"""Number of attempts: memory of other threads counts, too, such as those of an earlier test, but a call that needs too
much memory does so every time."""


def takes_less_than(limit: float, call: Callable[[], object]) -> bool:
    """Whether Python and NumPy hold fewer than ``limit`` bytes while ``call`` runs; it may be run several times."""
    return any(_peak(call) < limit for _ in range(ATTEMPTS))


def _peak(call: Callable[[], object]) -> int:
    tracemalloc.start()
    try:
        call()
        return tracemalloc.get_traced_memory()[1]
    finally:
        # Tasks may still run after an error, and tracemalloc.stop() during one can crash Python 3.11 (gh-128679).
        for thread in threading.enumerate():
            if thread.name.startswith("ThreadPoolExecutor"):
                thread.join()
        tracemalloc.stop()
