"""Overhead of a runner: ``python -m kissgs.benchmark.runner_overhead [HOST:PORT]``, by default on this machine.

Items that only wait use no processor, so that nodes which share one are measured as if each had its own.
"""

from __future__ import annotations

import sys
import time
from typing import Any

from kissgs.core.progress import Progress
from kissgs.runners import Resources, Runner, WorkItem, open_runner
from kissgs.runners.local import LocalRunner

ITEMS = 16
SECONDS = 1.0


def pause(arguments: dict[str, Any], progress: Progress) -> dict[str, Any]:
    """Wait for ``seconds``, as a work item."""
    time.sleep(arguments["seconds"])
    return {}


def main() -> None:
    """Print the nodes, the overhead of an item, and the seconds of 16 items of one second."""
    if len(sys.argv) > 1:
        runner: Runner = open_runner("ray", sys.argv[1])
    else:
        runner = LocalRunner(Resources(cpus=1))
    try:
        _measure(runner, 0.0)  # starts the workers of the nodes
        overhead, total = _measure(runner, 0.0) / ITEMS, _measure(runner, SECONDS)
        cpus = runner.stats().cpus
    finally:
        runner.close()
    sys.stdout.write(
        f"{cpus:g} processors: {overhead:.3f} s per item, {ITEMS} items of {SECONDS:g} s in {total:.1f} s\n"
    )


def _measure(runner: Runner, seconds: float) -> float:
    """Return the wall time of all items together, seconds."""
    begun = time.perf_counter()
    item = WorkItem(f"{_MODULE}:pause", {"seconds": seconds}, Resources(cpus=1))
    handles = [runner.submit(item) for _ in range(ITEMS)]
    for handle in handles:
        handle.outcome.result()
    return time.perf_counter() - begun


_MODULE = "kissgs.benchmark.runner_overhead"  # __name__ is __main__ for the command

if __name__ == "__main__":
    main()
