"""``LocalRunner``: work items as processes on this machine, which start at once: the caller limits their number."""

from __future__ import annotations

import secrets
import threading
from concurrent.futures import Future, wait

from kissgs.core.progress import Progress, silent
from kissgs.runners.contract import INTERNAL, Outcome, Resources, RunHandle, WorkItem, log, report
from kissgs.runners.process import ItemProcess


class LocalRunner:
    """Runner on this machine, see :class:`kissgs.runners.Runner`."""

    def __init__(self) -> None:
        self._items: dict[str, tuple[ItemProcess, Future[Outcome]]] = {}
        self._closed = False
        self._lock = threading.Lock()

    @property
    def nodes(self) -> tuple[Resources, ...]:
        """See :class:`kissgs.runners.Runner`."""
        return ()

    def submit(self, item: WorkItem, progress: Progress = silent) -> RunHandle:
        """See :class:`kissgs.runners.Runner`."""
        item_id, process, outcome = secrets.token_hex(8), ItemProcess(item), Future[Outcome]()
        with self._lock:
            if self._closed:
                raise RuntimeError("the runner is closed")
            self._items[item_id] = process, outcome

        def run() -> None:
            outcome.set_result(_run(process, progress))
            with self._lock:
                del self._items[item_id]

        threading.Thread(target=run, daemon=True).start()
        return RunHandle(item_id, outcome)

    def cancel(self, item_id: str) -> None:
        """See :class:`kissgs.runners.Runner`."""
        with self._lock:
            if item_id in self._items:
                self._items[item_id][0].kill()

    def refusal(self, resources: Resources) -> str | None:
        """See :class:`kissgs.runners.Runner`."""
        return None

    def health_problem(self) -> str | None:
        """See :class:`kissgs.runners.Runner`."""
        return "the runner is closed" if self._closed else None

    def close(self) -> None:
        """See :class:`kissgs.runners.Runner`."""
        with self._lock:
            self._closed = True
            items = list(self._items.values())
        for process, _ in items:
            process.kill()
        wait([outcome for _, outcome in items])


def _run(process: ItemProcess, progress: Progress) -> Outcome:
    """Report the events of a process and return its outcome."""
    outcome = Outcome("cancelled")
    try:
        for event in process.events():
            if isinstance(event, Outcome):
                outcome = event
            else:
                report(progress, *event)
    except Exception as error:  # noqa: BLE001  a bug, of which whoever waits must hear
        log.exception("an item could not be followed", exc_info=error)
        return Outcome("error", code=INTERNAL, message="the work could not be followed; please report it")
    return outcome
