"""Resources of the machine: freed memory, peak memory, torch, ordered thread pools."""

from __future__ import annotations

import contextlib
import ctypes
import os
import sys
import threading
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import cache
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, TypeVar

if TYPE_CHECKING:
    from threadpoolctl import threadpool_limits


# Memory that the C library keeps after arrays are freed.
#
# All of this concerns glibc; other C libraries are left alone.

M_TRIM_THRESHOLD, M_MMAP_THRESHOLD = -1, -3
"""Options of glibc's ``mallopt``: free bytes at the end of the heap that it keeps, and size from which a block of
memory comes from the system and returns there when it is freed."""

USUAL_TRIM, USUAL_MMAP = 64 << 20, 32 << 20  # to which glibc itself goes once arrays of 32 MB have been freed
LARGEST_TRIM, LARGEST_MMAP = (1 << 31) - 1, 1 << 30  # bytes for these options with which arrays up to 1 GB are kept

_lock = threading.Lock()
_keeping = 0  # number of with blocks of keep_free_memory that are running


def return_free_memory() -> None:
    """Return what the C library has free to the system, at the end of a stage with many large temporary arrays. glibc
    keeps freed arrays of up to 32 MB for later ones, which seldom fit: without this, the free memory of one stage adds
    to the peak of the next."""
    trim = _libc_function("malloc_trim")
    if trim is not None:
        trim(0)


@contextlib.contextmanager
def keep_free_memory() -> Iterator[None]:
    """Keep the memory of freed arrays of any size for later ones within a ``with`` block; return it at the end. It is
    for long work whose steps need large arrays of about the same sizes: the system provides new memory page by page and
    filled with zeros, which may take longer than the computation. It holds for all threads of the process, until the
    last of several such blocks ends."""
    _count(1)
    try:
        yield
    finally:
        _count(-1)


def _count(change: int) -> None:
    """Count a block that begins or ends; the first and the last one change the options."""
    global _keeping
    with _lock:
        before, _keeping = _keeping, _keeping + change
        if before == 0:
            _set_thresholds(LARGEST_TRIM, LARGEST_MMAP)
        elif _keeping == 0:
            _set_thresholds(USUAL_TRIM, USUAL_MMAP)
            return_free_memory()


def _set_thresholds(trim: int, mmap: int) -> None:
    option = _libc_function("mallopt")
    if option is not None and _libc_function("gnu_get_libc_version") is not None:
        option(M_TRIM_THRESHOLD, trim)
        if option(M_MMAP_THRESHOLD, mmap) == 0:  # old versions of glibc allow 32 MB at most
            option(M_MMAP_THRESHOLD, USUAL_MMAP)


@cache
def _libc_function(name: str) -> ctypes._NamedFuncPointer | None:
    try:
        return getattr(ctypes.CDLL(None), name, None)
    except (OSError, TypeError):  # Windows
        return None


# Peak memory.


def peak_memory() -> int:
    """Return the peak resident memory of this process, bytes; 0 where the system does not report it (Windows). Linux
    lets a process begin with the peak of the one that started it in ``getrusage``, so the peak of the memory that it
    maps itself is read there."""
    with contextlib.suppress(OSError, StopIteration):
        status = Path("/proc/self/status").read_text().splitlines()
        return 1024 * int(next(line for line in status if line.startswith("VmHWM:")).split()[1])
    try:
        import resource
    except ImportError:
        return 0
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak if sys.platform == "darwin" else peak * 1024


TORCH_MISSING = "torch, which is missing: pip install torch (a CPU build is enough: docs/guide/install.md)"


def has_torch() -> bool:
    """Return whether torch is installed, which training needs."""
    return find_spec("torch") is not None


# Thread pools with ordered maps, so that results do not depend on the number of threads.

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
        """Apply ``function`` to every item, in parallel; return the results in the order of the items. ``report``
        receives the fraction done, 0 to 1, in the calling thread; an exception from it stops the work."""
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
    """Return workers while whose context is open BLAS runs single-threaded in this process. Each BLAS call then runs in
    one thread of the pool, and its result does not depend on the number of threads. Several contexts may be open at
    once: the last one to close restores BLAS's threads."""
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
