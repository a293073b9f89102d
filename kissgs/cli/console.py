"""Terminal output: the console for tables, and the progress bar."""

from __future__ import annotations

import contextlib
import threading
from collections.abc import Iterator
from datetime import timedelta

from rich.console import Console
from rich.progress import BarColumn, Progress, ProgressColumn, Task, TextColumn
from rich.text import Text

from kissgs.core.progress import Progress as Receiver
from kissgs.core.progress import silent

SLOW_START_SECONDS = 1.5
"""Loading kernels from numba's cache takes less; if it takes longer, they are being compiled."""


def output() -> Console:
    """Return a console on standard output, as wide as the terminal; 200 columns if that is a pipe or a file."""
    console = Console(highlight=False, markup=False)
    if not console.is_terminal:
        console.width = 200
    return console


class _ElapsedColumn(ProgressColumn):
    """Time since the command began. Rich's own column stops when a stage is complete: one task serves all stages."""

    def render(self, task: Task) -> Text:
        """Return hours, minutes and seconds."""
        return Text(str(timedelta(seconds=int(task.elapsed or 0))), style="progress.elapsed")


@contextlib.contextmanager
def progress_bar(quiet: bool) -> Iterator[Receiver]:
    """Yield a receiver of progress events that draws a bar on standard error, if that is a terminal."""
    console = Console(stderr=True)
    if quiet:
        yield silent
        return
    notice: threading.Timer | None = None
    columns = (
        TextColumn("{task.description:>14}"),
        BarColumn(),
        TextColumn("{task.percentage:>3.0f} %"),
        _ElapsedColumn(),
        TextColumn("{task.fields[note]}"),
    )
    with Progress(*columns, console=console, transient=True, disable=not console.is_terminal) as bar:
        task = bar.add_task("", total=1.0, note="")

        def receive(stage: str, fraction: float, note: str = "") -> None:
            nonlocal notice
            if notice is not None:  # any further event means that the kernels are ready
                notice.cancel()
                notice = None
            if stage == "kernels" and fraction == 0:  # may be reported several times; a timer can start only once
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
