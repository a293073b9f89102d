"""Work in a process of its own, so that its times and its peak memory are its own, too."""

from __future__ import annotations

import contextlib
import multiprocessing
import os
import signal
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from functools import partial
from typing import TypeVar

from kissgs.core.errors import UnsupportedError

Result = TypeVar("Result")


def isolated(work: Callable[[], Result], what: str) -> Result:
    """Call ``work`` in a separate process, and return its result or raise its error.

    Args:
        work: can be pickled, and so can its result.
        what: subject of the error message, such as the path of a scene.

    Raises:
        UnsupportedError: the process was killed, most likely for lack of memory.
    """
    context = multiprocessing.get_context("spawn")
    ignore = partial(signal.signal, signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is for this process, which ends the other
    with ProcessPoolExecutor(1, mp_context=context, initializer=ignore) as pool:
        try:
            return _result(pool, work)
        except BrokenProcessPool as error:
            raise UnsupportedError(
                f"{what}: the measurement was killed, most likely for lack of memory; free some or give a smaller scene"
            ) from error


def _result(pool: ProcessPoolExecutor, work: Callable[[], Result]) -> Result:
    """Return the result of ``work``; an interrupt does not wait for its end."""
    worker = pool.submit(os.getpid).result()
    result = pool.submit(work)
    try:
        return result.result()
    finally:
        if not result.done():
            with contextlib.suppress(ProcessLookupError):
                os.kill(worker, signal.SIGTERM)
