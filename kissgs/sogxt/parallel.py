"""Threads for the codec: plain ordered maps, so that results do not depend on how many threads there are."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import TypeVar

T = TypeVar("T")
R = TypeVar("R")


class Workers:
    """A thread pool for work that releases the GIL: compiled kernels, BLAS, libwebp, NumPy on large arrays."""

    def __init__(self, threads: int) -> None:
        """``threads`` below 1 means all the processors this process may use."""
        self.threads = threads if threads >= 1 else len(os.sched_getaffinity(0))
        self._pool = ThreadPoolExecutor(self.threads)

    def map(
        self, function: Callable[[T], R], items: Sequence[T], report: Callable[[float], None] = lambda fraction: None
    ) -> list[R]:
        """Apply ``function`` to every item, in parallel; the results in the order of the items.

        ``report`` is told the fraction done, in the calling thread; what it raises stops the work.
        """
        results = []
        for result in self._pool.map(function, items):
            results.append(result)
            report(len(results) / len(items))
        return results

    def __enter__(self) -> Workers:
        return self

    def __exit__(self, *reason: object) -> None:
        """Drop what has not started, without waiting for what has: a long libwebp call cannot be interrupted."""
        self._pool.shutdown(wait=False, cancel_futures=True)


@contextlib.contextmanager
def blas_workers(threads: int) -> Iterator[Workers]:
    """Workers during whose time BLAS runs single-threaded in this process.

    Each call is then one task of the pool, and its result the same whatever the number of threads.
    """
    from threadpoolctl import threadpool_limits

    with threadpool_limits(1, user_api="blas"), Workers(threads) as pool:
        yield pool
