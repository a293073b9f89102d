"""How inner loops are compiled: numba, ahead of the first call, holding no GIL and starting no threads.

Kernels have explicit signatures, so importing their module compiles them or loads them from the cache that numba keeps
per user. Constants are literals inside the functions, because that cache would not notice a changed global.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeVar, cast

from numba import njit

Kernel = TypeVar("Kernel", bound=Callable[..., Any])


def compiled(signature: str, **options: Any) -> Callable[[Kernel], Kernel]:  # noqa: ANN401
    """numba's njit, cached where numba finds a folder that it may write, else compiled anew by every process."""

    def decorate(function: Kernel) -> Kernel:
        common = {"nogil": True, "error_model": "numpy", **options}
        try:
            return cast("Kernel", njit(signature, cache=True, **common)(function))
        except RuntimeError:
            return cast("Kernel", njit(signature, **common)(function))

    return decorate
