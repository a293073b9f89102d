"""Arrays in memory that is used again: where every step of long work needs large arrays of about the same sizes.

The operating system provides memory of new large arrays page by page and filled with zeros, which may take longer than
the computation.
"""

from __future__ import annotations

import contextlib
import math
import sys
from collections.abc import Iterator
from contextvars import ContextVar

import numpy as np
from numpy.typing import DTypeLike

from kissgs.core.array_types import Shaped, UInt8

SMALLEST = 1 << 20
"""Smallest array, bytes, whose memory is kept; the allocator keeps that of smaller ones itself."""

GROWTH = 1.125
"""New blocks are larger by this factor, so that they fit arrays that are a little larger, too."""


class _Blocks:
    """Blocks of memory. One is free when no array uses it: then nothing but the list refers to it."""

    def __init__(self) -> None:
        self._blocks: list[UInt8[np.ndarray, " bytes"]] = [np.empty(0, np.uint8)]
        self._unused = sys.getrefcount(self._blocks[0])  # versions of Python count differently

    def take(self, size: int) -> UInt8[np.ndarray, " bytes"]:
        """Return ``size`` bytes that no other array uses, with any content."""
        free = [n for n in range(len(self._blocks)) if sys.getrefcount(self._blocks[n]) <= self._unused]
        fitting = [n for n in free if len(self._blocks[n]) >= size]
        if fitting:
            return self._blocks[min(fitting, key=lambda n: len(self._blocks[n]))][:size]
        if free:  # in place of the largest one that is too small, so that blocks do not accumulate
            del self._blocks[max(free, key=lambda n: len(self._blocks[n]))]
        self._blocks.append(np.empty(int(size * GROWTH), np.uint8))
        return self._blocks[-1][:size]


_current: ContextVar[_Blocks | None] = ContextVar("blocks", default=None)


@contextlib.contextmanager
def reused_memory() -> Iterator[None]:
    """Let :func:`empty` use memory again within a ``with`` block, in this thread; it is released at the end."""
    if _current.get() is not None:
        yield
        return
    token = _current.set(_Blocks())
    try:
        yield
    finally:
        _current.reset(token)


def empty(shape: int | tuple[int, ...], dtype: DTypeLike) -> Shaped[np.ndarray, "..."]:
    """Return a new array with any content, in used memory within :func:`reused_memory`.

    Raises:
        MemoryError: there is not enough memory.
    """
    blocks, kind = _current.get(), np.dtype(dtype)
    size = math.prod((shape,) if isinstance(shape, int) else shape) * kind.itemsize
    if blocks is None or size < SMALLEST:
        return np.empty(shape, kind)
    return blocks.take(size).view(kind).reshape(shape)
