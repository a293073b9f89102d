"""Compilation of inner loops by numba, at their first call, without the GIL and without threads of their own. Each
kernel has one signature, so that its bits do not depend on who calls it first; the first call compiles it or loads it
from numba's per-user cache. Constants are literals inside the functions, as that cache does not see changed globals."""

from __future__ import annotations

import contextlib
import pickle
import threading
from collections.abc import Callable, Iterator
from typing import Any, TypeVar, cast

from numba import njit
from numba.core.event import Event, Listener, install_listener
from numba.core.typing.templates import Signature

Kernel = TypeVar("Kernel", bound=Callable[..., Any])

kernels: list[Any] = []  # of all modules that are imported; the method load compiles one without a call

UNREADABLE = (ImportError, AttributeError, EOFError, LookupError, TypeError, ValueError, pickle.UnpicklingError)
"""Errors of reading a cache that is damaged, or that another version left and that names modules which are gone."""

_compiling = threading.RLock()
_uncached: list[str] = []  # names of kernels for which numba found no folder to cache them in


def compiled(signature: str | Signature, **options: Any) -> Callable[[Kernel], Kernel]:  # noqa: ANN401
    """Compile with numba's njit at the first call; cached if numba finds a writable folder, else once per process."""

    def decorate(function: Kernel) -> Kernel:
        common = {"nogil": True, "error_model": "numpy", **options}
        try:
            kernel = njit(cache=True, **common)(function)
        except RuntimeError:
            _uncached.append(function.__name__)
            kernel = njit(**common)(function)
        _defer(kernel, signature)
        kernels.append(kernel)
        return cast("Kernel", kernel)

    return decorate


def _defer(kernel: Any, signature: str | Signature) -> None:  # noqa: ANN401
    """Let a kernel compile its signature, and no other, when Python or another kernel calls it first."""
    template = kernel.get_call_template

    def compile_signature() -> Any:  # noqa: ANN401
        with _compiling:
            if not kernel.signatures:
                _load_called(kernel)
                try:
                    kernel.compile(signature)
                except UNREADABLE:
                    with contextlib.suppress(OSError):
                        kernel._cache.flush()
                    kernel.compile(signature)
                kernel.disable_compile()
            return next(iter(kernel.overloads.values()))

    def called_by_python(*arguments: Any) -> Any:  # noqa: ANN401
        overload = compile_signature()
        given = [kernel.typeof_pyval(argument) for argument in arguments]
        wanted = overload.signature.args
        if len(given) != len(wanted) or None in map(kernel.typingctx.can_convert, given, wanted):
            raise TypeError(f"{kernel.__name__} takes {wanted}, not {given}")
        return overload.entry_point

    def called_by_kernel(args: Any, kws: Any) -> Any:  # noqa: ANN401
        compile_signature()
        return template(args, kws)

    # numba asks these two when it finds no compiled version of a kernel.
    kernel._compile_for_args, kernel.get_call_template = called_by_python, called_by_kernel
    kernel.load = compile_signature


def _load_called(kernel: Any) -> None:  # noqa: ANN401
    """Load the kernels that a kernel calls, as compiling it does but loading it from the cache does not. Its code holds
    copies of theirs, rounded in another way where fastmath lets LLVM choose; whichever is loaded first is used, so that
    results would depend on whether this process or an earlier one compiled the kernel."""
    for name in kernel.py_func.__code__.co_names:
        called = kernel.py_func.__globals__.get(name)
        if any(called is other for other in kernels):
            if called is not kernel:
                called.load()
        elif hasattr(called, "py_func"):  # compiled into each of its callers
            _load_called(called)


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
