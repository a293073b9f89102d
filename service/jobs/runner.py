"""Running the heavy part of a job in a process process: its events, its limits, its end."""

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

from service.jobs.job_process import MEMORY_DETAIL

log = logging.getLogger("kissgs.service")

OnProgress = Callable[[str, float, str], Awaitable[None]]
"""Told a stage, the fraction of it, and a note, which may be empty."""

OUT_OF_MEMORY = re.compile(
    "MemoryError|bad_alloc|out of memory|memory allocation|cannot allocate memory", re.IGNORECASE
)
"""Last words of Python, C++, LLVM, OpenBLAS and the C library: which of them meets the limit is chance."""

NEAR_LIMIT = 0.8
"""The share of its memory from which on a process that dies without a known word is taken to have died of the limit."""

SAMPLE_SECONDS = 0.1
"""Between two looks at a process's memory."""

MAX_LINE_BYTES = 1 << 20
"""Of one event; the largest is the summary of a result."""


@dataclass(frozen=True, slots=True)
class Outcome:
    """How a process process ended.

    Attributes:
        kind: "done" with what it found in ``data``; "error" with a problem's ``code`` and ``detail`` in ``data``;
            "crashed" if something else ended it, "stopped" if :meth:`Child.kill` did, "postponed" if it could not be
            started for now.
    """

    kind: Literal["done", "error", "crashed", "stopped", "postponed"]
    data: dict[str, Any] = field(default_factory=dict)


class JobProcess:
    """One process process, from its start to its end. Use :meth:`run` once."""

    def __init__(self, *, seconds: float) -> None:
        self._seconds = seconds
        self._process: asyncio.subprocess.Process | None = None
        self._killed = False
        self._peak_data = 0
        self.ended = asyncio.Event()

    def kill(self) -> None:
        """End it, now; before it has started, as soon as it does."""
        self._killed = True
        self._kill_if_asked()

    def _kill_if_asked(self) -> None:
        if self._killed and self._process is not None and self._process.returncode is None:
            with contextlib.suppress(ProcessLookupError):
                os.killpg(self._process.pid, signal.SIGKILL)

    async def run(self, task: dict[str, Any], on_progress: OnProgress) -> Outcome:
        """Start it with an ``order`` (see :mod:`service.jobs.job_process`), follow it, and say how it ended.

        A cancelled caller takes it along.
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
        trace = Path(task["work"]) / "stderr.txt"
        with trace.open("wb") as errors:
            self._process = await asyncio.create_subprocess_exec(
                *(sys.executable, "-P", "-m", "service.jobs.job_process"),
                stdin=asyncio.subprocess.PIPE,
                stdout=asyncio.subprocess.PIPE,
                stderr=errors,
                cwd=task["work"],
                env=_environment(),
                start_new_session=True,
                limit=MAX_LINE_BYTES,
            )
        self._kill_if_asked()  # while it was starting
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
        return self._explain(status, trace, task["memory"])

    async def _sample_memory(self, pid: int) -> None:
        """Note the most memory that the limit counts (``VmData``): a dead process cannot be asked any more."""
        with contextlib.suppress(OSError):  # it has ended, or this is no Linux
            while True:
                pages = int(Path(f"/proc/{pid}/statm").read_text(encoding="ascii").split()[5])
                self._peak_data = max(self._peak_data, pages * os.sysconf("SC_PAGE_SIZE"))
                await asyncio.sleep(SAMPLE_SECONDS)

    async def _follow(self, task: dict[str, Any], on_progress: OnProgress) -> dict[str, Any] | None:
        """Pass progress on until the last word, or until there is none."""
        process = self._process
        assert process is not None and process.stdin is not None and process.stdout is not None  # noqa: S101, PT018
        with contextlib.suppress(ConnectionError):  # it has died already: its silence says so
            process.stdin.write(json.dumps(task).encode() + b"\n")
            await process.stdin.drain()
        while line := await process.stdout.readline():
            event = json.loads(line)
            if "stage" not in event:
                return event
            await on_progress(event["stage"], event["fraction"], event["note"])
        return None

    def _explain(self, status: int, trace: Path, memory: int) -> Outcome:
        if self._killed:
            return Outcome("stopped")
        said = trace.read_text(encoding="utf-8", errors="replace")[-4000:] if trace.exists() else ""
        log.error("a job's process ended with status %d\n%s", status, said)
        near_limit = self._peak_data >= NEAR_LIMIT * memory and status != -signal.SIGKILL
        if near_limit or OUT_OF_MEMORY.search(said):
            return Outcome("error", {"code": "memory-limit", "detail": MEMORY_DETAIL})
        if status < 0:
            name = signal.Signals(-status).name
            return Outcome("crashed", {"detail": f"the job's process was ended by {name}; submit the scene again"})
        detail = "kissgs failed on this scene in a way that it should not; please report it with the scene"
        return Outcome("error", {"code": "internal", "detail": detail})


def _environment() -> dict[str, str]:
    """Ours, without the service's settings, some of which are secrets."""
    inherited = {name: value for name, value in os.environ.items() if not name.upper().startswith("KISSGS_")}
    return {**inherited, "OMP_WAIT_POLICY": "PASSIVE", "PYTHONUNBUFFERED": "1"}
