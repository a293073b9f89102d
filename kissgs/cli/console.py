"""Terminal output: the console for tables, and the progress bar."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from datetime import timedelta

from rich.console import Console
from rich.progress import BarColumn, Progress, ProgressColumn, Task, TextColumn
from rich.text import Text

from kissgs.core.progress import Progress as Receiver
from kissgs.core.progress import silent


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
    columns = (
        TextColumn("{task.description:>14}"),
        BarColumn(),
        TextColumn("{task.percentage:>3.0f} %"),
        _ElapsedColumn(),
        TextColumn("{task.fields[note]}"),
    )
    with (
        Progress(*columns, console=console, transient=True, disable=not console.is_terminal) as bar,
        contextlib.ExitStack() as watch,
    ):
        task = bar.add_task("", total=1.0, note="")
        watched = False

        def receive(stage: str, fraction: float, note: str = "") -> None:
            nonlocal watched
            if stage == "kernels" and not watched:  # numba is about to be needed, and not before
                from kissgs.core.numba_kernels import report_compilation

                watched = True
                watch.enter_context(report_compilation(console.print))
            bar.update(task, description=stage, completed=fraction, note=note)

        yield receive
