"""Compilation of inner loops by numba, on import, without the GIL and without threads of their own.

Kernels have explicit signatures, so importing their module compiles them or loads them from numba's per-user cache.
Constants are literals inside the functions, because that cache does not notice a changed global.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeVar, cast

from numba import njit

Kernel = TypeVar("Kernel", bound=Callable[..., Any])


def compiled(signature: str, **options: Any) -> Callable[[Kernel], Kernel]:  # noqa: ANN401
    """Compile with numba's njit; cached if numba finds a writable folder, else compiled by every process."""

    def decorate(function: Kernel) -> Kernel:
        common = {"nogil": True, "error_model": "numpy", **options}
        try:
            return cast("Kernel", njit(signature, cache=True, **common)(function))
        except RuntimeError:
            return cast("Kernel", njit(signature, **common)(function))

    return decorate
