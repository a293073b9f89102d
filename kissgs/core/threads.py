"""Thread pools with ordered maps, so that results do not depend on the number of threads."""

from __future__ import annotations

import contextlib
import os
import threading
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import TYPE_CHECKING, TypeVar

if TYPE_CHECKING:
    from threadpoolctl import threadpool_limits

T = TypeVar("T")
R = TypeVar("R")


class Workers:
    """A thread pool for work that releases the GIL: compiled kernels, BLAS, libwebp, NumPy on large arrays."""

    def __init__(self, threads: int) -> None:
        """Create the pool; ``threads`` below 1 means all processors that this process may use."""
        self.threads = threads if threads >= 1 else processors()
        self._pool = ThreadPoolExecutor(self.threads)

    def map(
        self, function: Callable[[T], R], items: Sequence[T], report: Callable[[float], None] = lambda fraction: None
    ) -> list[R]:
        """Apply ``function`` to every item, in parallel; return the results in the order of the items.

        ``report`` receives the fraction done, 0 to 1, in the calling thread; an exception from it stops the work.
        """
        results = []
        # One thread needs no pool: for many small tasks, the pool takes longer than the tasks.
        for result in map(function, items) if self.threads == 1 else self._pool.map(function, items):
            results.append(result)
            report(len(results) / len(items))
        return results

    def __enter__(self) -> Workers:
        return self

    def __exit__(self, *reason: object) -> None:
        """Drop tasks that have not started, without waiting for others: a long libwebp call cannot be interrupted."""
        self._pool.shutdown(wait=False, cancel_futures=True)


def processors() -> int:
    """Return the number of processors that this process may use, or of all where the system does not report it."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


_blas_lock = threading.Lock()
_blas_users = 0
_blas_limits: threadpool_limits | None = None


@contextlib.contextmanager
def blas_workers(threads: int) -> Iterator[Workers]:
    """Return workers while whose context is open BLAS runs single-threaded in this process.

    Each BLAS call then runs in one thread of the pool, and its result does not depend on the number of threads. Several
    contexts may be open at once: the last one to close restores BLAS's threads.
    """
    from threadpoolctl import threadpool_limits  # not needed for decoding

    global _blas_users, _blas_limits  # noqa: PLW0603  the state of BLAS is that of the process
    with _blas_lock:
        _blas_users += 1
        if _blas_limits is None:
            _blas_limits = threadpool_limits(1, user_api="blas")
    try:
        with Workers(threads) as pool:
            yield pool
    finally:
        with _blas_lock:
            _blas_users -= 1
            if _blas_users == 0 and _blas_limits is not None:
                _blas_limits.restore_original_limits()
                _blas_limits = None
