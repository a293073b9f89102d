"""Process of one work item, ``python -m kissgs.runners.item_process``: a task from standard input, events to output.
Both are lines of JSON. When standard input closes, or whoever started it dies, it ends at once."""

from __future__ import annotations

import contextlib
import ctypes
import importlib
import json
import os
import signal
import sys
import threading
import time
import traceback
from pathlib import Path
from typing import Any

from kissgs.core.context import Progress
from kissgs.core.errors import KissgsError
from kissgs.runners import MEMORY_LIMIT, Send, event_sender

EVENT_SECONDS = 0.25  # minimum seconds between progress events of a stage

WITHOUT_MEMORY = ("can't start new thread", "error return without exception set", "failed to map")
"""Parts of messages of Python and of its loader of libraries when there is no memory."""

PR_SET_PDEATHSIG = 1  # of Linux' prctl: the signal that a process gets when its parent dies


def main() -> None:
    """Read the task, run it, and send its result or its error."""
    line = os.fdopen(0, "rb", closefd=False).readline()  # nothing follows it
    if not line.endswith(b"\n"):
        os._exit(1)
    task = json.loads(line)
    for number in (signal.SIGINT, signal.SIGTERM):  # sent to the parent, which ends this process if needed
        signal.signal(number, signal.SIG_IGN)
    if sys.platform == "linux":  # which kills it when its parent dies: a long call into a library would delay the exit
        ctypes.CDLL(None).prctl(PR_SET_PDEATHSIG, int(signal.SIGKILL), 0, 0, 0)
        if os.getppid() != task["parent"]:  # it has died before
            os._exit(1)
    threading.Thread(target=_exit_with_parent, daemon=True).start()
    send = event_sender(os.dup(1))
    os.dup2(2, 1)  # for what libraries print
    _limit_resources(task["memory_limit"])
    send({"outcome": _outcome(task, throttled(send))})
    os._exit(0)  # without waiting for threads of libraries


def _outcome(task: dict[str, Any], progress: Progress) -> dict[str, Any]:
    """Run the task; return the fields of its outcome."""
    try:
        module, _, name = task["function"].partition(":")
        function = getattr(importlib.import_module(module), name)
        result = function(task["arguments"], progress)
        json.dumps(result)  # here, where errors are reported
        return {"kind": "done", "result": result}
    except KissgsError as error:
        if not isinstance(error.__cause__, MemoryError):
            return {"kind": "error", "code": error.code, "message": str(error)}
    except MemoryError:
        pass
    except Exception as error:  # noqa: BLE001  a bug, reported by standard error and the exit status
        if not _lacks_memory(error, task["memory_limit"]):
            traceback.print_exc()
            os._exit(1)
    return {"kind": "error", "code": MEMORY_LIMIT}  # that of the limit, whatever could not be allocated


def _lacks_memory(error: Exception, limit: int | None) -> bool:
    """Whether more than half of the memory is in use, and the error is one that a lack of it causes, among others."""
    if sys.platform != "linux" or limit is None or not any(words in str(error) for words in WITHOUT_MEMORY):
        return False
    used = int(Path("/proc/self/statm").read_text(encoding="ascii").split()[5]) * os.sysconf("SC_PAGE_SIZE")
    return used > limit / 2


def throttled(send: Send) -> Progress:
    """Return a receiver that sends the start of each stage, and then at most one event per interval."""
    last, due = ("", -1.0, ""), 0.0

    def receive(stage: str, fraction: float, note: str = "", seconds_left: float | None = None) -> None:
        nonlocal last, due
        now, event = time.monotonic(), (stage, round(min(1.0, max(0.0, fraction)), 4), note)
        if event == last or (stage == last[0] and now < due):
            return
        last, due = event, now + EVENT_SECONDS
        left = None if seconds_left is None else round(seconds_left, 2)
        send({"stage": stage, "fraction": event[1], "note": note, "seconds_left": left})

    return receive


def _limit_resources(memory: int | None) -> None:
    """Lower the priority, limit memory to ``memory`` bytes, and become the first victim of the out-of-memory killer."""
    os.nice(10)
    if sys.platform == "linux":
        import resource

        if memory is not None:
            _load_numba()
            resource.setrlimit(resource.RLIMIT_DATA, (memory, memory))
        resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
        with contextlib.suppress(OSError):
            Path("/proc/self/oom_score_adj").write_text("1000", encoding="ascii")


def _load_numba() -> None:
    """Load what numba loads for its first kernel: imports that lack memory may never end."""
    sys.modules["scipy"] = None  # type: ignore[assignment]  # its BLAS, which no kernel calls, takes 50 MB
    from numba.core.registry import cpu_target

    cpu_target.typing_context.refresh()
    cpu_target.target_context.refresh()


def _exit_with_parent() -> None:
    while os.read(0, 4096):  # sys.stdin has a lock that the interpreter needs at exit
        pass
    os._exit(1)


if __name__ == "__main__":
    main()
