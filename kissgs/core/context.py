"""``Context`` of long work: its threads and device, the receiver of its progress events, and its deadline; thread pools
with ordered maps, and what the machine has: processors, memory, torch."""

from __future__ import annotations

import ctypes
import inspect
import os
import sys
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager, nullcontext, suppress
from dataclasses import dataclass, replace
from functools import cache
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, Protocol, TypeVar, runtime_checkable

from kissgs.core.errors import Cancelled, StopSearch

if TYPE_CHECKING:
    from threadpoolctl import threadpool_limits

# Progress events of long work: one callback for the command line, the service and tests.


@runtime_checkable
class Progress(Protocol):
    """Receives progress events.

    A receiver with a parameter ``seconds_left`` also gets the seconds that the call is expected to take from now on,
    None while they are unknown. To stop the work, raise :class:`kissgs.Cancelled` from the call; to end a search for a
    goal with the best result so far, raise :class:`kissgs.StopSearch`.
    """

    def __call__(self, stage: str, fraction: float, note: str = "", /) -> None:
        """Receive an event.

        Args:
            stage: name of the current stage ("read", "order", "codebook", …).
            fraction: fraction of the whole call that is done, 0 to 1; it never falls. It is 1 in the last event only,
                when the work is done and :class:`kissgs.Cancelled` may have no effect any more.
            note: text for the user: the state of training (Gaussians, loss, PSNR) and of a search for a goal; empty in
                other stages.
        """


def silent(stage: str, fraction: float, note: str = "") -> None:
    """Ignore every event; the default receiver."""


# ``JobProgress``: one fraction of a job that never falls, and the seconds left, from the progress of its stages.

Step = tuple[str, float]  # an expected stage, and the seconds that it takes on some machine
LOADING = "kernels"  # the stage that takes time only when it comes first, also after its last event
PRIOR = 0.1  # share of all work after which what is measured counts as much as what is expected
OVERDUE = 0.25  # expected rest of a stage that takes longer than expected, in units of the time it has taken
PAST_DEADLINE = 0.05  # the same of a job
ROOM = 0.01  # least share of the job that its end, and each stage that has not begun yet, is expected to take
LEAST_SECONDS = 0.01  # left before the end


class JobProgress:
    """Receiver of the stages of a job, with the fraction of each. It passes on the fraction of the whole job and the
    seconds left, and keeps the times of all stages.

    The seconds left are those of the expected steps, corrected by the speed so far, and by the pace of the current one.
    Steps that are left out are skipped, and a stage that comes again without being expected, or before others that have
    not come at all, repeats the steps since it came last. The fraction gains its share of what is left: if that is more
    than expected, it slows down. It is below 1 until :meth:`stop`, as a search may go on after all expected steps."""

    def __init__(self, receiver: Progress, steps: Sequence[Step] = ()) -> None:
        """Begin a job; see :meth:`expect` for ``steps``."""
        self.seconds: dict[str, float] = {}  # wall time of each stage
        self.cpu_seconds = 0.0  # processor time of this process up to the last :meth:`stop`
        self.fraction = 0.0  # of the job that is done
        self.seconds_left: float | None = None  # expected from the latest event to the end; None without steps
        self.note = ""  # the state of a search, before the notes of the events
        self.stops_search = True  # whether StopSearch of the receiver has an effect: the search is not over
        self._call, self._cpu_began = with_seconds_left(receiver), time.process_time()
        self._began = self._latest = self._stage_began = time.perf_counter()
        self._stage: str | None = None
        self._factor: dict[str, float] = {}  # by stage, of its seconds to those expected, the last time
        self._steps, self._at, self._step_fraction = list[Step](), -1, 0.0
        self._deadline: Deadline | None = None
        self._expected = self._measured = 0.0  # seconds of the steps so far
        self.expect(steps)

    def expect(self, steps: Sequence[Step], deadline: Deadline | None = None) -> None:
        """Set the steps from here on, between two stages. Stages that are not among them count as parts of the current
        step. A job with a ``deadline`` is expected to end then if it has steps enough."""
        self._end_step(time.perf_counter())
        self._steps, self._at, self._deadline = list(steps), -1, deadline or self._deadline
        self._prior = PRIOR * (self._expected + sum(seconds for _, seconds in steps))

    def __call__(self, stage: str, fraction: float, note: str = "") -> None:
        """Receive the ``fraction`` of a stage; a new stage ends the current one."""
        now, fraction = time.perf_counter(), min(max(float(fraction), 0.0), 1.0)
        if stage != self._stage or self._at < 0:
            self._end_stage(now)
            self._stage = stage
            self._enter(stage, fraction, now)
        if self._at >= 0 and stage == self._steps[self._at][0] != LOADING:
            self._step_fraction = max(self._step_fraction, fraction)
        if self._steps or self.seconds_left is not None:
            # Stages that have not begun get room: kernels compiled before them, which nobody expects, may take long.
            room, since = ROOM * (1 + len(self._new(self._steps[self._at + 1 :]))), self._latest
            self.seconds_left = max(self._left(now), room * (now - self._began), LEAST_SECONDS)
            gained = (1 - self.fraction) * (now - since) / (now - since + self.seconds_left)
            self.fraction = max(self.fraction, min(self.fraction + gained, 1 - room))
            self._latest = now
        self._receive(stage, self.fraction, note, self.seconds_left)

    def stop(self) -> None:
        """End the job, whose last event has fraction 1: the work is done, and cannot be cancelled any more."""
        self._end_stage(time.perf_counter())
        self.cpu_seconds = time.process_time() - self._cpu_began
        if self._stage is not None:
            self.fraction, self.seconds_left = 1.0, 0.0
            with suppress(Cancelled):
                self._receive(self._stage, 1.0, "", 0.0)

    def _receive(self, stage: str, fraction: float, note: str, seconds_left: float | None) -> None:
        with nullcontext() if self.stops_search else suppress(StopSearch):
            self._call(stage, fraction, "; ".join(filter(None, [self.note, note])), seconds_left)

    def _end_stage(self, now: float) -> None:
        if self._stage is not None:
            self.seconds[self._stage] = self.seconds.get(self._stage, 0.0) + now - self._stage_began
        self._stage_began = now

    def _enter(self, stage: str, fraction: float, now: float) -> None:
        """Go to the next step of this stage, if it is one."""
        known = [at for at, (name, _) in enumerate(self._steps) if name == stage]
        came, following = [at for at in known if at <= self._at], [at for at in known if at > self._at]
        if not known or (stage == LOADING and not following):
            return
        self._end_step(now)
        if came and (not following or self._new(self._steps[self._at + 1 : following[0]])):
            self._steps[self._at + 1 :] = self._steps[came[-1] :]
            following = [self._at + 1]
        self._at = following[0]
        self._step_began, self._step_first, self._step_fraction = now, fraction, fraction

    def _end_step(self, now: float) -> None:
        if self._at >= 0:
            name, seconds = self._steps[self._at]
            end = self._latest if self._step_fraction == 1 else now  # loading the next stage may take longer
            spent, seconds = end - self._step_began, max(seconds * (1 - self._step_first), 1e-3)
            if self._step_first < 1:  # else nothing of it was seen
                self._factor[name] = spent / seconds
            if name != LOADING:  # which says little about the speed of other stages
                self._expected, self._measured = self._expected + seconds, self._measured + spent

    def _new(self, steps: Sequence[Step]) -> set[str]:
        """Return the stages of these steps that have not come yet."""
        return {name for name, _ in steps} - {name for name, _ in self._steps[: self._at + 1]} - {*self.seconds}

    def _slower(self, measured: float, expected: float) -> float:
        """Return the factor on the seconds of steps to come, after ``measured`` ones instead of ``expected``."""
        if min(measured, expected) <= 0:
            return 1.0
        return float((measured / expected) ** (expected / (expected + self._prior)))

    def _left(self, now: float) -> float:
        """Return the expected seconds left: the rest of the current step, and those to come."""
        rest, measured, expected = 0.0, self._measured, self._expected
        if self._at >= 0 and self._step_fraction < 1:
            name, seconds = self._steps[self._at]
            spent, done = now - self._step_began, self._step_fraction - self._step_first
            usual = seconds * self._factor.get(name, self._slower(measured, expected))
            rest = max(usual * (1 - self._step_first) - spent, OVERDUE * spent * (name != LOADING))
            if done > 0:
                by_pace, trust = spent * (1 - self._step_fraction) / done, 1 - (1 - done) ** 2
                rest = trust * by_pace + (1 - trust) * (1 - self._step_fraction) * max(usual, spent)
            measured, expected = measured + spent, expected + seconds * spent / max(spent + rest, 1e-9)
        slower = self._slower(measured, expected)
        left = rest + sum(seconds * self._factor.get(name, slower) for name, seconds in self._steps[self._at + 1 :])
        if self._deadline is None:
            return left
        return min(left, max(self._deadline.seconds, PAST_DEADLINE * (now - self._began)))


def with_seconds_left(progress: Progress) -> Callable[[str, float, str, float | None], None]:
    """Return a receiver of stage, fraction, note and seconds left for one that may do without the last."""
    call: Any = progress
    takes_seconds = False
    with suppress(ValueError):  # some callables of C extensions have no signature
        parameter = inspect.signature(progress).parameters.get("seconds_left")
        takes_seconds = parameter is not None and parameter.kind is not parameter.POSITIONAL_ONLY

    def receive(stage: str, fraction: float, note: str, seconds_left: float | None) -> None:
        values = (stage, fraction, note) if note else (stage, fraction)  # receivers with two parameters work too
        if takes_seconds:
            call(*values, seconds_left=seconds_left)
        else:
            call(*values)

    return receive


# ``Deadline``: the time until which work shall be finished, and ``Pace``: the steps that fit in until then.

SETTLING_STEPS = 3  # steps that Pace leaves out of its mean: they load or compile what all others share


@dataclass(frozen=True, slots=True)
class Deadline:
    """Time until which work shall be finished."""

    end: float  # on the clock of :func:`time.perf_counter`, seconds

    @classmethod
    def after(cls, seconds: float) -> Deadline:
        """Return the deadline that is ``seconds`` from now."""
        return cls(time.perf_counter() + seconds)

    @property
    def seconds(self) -> float:
        """Seconds that are left; below 0 once they are over."""
        return self.end - time.perf_counter()

    def earlier(self, seconds: float) -> Deadline:
        """Return the deadline that is ``seconds`` before this one."""
        return Deadline(self.end - seconds)


class Pace:
    """Number of steps of equal work: as many as requested, or fewer if that many do not fit in before a deadline."""

    def __init__(self, steps: int, deadline: Deadline | None = None) -> None:
        """Prepare for ``steps`` steps, of which as many are made as ``deadline`` allows."""
        self.steps = steps
        """The number of all steps, as far as is known now."""
        self._requested, self._deadline = steps, deadline
        self._settled: tuple[int, float] | None = None

    def update(self, done: int) -> None:
        """Set :attr:`steps` after ``done`` of them, from the time that they have taken."""
        if self._deadline is None:
            return
        now = time.perf_counter()
        if self._settled is None and done >= SETTLING_STEPS:
            self._settled = done, now
        left, per_step = self._deadline.end - now, 0.0
        if self._settled is not None and done > self._settled[0]:
            per_step = (now - self._settled[1]) / (done - self._settled[0])
        fitting = max(left, 0.0) / per_step if per_step > 0 else (0.0 if left <= 0 else self._requested)
        self.steps = min(done + int(min(fitting, self._requested)), self._requested)


# ``Context``: what all functions of long work receive.

Device = Literal["cpu", "cuda"]  # device of training and of the rasteriser for images


@dataclass(frozen=True, slots=True)
class Context:
    """Threads, device, receiver of progress events and deadline of some work."""

    threads: int = 0  # 0 means one per processor; no result depends on it
    device: Device = "cpu"
    progress: Progress = silent
    deadline: Deadline | None = None  # until then training makes as many steps as fit in; None for all steps

    def stage(self, name: str) -> Context:
        """Return the context for a part of stage ``name``; other stages in it count as fraction 0."""

        def receive(stage: str, fraction: float, note: str = "") -> None:
            self.progress(name, fraction if stage == name else 0.0)

        return replace(self, progress=receive)


DEFAULT_CONTEXT = Context()


def load_kernels(progress: Progress = silent) -> None:
    """Load numba; ``progress`` receives the stage "kernels", during which and after which kernels may be compiled."""
    progress("kernels", 0.0)
    from kissgs.core import numba_kernels  # noqa: F401

    progress("kernels", 1.0)


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


@contextmanager
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


@contextmanager
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
    with suppress(OSError, StopIteration):
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
