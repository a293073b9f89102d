"""The terminal: where tables go, and the progress bar."""

from __future__ import annotations

import contextlib
import threading
from collections.abc import Iterator

from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn

from kissgs.core.progress import Progress as Receiver
from kissgs.core.progress import silent

SLOW_START_SECONDS = 1.5
"""Kernels load from numba's cache in less; what takes longer is compiling."""


def output() -> Console:
    """Where results go: standard output, as wide as the terminal, or as wide as it takes in a pipe."""
    console = Console(highlight=False, markup=False)
    if not console.is_terminal:
        console.width = 200
    return console


@contextlib.contextmanager
def progress_bar(quiet: bool) -> Iterator[Receiver]:
    """A receiver of progress events that draws a bar on standard error, if that is a terminal."""
    console = Console(stderr=True)
    if quiet:
        yield silent
        return
    notice: threading.Timer | None = None
    columns = (
        TextColumn("{task.description:>14}"),
        BarColumn(),
        TextColumn("{task.percentage:>3.0f} %"),
        TimeElapsedColumn(),
        TextColumn("{task.fields[note]}"),
    )
    with Progress(*columns, console=console, transient=True, disable=not console.is_terminal) as bar:
        task = bar.add_task("", total=1.0, note="")

        def receive(stage: str, fraction: float, note: str = "") -> None:
            nonlocal notice
            if notice is not None:  # whatever comes next, kernels are compiled
                notice.cancel()
                notice = None
            if stage == "kernels" and fraction == 0:  # which a bar may hear several times: a timer runs only once
                notice = _notice(console)
                notice.start()
            bar.update(task, description=stage, completed=fraction, note=note)

        try:
            yield receive
        finally:
            if notice is not None:
                notice.cancel()


def _notice(console: Console) -> threading.Timer:
    message = "compiling kernels (once; cached from then on) …"
    timer = threading.Timer(SLOW_START_SECONDS, console.print, [message])
    timer.daemon = True
    return timer
