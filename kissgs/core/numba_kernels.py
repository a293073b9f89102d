"""Compilation of inner loops by numba, on import, without the GIL and without threads of their own.

Kernels have explicit signatures, so importing their module compiles them or loads them from numba's per-user cache.
Constants are literals inside the functions, because that cache does not notice a changed global.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator
from typing import Any, TypeVar, cast

from numba import njit
from numba.core.event import Event, Listener, install_listener

Kernel = TypeVar("Kernel", bound=Callable[..., Any])

_uncached: list[str] = []
"""Names of kernels for which numba found no folder to cache them in."""


def compiled(signature: str, **options: Any) -> Callable[[Kernel], Kernel]:  # noqa: ANN401
    """Compile with numba's njit; cached if numba finds a writable folder, else compiled by every process."""

    def decorate(function: Kernel) -> Kernel:
        common = {"nogil": True, "error_model": "numpy", **options}
        try:
            return cast("Kernel", njit(signature, cache=True, **common)(function))
        except RuntimeError:
            _uncached.append(function.__name__)
            return cast("Kernel", njit(signature, **common)(function))

    return decorate


@contextlib.contextmanager
def report_compilation(report: Callable[[str], object]) -> Iterator[None]:
    """Report, once, that kernels are compiled; nothing is reported if all are loaded from the cache."""
    with install_listener("numba:compile", _Reporter(report)):
        yield


class _Reporter(Listener):
    """Receives an event for each kernel that is compiled, and none for one that is loaded."""

    def __init__(self, report: Callable[[str], object]) -> None:
        self._report: Callable[[str], object] | None = report

    def on_start(self, event: Event) -> None:
        report, self._report = self._report, None
        if report is not None:
            when = "at every start, unless NUMBA_CACHE_DIR names a folder" if _uncached else "once; cached from then on"
            report(f"compiling kernels ({when}) …")

    def on_end(self, event: Event) -> None:
        pass
