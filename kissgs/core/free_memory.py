"""Memory that the C library keeps after arrays are freed."""

from __future__ import annotations

import ctypes
from functools import cache


def return_free_memory() -> None:
    """Return what the C library has free to the system, at the end of a stage with many large temporary arrays.

    glibc keeps freed arrays of up to 32 MB for later ones, which seldom fit: without this, the free memory of one stage
    adds to the peak of the next. Other C libraries are left alone.
    """
    trim = _malloc_trim()
    if trim is not None:
        trim(0)


@cache
def _malloc_trim() -> ctypes._NamedFuncPointer | None:
    try:
        return ctypes.CDLL(None).malloc_trim
    except (AttributeError, OSError, TypeError):  # no glibc; Windows
        return None
