"""``ThreadRunner``: a runner whose items are threads of this process, which start at once and cost no start."""

import importlib
import json
import threading
from concurrent.futures import Future
from pathlib import Path

import kissgs
from kissgs.core.context import silent
from kissgs.runners import INTERNAL, Outcome, log, report
from kissgs.runners.item_process import throttled
from kissgs.runners.process import LocalRunner

HELD_SEED = 4_000_001
"""Seed of jobs that wait until they are cancelled."""


class ThreadRunner(LocalRunner):
    """``LocalRunner`` without processes and their limits, for jobs of a service."""

    def submit(self, item, progress=silent):
        running, outcome = _ItemThread(item), Future()
        with self._lock:
            self._items[outcome] = running

        def run():
            outcome.set_result(running.outcome(progress))
            with self._lock:
                del self._items[outcome]

        threading.Thread(target=run, daemon=True).start()
        return outcome


class _ItemThread:
    def __init__(self, item):
        self._item, self._killed = item, threading.Event()
        self._folder = f"{item.folder}/"

    def kill(self):
        self._killed.set()

    def outcome(self, progress):
        send = throttled(lambda event: report(progress, *event.values()))

        def watched(stage, fraction, note="", seconds_left=None):
            if self._killed.is_set():
                raise kissgs.Cancelled("cancelled")
            send(stage, fraction, note, seconds_left)

        try:
            if not Path(self._folder).is_dir():
                return Outcome("error", code="node-unusable", message="the folder of the work is missing")
            return Outcome("done", self._run(watched))
        except kissgs.Cancelled:
            return Outcome("cancelled")
        except kissgs.KissgsError as error:
            return Outcome("error", code=error.code, message=str(error).replace(self._folder, ""))
        except Exception:  # noqa: BLE001  a bug, as in a process
            log.exception("a job failed")
            return Outcome("error", code=INTERNAL, message="the work failed because of an error in kissgs")

    def _run(self, progress):
        arguments = json.loads(json.dumps(self._item.arguments))
        if arguments.get("settings", {}).get("encode", {}).get("seed") == HELD_SEED:
            progress("order", 0.0)
            self._killed.wait()
        for name in ("source", "work", "checkpoint", "views"):
            if arguments.get(name):
                arguments[name] = self._folder + arguments[name]
        module, _, name = self._item.function.partition(":")
        return getattr(importlib.import_module(module), name)(arguments, progress)
