"""Work items of a streamed scene on a runner: the levels of a chunk, and one file.

Items of a step do not depend on each other. Each reads and writes the work folder, which all machines see; one that is
run twice, because its node was given up, writes the same bytes again.
"""

from __future__ import annotations

import socket
from collections.abc import Callable, Sequence
from concurrent.futures import FIRST_COMPLETED, wait
from pathlib import Path
from typing import Any

from kissgs.core.errors import OutputError, UnsupportedError
from kissgs.core.progress import Progress
from kissgs.runners import Resources, Runner, WorkItem, error_of
from kissgs.settings import EncodeSettings
from kissgs.streaming import build
from kissgs.streaming.layout import PARTITION, Layout, read_layout
from kissgs.streaming.rows import row_bytes
from kissgs.streaming.work_folder import read_json

PROCESS_BYTES = 500_000_000
"""Memory of an item for libraries, bytes."""

MEMORY_RATIO = 5
"""Memory of an item for each byte of the Gaussians of its file as float32."""

Item = tuple[Callable[[dict[str, Any], Progress], dict[str, Any]], dict[str, Any]]
"""A function of this module, and its arguments without "threads"."""

POLL_SECONDS = 0.5
"""Seconds between reports of progress, which may also stop the work."""


def run_levels(arguments: dict[str, Any], progress: Progress) -> dict[str, Any]:
    """Make the levels of a chunk: "work", the work folder; "chunk"; "threads"."""
    work = _shared(arguments)
    chunk = arguments["chunk"]
    _make_once(
        lambda: build.has_levels(work, chunk),
        lambda: build.make_levels(work, read_layout(work), chunk, arguments["threads"], progress),
    )
    return {}


def run_file(arguments: dict[str, Any], progress: Progress) -> dict[str, Any]:
    """Encode a file: "work", the work folder; "level" and "file"; "settings" of the encoder; "threads"."""
    work, level, file = _shared(arguments), arguments["level"], arguments["file"]
    settings = EncodeSettings.model_validate(arguments["settings"])
    _make_once(
        lambda: build.has_file(work, level, file),
        lambda: build.make_file(work, read_layout(work), settings, level, file, arguments["threads"], progress),
    )
    return {}


def run_environment(arguments: dict[str, Any], progress: Progress) -> dict[str, Any]:
    """Encode the environment: "work", the work folder; "settings" of the encoder; "threads"."""
    work, settings = _shared(arguments), EncodeSettings.model_validate(arguments["settings"])
    _make_once(
        lambda: build.has_environment(work),
        lambda: build.make_environment(work, read_layout(work), settings, arguments["threads"], progress),
    )
    return {}


def _make_once(done: Callable[[], bool], make: Callable[[], None]) -> None:
    """Make something unless it is there.

    A node that was given up may still be at work: what it completes meanwhile, it takes the input of, and this item is
    done.
    """
    if done():
        return
    try:
        make()
    except OutputError:
        if not done():
            raise


def run_all(
    runner: Runner,
    items: Sequence[Item],
    layout: Layout,
    threads: int,
    report: Callable[[float], None],
) -> None:
    """Run items and wait for them; if one fails, or the caller is stopped, the others are cancelled.

    Args:
        runner: engine of the items.
        items: a function of this module and its arguments, without "threads", of each.
        layout: sizes of the scene.
        threads: processors of each item; 0 means one.
        report: receives the fraction of the items that is done.

    Raises:
        KissgsError: an item failed.
    """
    memory = PROCESS_BYTES + MEMORY_RATIO * max(layout.counts) * row_bytes(layout.sh_degree)
    requested = Resources(cpus=max(1, threads), memory=memory)
    if refusal := runner.refusal(requested):
        raise UnsupportedError(f"{refusal}; choose another number with --threads")
    handles = [
        runner.submit(WorkItem(f"{__name__}:{function.__name__}", {**arguments, "threads": max(1, threads)}, requested))
        for function, arguments in items
    ]
    waiting = {handle.outcome for handle in handles}
    try:
        while waiting:
            report(1 - len(waiting) / len(items))
            done, waiting = wait(waiting, POLL_SECONDS, FIRST_COMPLETED)
            for each in done:
                if each.result().kind != "done":
                    raise error_of(each.result())
    except BaseException:
        for handle in handles:
            runner.cancel(handle.id)
        wait([handle.outcome for handle in handles])
        raise


def _shared(arguments: dict[str, Any]) -> Path:
    """Return the work folder.

    Raises:
        UnsupportedError: this machine does not see it.
    """
    work = Path(arguments["work"])
    if read_json(work / PARTITION) is None:
        raise UnsupportedError(
            f"the machine {socket.gethostname()} does not see {work}; --ray needs storage that all machines see at the "
            "same path"
        )
    return work
