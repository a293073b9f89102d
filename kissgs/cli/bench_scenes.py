"""Inputs and output that the commands of ``kissgs bench`` share."""

from __future__ import annotations

import sys
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import typer

from kissgs.cli.files import expand, print_json, show
from kissgs.cli.interrupts import Interrupted
from kissgs.core.errors import KissgsError, UnsupportedError

if TYPE_CHECKING:
    from rich.console import RenderableType

    from kissgs.cameras.views import Views
    from kissgs.core.progress import Progress

Row = TypeVar("Row")


@dataclass(frozen=True, slots=True, kw_only=True)
class BenchInputs:
    """Inputs of a measurement.

    Attributes:
        scenes: paths of ``.ply`` files, all different.
        views: a capture; None for virtual cameras.
        threads: number of threads; 0 means one per processor.
    """

    scenes: list[Path]
    views: Views | None = None
    threads: int = 0


@dataclass(frozen=True, slots=True, kw_only=True)
class BenchOutput:
    """Output of a measurement.

    Attributes:
        rows: results for JSON.
        table: results for the terminal.
        draw: writes a plot to a file; None if there is no plot.
        failures: an error message for each part that failed.
        interrupt: what Ctrl-C or SIGTERM raised during the measurement; it is raised again after the output.
    """

    rows: list[dict[str, Any]]
    table: RenderableType
    draw: Callable[[Path], None] | None = None
    failures: list[str] = field(default_factory=list)
    interrupt: Interrupted | None = None


def open_inputs(scenes: list[str], views: Views | None, threads: int, plot: Path | None = None) -> BenchInputs:
    """Return the inputs of a measurement, after a check that its plot can be written: a measurement takes long.

    Raises:
        KissgsError: a pattern matches no file, there are several scenes for one plot, or the plot cannot be written.
    """
    inputs = BenchInputs(scenes=list(dict.fromkeys(map(Path, expand(scenes)))), views=views, threads=threads)
    if plot is not None:
        from kissgs.benchmark.plots import check_plot

        if len(inputs.scenes) > 1:
            raise UnsupportedError("--plot takes one scene; give one FILE")
        check_plot(plot)
    return inputs


def announce(text: str) -> None:
    """Print a line about a measurement before it begins."""
    sys.stderr.write(f"kissgs: {text}\n")


def report(output: BenchOutput, as_json: bool, plot: Path | None = None) -> None:
    """Print the results, write the plot, and exit with code 2 if a part of the measurement failed."""
    try:  # results that took long are plotted even if they cannot be printed
        if as_json:
            print_json(output.rows)
        elif output.rows:
            show(output.table)
    finally:
        if plot is not None and output.draw is not None:
            output.draw(plot)
    if output.interrupt is not None:
        raise output.interrupt
    for failure in output.failures:
        sys.stderr.write(f"kissgs: {failure}\n")
    if output.failures:
        raise typer.Exit(2)


def each_scene(
    scenes: list[Path], measure: Callable[[Path, Progress], list[Row]]
) -> tuple[list[tuple[str, Row]], list[str]]:
    """Return the results of ``measure`` on each scene with the scene's name, and the error messages of failed scenes.

    Raises:
        KissgsError: there is one scene, and it failed.
    """
    from kissgs.cli.console import progress_bar

    rows, failures = list[tuple[str, Row]](), list[str]()
    with progress_bar(False) as progress:
        for scene, name in zip(scenes, distinct_names(scenes), strict=True):
            try:
                rows += [(name, row) for row in measure(scene, progress)]
            except KissgsError as error:
                if len(scenes) == 1:
                    raise
                failures.append(str(error))  # the results of other scenes may have taken hours
    return rows, failures


def distinct_names(scenes: list[Path]) -> list[str]:
    """Return the shortest ends of the paths that are all different: many captures have a ``point_cloud.ply``."""
    longest = max(len(scene.parts) for scene in scenes)
    for depth in range(1, longest + 1):
        names = [str(Path(*scene.parts[-depth:])) for scene in scenes]
        if len(set(names)) == len(scenes):
            break
    return names
