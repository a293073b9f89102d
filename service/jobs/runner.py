"""``JobProcess``: start of a job process, its progress events, its limits and its outcome."""

from __future__ import annotations

import asyncio
import contextlib
import json
import logging
import os
import re
import signal
import sys
from collections.abc import Awaitable, Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

from .job_process import MEMORY_DETAIL

log = logging.getLogger("kissgs.service")

OnProgress = Callable[[str, float, str], Awaitable[None]]
"""Callback with a stage, its completed fraction (0 to 1), and a note, which may be empty."""

OUT_OF_MEMORY = re.compile(
    "MemoryError|bad_alloc|out of memory|memory allocation|cannot allocate memory", re.IGNORECASE
)
"""Messages of Python, C++, LLVM, OpenBLAS and the C library when an allocation fails; any of them may be the first."""

NEAR_LIMIT = 0.8
"""Share of the memory limit above which a crash without such a message is attributed to the limit."""

SAMPLE_SECONDS = 0.1
"""Seconds between samples of a process's memory."""

MAX_LINE_BYTES = 1 << 20
"""Maximum bytes of an event; the largest is the summary of a result."""


@dataclass(frozen=True, slots=True)
class Outcome:
    """How a job process ended.

    Attributes:
        kind: "done" after success; "error" after an expected error; "crashed" if the process ended otherwise;
            "stopped" after :meth:`JobProcess.kill`; "postponed" if the job cannot run at the moment.
        data: the result for "done"; ``code`` and ``detail`` of the problem for "error"; ``detail`` for "crashed".
    """

    kind: Literal["done", "error", "crashed", "stopped", "postponed"]
    data: dict[str, Any] = field(default_factory=dict)


class JobProcess:
    """One job process; call :meth:`run` once.

    Args:
        seconds: time limit.
    """

    def __init__(self, *, seconds: float) -> None:
        self._seconds = seconds
        self._process: asyncio.subprocess.Process | None = None
        self._killed = False
        self._peak_data = 0
        self.ended = asyncio.Event()

    def kill(self) -> None:
        """Kill the process now, or as soon as it has started."""
        self._killed = True
        self._kill_if_requested()

    def _kill_if_requested(self) -> None:
        if self._killed and self._process is not None and self._process.returncode is None:
            with contextlib.suppress(ProcessLookupError):
                os.killpg(self._process.pid, signal.SIGKILL)

    async def run(self, task: dict[str, Any], on_progress: OnProgress) -> Outcome:
        """Run a task (see :mod:`service.jobs.job_process`) and return its outcome.

        If the caller is cancelled, the process is killed.
        """
        try:
            return await self._run(task, on_progress)
        finally:
            self.kill()
            if self._process is not None:
                await self._process.wait()
            self.ended.set()

    async def _run(self, task: dict[str, Any], on_progress: OnProgress) -> Outcome:
        if self._killed:
            return Outcome("stopped")
        stderr_file = Path(task["work"]) / "stderr.txt"
        with stderr_file.open("wb") as errors:
            self._process = await asyncio.create_subprocess_exec(
                sys.executable,
                "-P",
                "-m",
                f"{__package__}.job_process",
                stdin=asyncio.subprocess.PIPE,
                stdout=asyncio.subprocess.PIPE,
                stderr=errors,
                cwd=task["work"],
                env=_environment(),
                start_new_session=True,
                limit=MAX_LINE_BYTES,
            )
        self._kill_if_requested()  # in case of a kill during the start
        sampling = asyncio.create_task(self._sample_memory(self._process.pid))
        try:
            async with asyncio.timeout(self._seconds):
                final = await self._follow(task, on_progress)
                status = await self._process.wait()
        except TimeoutError:
            detail = f"the job took longer than {self._seconds:g} s; choose a faster preset or fewer Gaussians"
            return Outcome("error", {"code": "time-limit", "detail": detail})
        finally:
            sampling.cancel()
        if final is not None and "done" in final:
            return Outcome("done", final["done"])
        if final is not None:
            return Outcome("error", final["error"])
        return self._explain(status, stderr_file, task["memory"])

    async def _sample_memory(self, pid: int) -> None:
        """Track the peak of the memory that the limit counts (``VmData``), unknown once the process has ended."""
        with contextlib.suppress(OSError):  # the process has ended, or this is not Linux
            while True:
                pages = int(Path(f"/proc/{pid}/statm").read_text(encoding="ascii").split()[5])
                self._peak_data = max(self._peak_data, pages * os.sysconf("SC_PAGE_SIZE"))
                await asyncio.sleep(SAMPLE_SECONDS)

    async def _follow(self, task: dict[str, Any], on_progress: OnProgress) -> dict[str, Any] | None:
        """Forward progress until the final event; return that, or None if the process ended without one."""
        process = self._process
        assert process is not None and process.stdin is not None and process.stdout is not None  # noqa: S101, PT018
        with contextlib.suppress(ConnectionError):  # it has ended already, which the missing final event shows
            process.stdin.write(json.dumps(task).encode() + b"\n")
            await process.stdin.drain()
        while line := await process.stdout.readline():
            event = json.loads(line)
            if "stage" not in event:
                return event
            await on_progress(event["stage"], event["fraction"], event["note"])
        return None

    def _explain(self, status: int, stderr_file: Path, memory: int) -> Outcome:
        if self._killed:
            return Outcome("stopped")
        stderr = stderr_file.read_text(encoding="utf-8", errors="replace")[-4000:] if stderr_file.exists() else ""
        log.error("a job's process ended with status %d\n%s", status, stderr)
        near_limit = self._peak_data >= NEAR_LIMIT * memory and status != -signal.SIGKILL
        if near_limit or OUT_OF_MEMORY.search(stderr):
            return Outcome("error", {"code": "memory-limit", "detail": MEMORY_DETAIL})
        if status < 0:
            name = signal.Signals(-status).name
            return Outcome("crashed", {"detail": f"the job's process was ended by {name}; submit the scene again"})
        detail = "the job failed because of an error in kissgs; please report it with the scene"
        return Outcome("error", {"code": "internal", "detail": detail})


def _environment() -> dict[str, str]:
    """Return this process's environment without the settings of the service and its storage, some of them secrets."""
    secret = ("KISSGS_", "AWS_")
    inherited = {name: value for name, value in os.environ.items() if not name.upper().startswith(secret)}
    return {**inherited, "OMP_WAIT_POLICY": "PASSIVE", "PYTHONUNBUFFERED": "1"}
