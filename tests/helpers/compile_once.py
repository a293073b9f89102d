"""Kernels and modules that several processes of tests need at the same time are compiled by one of them, for all."""

import contextlib
import fcntl

from numba.core.dispatcher import Dispatcher


@contextlib.contextmanager
def alone(folder, name):
    """Hold the lock of this name, for which ``folder`` has a file, while no other process does."""
    with (folder / name).open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        yield


def compile_once(folder):
    """Let numba compile a kernel while no other process compiles the same one, and then find it in its cache.

    ``folder`` is for files of locks. Kernels call others in no circle, so that no two processes wait for each other.
    """
    compile_alone = Dispatcher.compile

    def compile(self, signature):
        kernel = self.py_func
        if not kernel.__module__.startswith("kissgs."):
            return compile_alone(self, signature)
        with alone(folder, f"{kernel.__module__}.{kernel.__qualname__}"):
            return compile_alone(self, signature)

    Dispatcher.compile = compile
