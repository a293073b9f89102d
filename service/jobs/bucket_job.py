"""Compression on a node that shares no disk with the service: all files come from a bucket and go there.

The process works in its current folder, a temporary one. It has no credentials, because it reads untrusted files; the
task has a signed address for every file that it may read or write:

    scene                   name, bytes and address of the upload
    checkpoints             bytes and address of each checkpoint that is stored already, by name
    store                   address of every file that can be stored, by name: checkpoints, and result/NAME
    space                   bytes that the job may need on the disk
    further entries         as for :func:`service.jobs.job_process.compress`

``result/summary.json`` is stored last and completes the result.
"""

from __future__ import annotations

import contextlib
import shutil
import socket
import threading
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import TYPE_CHECKING, Any

import kissgs

from . import job_process
from .transfer import FULL, NodeDiskError, NodeError, StorageAccessError, client, disk_error, fetch, store

if TYPE_CHECKING:
    import httpx

CHECKPOINT_SECONDS = 30.0
"""Minimum seconds between two looks for new checkpoints."""

FILES_AT_ONCE = 8
"""Number of files that are stored simultaneously."""

SUMMARY = "result/summary.json"


def compress(task: job_process.Task, progress: kissgs.Progress) -> dict[str, Any]:
    """Fetch the scene, compress it, store the result, and return its summary.

    Raises:
        kissgs.KissgsError: the scene cannot be compressed.
        StorageAccessError: the storage cannot be reached, or the signed addresses have expired.
        NodeDiskError: the disk is full.
        NodeError: this machine cannot write the job's files.
    """
    folder = Path.cwd()
    free = shutil.disk_usage(folder).free
    if free < task["space"]:
        raise NodeDiskError(
            f"the machine {socket.gethostname()} has {free / 1e9:.2g} GB of free disk space for temporary files, and "
            f"the job may need {task['space'] / 1e9:.2g} GB"
        )
    source = folder / task["scene"]["name"]
    local = {**task, "source": str(source), "work": str(folder)}
    with client() as http:
        fetch(http, task["scene"]["url"], source, task["scene"]["bytes"])
        if task["checkpoint"] is not None:
            local["checkpoint"] = str(folder / task["checkpoint"])
            for name, stored in task["checkpoints"].items():
                fetch(http, stored["url"], folder / name, stored["bytes"])
        with _checkpoints_stored(http, task, folder):
            try:
                summary = job_process.compress(local, progress)
            except kissgs.KissgsError as error:
                _raise_if_full(error)
                error.args = (job_process.without_paths(str(error), local),)
                raise
            except OSError as error:
                raise disk_error(error) from error
            _store_result(http, task["store"], folder)
    return summary


def _raise_if_full(error: kissgs.KissgsError) -> None:
    """Raise NodeDiskError if a full disk is the cause: another machine may have room."""
    if isinstance(error.__cause__, OSError) and error.__cause__.errno in FULL:
        raise disk_error(error.__cause__) from error


def _store_result(http: httpx.Client, addresses: dict[str, str], folder: Path) -> None:
    files = {str(path.relative_to(folder)): path for path in (folder / "result").rglob("*") if path.is_file()}
    last = files.pop(SUMMARY)
    with ThreadPoolExecutor(FILES_AT_ONCE) as pool:
        for _ in pool.map(lambda name: store(http, files[name], addresses[name]), sorted(files)):
            pass
    store(http, last, addresses[SUMMARY])


@contextlib.contextmanager
def _checkpoints_stored(http: httpx.Client, task: job_process.Task, folder: Path) -> Iterator[None]:
    """Store checkpoints now and then, in at most a tenth of the time, and when the block ends by an error."""
    if task["checkpoint"] is None:
        yield
        return
    names = [name for name in task["store"] if "/" not in name]
    times = {name: _modified(folder / name) for name in names}
    ended = threading.Event()

    def store_changed() -> None:
        for name in names:
            modified = _modified(folder / name)
            if modified not in (None, times[name]):
                # The job may succeed without, and one that is too large for a request is of no use to others.
                with contextlib.suppress(kissgs.KissgsError, OSError):
                    store(http, folder / name, task["store"][name])
                    times[name] = modified

    def repeat() -> None:
        pause = CHECKPOINT_SECONDS
        while not ended.wait(pause):
            begun = time.monotonic()
            store_changed()
            pause = max(CHECKPOINT_SECONDS, 9 * (time.monotonic() - begun))

    thread = threading.Thread(target=repeat, daemon=True)
    thread.start()
    try:
        yield
    except (StorageAccessError, NodeDiskError, NodeError):  # the job is started again
        ended.set()
        thread.join()
        store_changed()
        raise
    finally:
        ended.set()
        thread.join()


def _modified(path: Path) -> int | None:
    """Return the time of a file's last change; None if it does not exist."""
    try:
        return path.stat().st_mtime_ns
    except OSError:
        return None
