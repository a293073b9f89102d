"""Work items for the tests of the runners, and the state of processes."""

import time
from pathlib import Path

from kissgs.runners import Resources, WorkItem

MB = 1_000_000
ONE_PROCESSOR = Resources()
LIMITS = ("seconds", "memory_limit", "folder", "files", "retries")


def item(function, resources=ONE_PROCESSOR, **values):
    """Return an item of a function of ``helpers.runner_items``."""
    limits = {name: values.pop(name) for name in LIMITS if name in values}
    return WorkItem(f"helpers.runner_items:{function}", values, resources, **limits)


def outcome_of(runner, work):
    return runner.submit(work).result(120)


def processors(runner):
    """Return the number of processors of all nodes."""
    return sum(node.cpus for node in runner.nodes)


def wait_until(condition, seconds=60):
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end, "it has not happened in time"
        time.sleep(0.02)


def is_alive(pid):
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except OSError:
        return False


def pid_in(path):
    wait_until(lambda: path.exists() and path.read_text())
    return int(path.read_text())
