"""``RayRunner``: work items on the nodes of a Ray cluster, through a driver process, which alone uses Ray. Ray ends the
process that uses it when the cluster's head is gone for a minute, replaces its signal handlers, and prints to its
standard output. Here, the loss of that process is one more outcome."""

from __future__ import annotations

import contextlib
import json
import os
import secrets
import subprocess
import sys
import tempfile
import threading
import time
from concurrent.futures import Future, wait
from dataclasses import asdict
from importlib.util import find_spec
from typing import IO, Any

from kissgs.core.context import Progress, silent
from kissgs.core.errors import RunnerError
from kissgs.runners import UNREACHABLE, Outcome, Resources, Runner, WorkItem, log, refusal_of, report
from kissgs.runners.process import child_environment, json_lines

CONNECT_SECONDS = 60.0  # maximum seconds for the connection to a cluster, or the start of one on this machine
RECONNECT_SECONDS = 5.0  # minimum seconds between two attempts to connect again
CLOSE_SECONDS = 20.0  # for the end of all items and of the driver; then it is killed, and Ray ends the items


class RayRunner(Runner):
    """Runner on a Ray cluster. ``address`` is HOST:PORT, or "auto" for that of
    ``RAY_ADDRESS`` or of a cluster on this machine, and if there is none, for a new one on this machine until the
    runner is closed. Raises RunnerError if it cannot be reached."""

    def __init__(self, address: str = "auto") -> None:
        if find_spec("ray") is None:
            raise RunnerError("Ray is not installed; install it on every machine with: pip install ray")
        self._address = address
        self._items: dict[str, tuple[Progress, Future[Outcome]]] = {}
        self._nodes: tuple[Resources, ...] = ()
        self._lock = threading.Lock()
        self._problem: str | None = "the connection to the Ray cluster is being made"
        self._last_attempt = 0.0
        self._closed = False
        self._driver: subprocess.Popen[str] | None = None
        self._connected = threading.Event()
        self._connect()
        if not self._connected.wait(CONNECT_SECONDS) or self._problem is not None:
            problem = self._problem
            self.close()
            raise RunnerError(problem or f"the Ray cluster does not answer within {CONNECT_SECONDS:g} s")

    @property
    def nodes(self) -> tuple[Resources, ...]:
        """See :class:`Runner`."""
        return self._nodes

    def submit(self, item: WorkItem, progress: Progress = silent) -> Future[Outcome]:
        """See :class:`Runner`."""
        item_id, outcome = secrets.token_hex(8), Future[Outcome]()
        with self._lock:
            if self._closed:
                raise RuntimeError("the runner is closed")
            problem = self._problem
            if problem is None:
                self._items[item_id] = progress, outcome
                self._send({"submit": item_id, "item": asdict(item)})
        if problem is not None:
            outcome.set_result(Outcome("lost", code=UNREACHABLE, message=problem))
        return outcome

    def cancel(self, outcome: Future[Outcome]) -> None:
        """See :class:`Runner`."""
        with self._lock:
            for item_id, (_, waiting) in self._items.items():
                if waiting is outcome:
                    self._send({"cancel": item_id})

    def refusal(self, resources: Resources) -> str | None:
        """See :class:`Runner`."""
        return self._problem or refusal_of(resources, self._nodes)

    def health_problem(self) -> str | None:
        """See :class:`Runner`."""
        with self._lock:
            ended = self._driver is None and not self._closed
            if ended and time.monotonic() > self._last_attempt + RECONNECT_SECONDS:
                self._connect()
            if self._closed:
                return "the runner is closed"
            if self._problem is None and not self._nodes:
                return "the Ray cluster has no node that runs work"
            return self._problem

    def close(self) -> None:
        """See :class:`Runner`."""
        with self._lock:
            self._closed = True
            driver, outcomes = self._driver, [outcome for _, outcome in self._items.values()]
            for item_id in self._items:
                self._send({"cancel": item_id})
        if driver is None or driver.stdin is None:
            return
        end = time.monotonic() + CLOSE_SECONDS
        wait(outcomes, CLOSE_SECONDS)
        with contextlib.suppress(OSError):
            driver.stdin.close()
        try:
            driver.wait(max(1.0, end - time.monotonic()))
        except subprocess.TimeoutExpired:
            driver.kill()
            driver.wait()
        self._reader.join()

    # The driver process ---------------------------------------------------------------------------------------------

    def _connect(self) -> None:
        """Start a driver process; its first event tells whether it has reached the cluster."""
        self._last_attempt = time.monotonic()
        errors = tempfile.TemporaryFile()  # noqa: SIM115  closed when the driver has ended
        self._driver = driver = subprocess.Popen(
            [sys.executable, "-P", "-m", f"{__package__}.ray_driver", self._address],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=errors,
            text=True,
            encoding="utf-8",
            env={**child_environment(), "RAY_USAGE_STATS_ENABLED": "0"},
            start_new_session=True,  # Ctrl-C is for this process
        )
        self._reader = threading.Thread(target=self._read, args=(driver, errors), daemon=True)
        self._reader.start()

    def _send(self, message: dict[str, Any]) -> None:
        if self._driver is not None and self._driver.stdin is not None:
            with contextlib.suppress(OSError, ValueError):  # it has ended, which its reader handles
                self._driver.stdin.write(json.dumps(message) + "\n")
                self._driver.stdin.flush()

    def _read(self, driver: subprocess.Popen[str], errors: IO[bytes]) -> None:
        """Handle the events of a driver process until it ends."""
        assert driver.stdout is not None  # noqa: S101
        failure = "the connection to the Ray cluster was lost"
        for event in json_lines(driver.stdout):
            if "failed" in event:
                failure = event["failed"]
            elif "nodes" in event:
                self._nodes = tuple(Resources(**node) for node in event["nodes"])
                self._problem = None
                self._connected.set()
            elif "progress" in event:
                report(self._items[event["id"]][0], *event["progress"])
            else:
                with self._lock:
                    _, outcome = self._items.pop(event["id"])
                outcome.set_result(Outcome(**event["outcome"]))
        status = driver.wait()
        with self._lock:
            self._driver, self._nodes, self._problem = None, (), failure
            items, self._items = self._items, {}
        if not self._closed and status != 0:
            errors.seek(max(0, errors.seek(0, os.SEEK_END) - 4000))
            log.debug("the Ray driver ended with status %d\n%s", status, errors.read().decode(errors="replace"))
        errors.close()
        for pipe in (driver.stdin, driver.stdout):
            with contextlib.suppress(OSError):
                if pipe is not None:
                    pipe.close()
        for _, outcome in items.values():
            outcome.set_result(Outcome("lost", code=UNREACHABLE, message=failure))
        self._connected.set()
