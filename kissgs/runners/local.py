"""``LocalRunner``: work items as processes on this machine, as many at a time as their requests allow."""

from __future__ import annotations

import os
import secrets
import threading
from concurrent.futures import Future
from dataclasses import dataclass

from kissgs.core.progress import Progress, silent
from kissgs.runners.contract import (
    INTERNAL,
    NodeResources,
    Outcome,
    Resources,
    RunHandle,
    RunnerStats,
    WorkItem,
    log,
    refusal_of,
    report,
)
from kissgs.runners.process import ItemProcess


@dataclass(slots=True)
class _Submitted:
    item: WorkItem
    progress: Progress
    outcome: Future[Outcome]
    process: ItemProcess
    started: bool = False


class LocalRunner:
    """Runner on this machine, see :class:`kissgs.runners.Runner`.

    Args:
        total: resources that its items share; by default the processors of this process and the machine's memory.
    """

    def __init__(self, total: Resources | None = None) -> None:
        self._node = NodeResources("", total if total is not None else _of_this_machine())
        self._items: dict[str, _Submitted] = {}
        self._changed = threading.Condition()
        self._closed = False

    def submit(self, item: WorkItem, progress: Progress = silent) -> RunHandle:
        """See :class:`kissgs.runners.Runner`."""
        item_id = secrets.token_hex(8)
        submitted = _Submitted(item, progress, Future(), ItemProcess(item))
        with self._changed:
            if self._closed:
                raise RuntimeError("the runner is closed")
            self._items[item_id] = submitted
            self._start_those_that_fit()
        return RunHandle(item_id, submitted.outcome)

    def cancel(self, item_id: str) -> None:
        """See :class:`kissgs.runners.Runner`."""
        with self._changed:
            submitted = self._items.get(item_id)
            if submitted is None:
                return
            if submitted.started:
                submitted.process.kill()
                return
            del self._items[item_id]
            self._start_those_that_fit()  # it may have kept those behind it waiting
        submitted.outcome.set_result(Outcome("cancelled", starts=0))
        with self._changed:
            self._changed.notify_all()

    def refusal(self, resources: Resources) -> str | None:
        """See :class:`kissgs.runners.Runner`."""
        return refusal_of(resources, [self._node])

    def stats(self) -> RunnerStats:
        """See :class:`kissgs.runners.Runner`."""
        with self._changed:
            running = sum(submitted.started for submitted in self._items.values())
            return RunnerStats(len(self._items) - running, running, (self._node,))

    def health_problem(self) -> str | None:
        """See :class:`kissgs.runners.Runner`."""
        return "the runner is closed" if self._closed else None

    def close(self) -> None:
        """See :class:`kissgs.runners.Runner`."""
        with self._changed:
            self._closed = True
            ids = list(self._items)
        for item_id in reversed(ids):  # the first ones last, so that none starts in their place
            self.cancel(item_id)
        with self._changed:
            self._changed.wait_for(lambda: not self._items)

    def _start_those_that_fit(self) -> None:
        """Start waiting items in order, until one does not fit beside those that run."""
        if self._closed:
            return
        running = [submitted.item.resources for submitted in self._items.values() if submitted.started]
        total = self._node.total
        free = Resources(
            total.cpus - sum(used.cpus for used in running),
            total.memory - sum(used.memory for used in running),
            total.gpus - sum(used.gpus for used in running),
        )
        for item_id, submitted in self._items.items():
            if submitted.started:
                continue
            wanted = submitted.item.resources
            if not wanted.fits(free):
                return
            free = Resources(free.cpus - wanted.cpus, free.memory - wanted.memory, free.gpus - wanted.gpus)
            submitted.started = True
            threading.Thread(target=self._run, args=(item_id, submitted), daemon=True).start()

    def _run(self, item_id: str, submitted: _Submitted) -> None:
        outcome = Outcome("cancelled")
        try:
            for event in submitted.process.events():
                if isinstance(event, Outcome):
                    outcome = event
                else:
                    report(submitted.progress, *event)
        except Exception as error:  # noqa: BLE001  a bug, of which whoever waits must hear
            log.exception("an item could not be followed", exc_info=error)
            outcome = Outcome("error", code=INTERNAL, message="the work could not be followed; please report it")
        finally:
            with self._changed:
                del self._items[item_id]
                self._start_those_that_fit()
            submitted.outcome.set_result(outcome)
            with self._changed:
                self._changed.notify_all()


def _of_this_machine() -> Resources:
    """Return the processors that this process may use and the memory of the machine; GPUs are for Ray to count."""
    processors = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    return Resources(processors, os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE"), 0)
