"""Memory that the C library keeps after arrays are freed.

All of this concerns glibc; other C libraries are left alone.
"""

from __future__ import annotations

import contextlib
import ctypes
import threading
from collections.abc import Iterator
from functools import cache

M_TRIM_THRESHOLD, M_MMAP_THRESHOLD = -1, -3
"""Options of glibc's ``mallopt``: free bytes at the end of the heap that it keeps, and size from which a block of
memory comes from the system and returns there when it is freed."""

USUAL_TRIM, USUAL_MMAP = 64 << 20, 32 << 20
"""Bytes for these options to which glibc itself goes once arrays of 32 MB have been freed."""

LARGEST_TRIM, LARGEST_MMAP = (1 << 31) - 1, 1 << 30
"""Bytes for these options with which arrays up to 1 GB are kept."""

_lock = threading.Lock()
_keeping = 0
"""Number of ``with`` blocks of :func:`keep_free_memory` that are running."""


def return_free_memory() -> None:
    """Return what the C library has free to the system, at the end of a stage with many large temporary arrays.

    glibc keeps freed arrays of up to 32 MB for later ones, which seldom fit: without this, the free memory of one stage
    adds to the peak of the next.
    """
    trim = _libc_function("malloc_trim")
    if trim is not None:
        trim(0)


@contextlib.contextmanager
def keep_free_memory() -> Iterator[None]:
    """Keep the memory of freed arrays of any size for later ones within a ``with`` block; return it at the end.

    It is for long work whose steps need large arrays of about the same sizes: the system provides new memory page by
    page and filled with zeros, which may take longer than the computation. It holds for all threads of the process,
    until the last of several such blocks ends.
    """
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
