"""``ItemProcess``: an item's process, with its limits and outcome; ``LocalRunner``: processes on this machine."""

from __future__ import annotations

import contextlib
import fcntl
import json
import math
import os
import re
import shutil
import signal
import socket
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Generator, Iterable, Iterator
from concurrent.futures import Future, wait
from pathlib import Path
from typing import IO, Any

from kissgs import runners
from kissgs.core.context import Progress, silent
from kissgs.runners import Outcome, Runner, WorkItem, log, report

PREFIX = "kissgs-item-"  # beginning of the names of temporary folders of items


@contextlib.contextmanager
def temporary_folder() -> Iterator[Path]:
    """Make an empty folder, and remove it with all that is in it; remove former ones whose makers were killed. Its
    maker has it locked as long as it lives: a folder that can be locked is left by a process that was killed."""
    place = Path(tempfile.gettempdir())
    for left in place.glob(f"{PREFIX}*"):
        with contextlib.suppress(OSError), _opened(left) as descriptor:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
            shutil.rmtree(left, ignore_errors=True)
    while True:
        folder = Path(tempfile.mkdtemp(prefix=PREFIX, dir=place))
        with contextlib.ExitStack() as stack:
            with contextlib.suppress(OSError):  # removed before it is locked; or no locks on this file system
                fcntl.flock(stack.enter_context(_opened(folder)), fcntl.LOCK_EX)
            if not folder.exists():
                continue
            try:
                yield folder
            finally:
                shutil.rmtree(folder, ignore_errors=True)
            return


@contextlib.contextmanager
def _opened(folder: Path) -> Iterator[int]:
    """Open a folder of this user that is no link."""
    descriptor = os.open(folder, os.O_RDONLY | os.O_DIRECTORY | os.O_NOFOLLOW)
    try:
        if os.fstat(descriptor).st_uid != os.geteuid():  # root may open all
            raise PermissionError(f"{folder} is another user's")
        yield descriptor
    finally:
        os.close(descriptor)


# ``ItemProcess``: start of an item's process, its progress events, its limits and its outcome.
#
# Only a process of its own can be ended at any moment, be limited in its memory, and crash alone. Ray's worker
# processes, below which it runs on a cluster, run many tasks and have no hard limit of memory.

OUT_OF_MEMORY = re.compile("MemoryError|bad_alloc|out of memory|memory allocation|cannot allocate memory", re.I)
"""Messages of Python, C++, LLVM, OpenBLAS and the C library when an allocation fails; any of them may be the first."""

NEAR_LIMIT = 0.8  # share of the memory limit above which a crash without such a message is attributed to the limit
SAMPLE_SECONDS = 0.1  # seconds between looks at a process's time and memory
LOG_BYTES = 4000  # bytes of the end of standard error that are kept


ProgressEvent = tuple[str, float, str, float | None]  # stage, fraction, note and seconds left of Progress


class ItemProcess:
    """The process of one item; use :meth:`events` once."""

    def __init__(self, item: WorkItem) -> None:
        self._item = item
        self._process: subprocess.Popen[bytes] | None = None
        self._killed = self._timed_out = False
        self._lock = threading.Lock()
        self._ended = threading.Event()
        self._peak_data = 0

    def kill(self) -> None:
        """Kill the process now, or as soon as it has started."""
        with self._lock:
            self._killed = True
            self._kill()

    def _kill(self) -> None:
        if self._process is not None and not self._ended.is_set():
            os.killpg(self._process.pid, signal.SIGKILL)

    def events(self) -> Iterator[ProgressEvent | Outcome]:
        """Run the item: yield its progress, and its outcome last, once the process has ended."""
        if self._killed:
            yield Outcome("cancelled")
            return
        with contextlib.ExitStack() as stack:
            try:
                errors = stack.enter_context(tempfile.TemporaryFile())
                folder = self._item.folder or stack.enter_context(temporary_folder())
                process = self._start(errors, folder)
            except OSError as error:
                reason, machine = (error.strerror or str(error)).lower(), socket.gethostname()
                message = f"the machine {machine} could not start a process: {reason}"
                outcome = Outcome("lost", code=runners.NOT_STARTED, message=message)
                of_folder = isinstance(error, FileNotFoundError | NotADirectoryError | PermissionError)
                if self._item.folder is not None and of_folder:
                    message = f"the machine {machine} cannot use the folder of the work: {reason}"
                    outcome = Outcome("error", code=runners.NODE_UNUSABLE, message=message, log=self._item.folder)
            else:
                status, final = yield from self._follow(process)
                outcome = self._explain(final, status, errors)
        yield outcome  # now that no file is left

    def _follow(self, process: subprocess.Popen[bytes]) -> Generator[ProgressEvent, None, tuple[int, Outcome | None]]:
        """Yield the progress of the process; return its status and its own outcome, None if it has sent none: it is
        killed then."""
        threading.Thread(target=self._watch, args=(process.pid,), daemon=True).start()
        final: Outcome | None = None
        try:
            assert process.stdout is not None  # noqa: S101
            for event in json_lines(process.stdout):
                if "outcome" in event:
                    final = Outcome(**event["outcome"])
                else:
                    yield event["stage"], event["fraction"], event["note"], event["seconds_left"]
        finally:  # also if the caller asks for no more events
            if final is None:
                with self._lock:
                    self._kill()
            if hasattr(os, "waitid"):  # not on macOS
                os.waitid(os.P_PID, process.pid, os.WEXITED | os.WNOWAIT)
            with self._lock:  # from here on, its id may be another process's
                self._ended.set()
                status = process.wait()
            for pipe in (process.stdin, process.stdout):
                assert pipe is not None  # noqa: S101
                with contextlib.suppress(BrokenPipeError):  # a task that the process has not read
                    pipe.close()
        return status, final

    def _start(self, errors: IO[bytes], folder: Path | str) -> subprocess.Popen[bytes]:
        process = subprocess.Popen(
            [sys.executable, "-P", "-m", f"{__package__}.item_process"],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=errors,
            cwd=folder,
            env=child_environment(("KISSGS_", "AWS_", "RAY_AUTH")),
            start_new_session=True,
        )
        with self._lock:
            self._process = process
            if self._killed:  # during the start
                self._kill()
        own = {name: getattr(self._item, name) for name in ("function", "arguments", "memory_limit")}
        assert process.stdin is not None  # noqa: S101
        with contextlib.suppress(BrokenPipeError):  # it has ended already, which the missing final event shows
            process.stdin.write(json.dumps({"parent": os.getpid(), **own}).encode() + b"\n")
            process.stdin.flush()
        return process

    def _watch(self, pid: int) -> None:
        """Kill the process at its time limit, and track the peak of the memory that the limit counts (``VmData``)."""
        end = time.monotonic() + (math.inf if self._item.seconds is None else self._item.seconds)
        while not self._ended.wait(SAMPLE_SECONDS):
            if time.monotonic() > end:
                with self._lock:
                    self._timed_out = True
                    self._kill()
            with contextlib.suppress(OSError):  # the process has ended, or this is not Linux
                pages = int(Path(f"/proc/{pid}/statm").read_text(encoding="ascii").split()[5])
                self._peak_data = max(self._peak_data, pages * os.sysconf("SC_PAGE_SIZE"))

    def _explain(self, final: Outcome | None, status: int, errors: IO[bytes]) -> Outcome:
        if final is not None and final.code != runners.MEMORY_LIMIT:
            return final
        if self._killed:
            return Outcome("cancelled")
        if self._timed_out:
            message = f"the work took longer than its limit of {self._item.seconds:g} s"
            return Outcome("error", code=runners.TIME_LIMIT, message=message)
        errors.seek(max(0, errors.seek(0, os.SEEK_END) - LOG_BYTES))
        text = errors.read().decode(errors="replace")
        limit = self._item.memory_limit
        near_limit = limit is not None and self._peak_data >= NEAR_LIMIT * limit and status != -signal.SIGKILL
        if final is not None or near_limit or OUT_OF_MEMORY.search(text):
            of = "" if limit is None else f" than its limit of {limit / 1e9:.2g} GB"
            return Outcome("error", code=runners.MEMORY_LIMIT, message=f"the work needs more memory{of}", log=text)
        if status < 0:
            name = signal.Signals(-status).name
            return Outcome("crashed", code=runners.CRASHED, message=f"the process was ended by {name}", log=text)
        message = "the work failed because of an error in kissgs; please report it"
        return Outcome("error", code=runners.INTERNAL, message=message, log=text)


def json_lines(lines: Iterable[str | bytes]) -> Iterator[dict[str, Any]]:
    """Yield the events that a process writes, until it ends; a line that it was killed in is none."""
    for line in lines:
        try:
            event = json.loads(line)
        except ValueError:
            return
        yield event


def child_environment(secret: tuple[str, ...] = ("KISSGS_", "AWS_")) -> dict[str, str]:
    """Return this process's environment without variables whose names begin so. By default, these are the settings of a
    service and the credentials of a cloud."""
    inherited = {name: value for name, value in os.environ.items() if not name.upper().startswith(secret)}
    libraries = {"OMP_WAIT_POLICY": "PASSIVE", "OPENBLAS_NUM_THREADS": "1"}  # its buffers count as memory
    return {**inherited, **libraries, "PYTHONUNBUFFERED": "1"}


# ``LocalRunner``: work items as processes on this machine, which start at once: the caller limits their number.


class LocalRunner(Runner):
    """Runner on this machine."""

    def __init__(self) -> None:
        self._items: dict[Future[Outcome], ItemProcess] = {}
        self._closed = False
        self._lock = threading.Lock()

    def submit(self, item: WorkItem, progress: Progress = silent) -> Future[Outcome]:
        """See :class:`Runner`."""
        process, outcome = ItemProcess(item), Future[Outcome]()
        with self._lock:
            if self._closed:
                raise RuntimeError("the runner is closed")
            self._items[outcome] = process

        def run() -> None:
            result = Outcome("cancelled")
            try:
                for event in process.events():
                    if isinstance(event, Outcome):
                        result = event
                    else:
                        report(progress, *event)
            except Exception as error:  # noqa: BLE001  a bug, of which whoever waits must hear
                log.exception("an item could not be followed", exc_info=error)
                message = "the work could not be followed; please report it"
                result = Outcome("error", code=runners.INTERNAL, message=message)
            outcome.set_result(result)
            with self._lock:
                del self._items[outcome]

        threading.Thread(target=run, daemon=True).start()
        return outcome

    def cancel(self, outcome: Future[Outcome]) -> None:
        """See :class:`Runner`."""
        with self._lock:
            if outcome in self._items:
                self._items[outcome].kill()

    def health_problem(self) -> str | None:
        """See :class:`Runner`."""
        return "the runner is closed" if self._closed else None

    def close(self) -> None:
        """See :class:`Runner`."""
        with self._lock:
            self._closed = True
            items = dict(self._items)
        for process in items.values():
            process.kill()
        wait(items)
