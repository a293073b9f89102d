"""Input and output of the command line: files, standard output, and the progress bar."""

from __future__ import annotations

import contextlib
import glob
import itertools
import json
import os
import signal
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager
from datetime import timedelta
from pathlib import Path
from types import FrameType
from typing import Any, BinaryIO

import typer
from rich.console import Console, RenderableType
from rich.progress import BarColumn, Progress, ProgressColumn, Task, TextColumn
from rich.text import Text

from kissgs.cli.interrupts import NOTHING_LEFT, Interrupted, say_when_interrupted
from kissgs.core.context import JobProgress, Step, silent, with_seconds_left
from kissgs.core.context import Progress as Receiver
from kissgs.core.errors import InvalidSceneError, KissgsError, OutputError, StopSearch, UnsupportedError
from kissgs.formats import DOUBLE_ENDINGS, ENDINGS, FOLDER_ENDING, SCENE_ENDINGS, named_manifest, names_folder

# Terminal output: the console for tables, and the progress bar.


def gaussians(count: int) -> str:
    """Format a number of Gaussians: "1 Gaussian", "60,000 Gaussians"."""
    return f"{count:,} Gaussian{'' if count == 1 else 's'}"


def output() -> Console:
    """Return a console on standard output, as wide as the terminal; 200 columns if that is a pipe or a file."""
    console = Console(highlight=False, markup=False)
    if not console.is_terminal:
        console.width = 200
    return console


STAGES = {
    "reading": ("read", "decode", "partition", "upload"),
    "preparing": ("kernels", "cluster", "scratch"),
    "choosing cameras": ("cameras",),
    "measuring what matters": ("sensitivity", "score"),
    "drawing": ("targets", "render"),
    "training": ("sparsify", "refine", "finetune", "refit"),
    "merging": ("merge",),
    "sorting": ("rate_distortion", "order", "forms", "codebook", "sort codebook", "rounding", "reorder"),
    "compressing images": ("images",),
    "checking": ("evaluate",),
    "writing": ("write", "html", "download"),
}
"""Everyday names of stages; others are shown as they are."""

_NAMES = {stage: name for name, stages in STAGES.items() for stage in stages}


def roughly(seconds: float) -> str:
    """Format an estimate with few digits: "about 7 s", "about 40 s", "about 3 min", "about 1.5 h"."""
    if seconds < 55:
        return f"about {max(1, round(seconds)) if seconds < 10 else 5 * round(seconds / 5)} s"
    return f"about {max(1, round(seconds / 60))} min" if seconds < 5400 else f"about {seconds / 3600:.1f} h"


class _TimeColumn(ProgressColumn):
    """Time since the command began, and the time left, which the clock counts down between events."""

    def render(self, task: Task) -> Text:
        """Return for example "0:01:15, about 40 s left"."""
        elapsed, end = task.elapsed or 0.0, task.fields["end"]
        left = "" if end is None else f", {roughly(end - elapsed)} left" if end > elapsed else ", longer than expected"
        return Text(f"{timedelta(seconds=int(elapsed))}{left}", style="progress.elapsed")


@contextlib.contextmanager
def progress_bar(quiet: bool, steps: Sequence[Step] = ()) -> Iterator[Receiver]:
    """Yield a receiver of progress events that draws a bar on standard error, if that is a terminal. With ``steps``, it
    gets the fractions of stages, see :class:`kissgs.core.context.JobProgress`; else those of the whole command."""
    if quiet:
        yield silent
        return
    console = Console(stderr=True)
    columns = (BarColumn(), TextColumn("{task.percentage:>3.0f} %"), _TimeColumn(), TextColumn("{task.description}"))
    with (
        Progress(*columns, console=console, transient=True, disable=not console.is_terminal) as bar,
        contextlib.ExitStack() as watch,
    ):
        task = bar.add_task("", total=1.0, end=None)
        watched = False

        def receive(stage: str, fraction: float, note: str = "", seconds_left: float | None = None) -> None:
            nonlocal watched
            if stage == "kernels" and not watched:  # numba is about to be needed, and not before
                from kissgs.core.numba_kernels import report_compilation

                watched = True
                watch.enter_context(report_compilation(console.print))
            described = "; ".join(filter(None, [_NAMES.get(stage, stage), note]))
            end = None if seconds_left is None else (bar.tasks[task].elapsed or 0.0) + seconds_left
            bar.update(task, description=described, completed=fraction, end=end)

        if not steps:
            yield receive
            return
        job = JobProgress(receive, steps)
        yield job
        job.stop()


def announcing(progress: Receiver, announced: str, quiet: bool, about: str = "") -> Receiver:
    """Return a receiver that prints the first note of a stage as a line on standard error, after ``about``."""
    said, forward = quiet, with_seconds_left(progress)

    def receive(stage: str, fraction: float, note: str = "", seconds_left: float | None = None) -> None:
        nonlocal said
        if stage == announced and not said:
            sys.stderr.write(f"kissgs: {about}{note}\n")
            said = True
        forward(stage, fraction, "" if stage == announced else note, seconds_left)

    return receive


STOPPING = (
    "\nkissgs: stopping: completing the best result so far, if any, which may take minutes; Ctrl-C again aborts\n"
)


@contextlib.contextmanager
def stoppable(progress: Receiver, searches: bool) -> Iterator[Receiver]:
    """Yield a receiver with which one Ctrl-C ends a search for a goal with its best result, and a second one aborts."""
    if not searches:
        yield progress
        return
    pressed, forward, before = False, with_seconds_left(progress), signal.getsignal(signal.SIGINT)

    def on_interrupt(number: int, frame: FrameType | None) -> None:
        nonlocal pressed
        pressed = True
        signal.signal(signal.SIGINT, before)
        os.write(2, STOPPING.encode())  # at once: the next progress event may take a while

    def receive(stage: str, fraction: float, note: str = "", seconds_left: float | None = None) -> None:
        nonlocal pressed
        if pressed:
            pressed = False
            raise StopSearch
        forward(stage, fraction, note, seconds_left)

    signal.signal(signal.SIGINT, on_interrupt)
    try:
        yield receive
    except StopSearch as error:
        say_when_interrupted(lambda: f"nothing met the goal yet, and {NOTHING_LEFT}")
        raise Interrupted(signal.SIGINT) from error
    finally:
        signal.signal(signal.SIGINT, before)


# Input and output files of the commands, and the handling of failures among several inputs.

Result = tuple[dict[str, Any], RenderableType]  # of one input: for ``--json``, and a table or a line for the terminal
Work = Callable[[str, Path], Result]  # gets an input and the path of its output, "-" for standard output
Pairs = list[tuple[str, Path]]


def for_each_input(
    names: list[str],
    output: str | None,
    suffix: str,
    work: Work,
    *,
    as_json: bool,
    quiet: bool,
    writes: bool = True,
    unreadable: type[KissgsError] = InvalidSceneError,
    during: Callable[[Pairs], AbstractContextManager[object]] | None = None,
) -> None:
    """Call ``work`` for every input, and print its results. If one of several inputs fails, the others are still
    processed; the exit code is then 2. A folder that is made for the outputs stays if all fail: another command may be
    about to write into it. The context of ``during``, which gets all inputs with their outputs, encloses the work. A
    slash at the end of ``output`` names a folder."""
    from kissgs.io.checkpoint import one_per_step
    from kissgs.io.files import reason_of

    inputs = one_per_step(expand(names))
    if writes and output is None:
        _refuse_output_as_input(inputs, suffix)
    if writes and as_json and output == "-":
        raise OutputError("--json and -o - both write to standard output; choose one")
    targets = _targets(inputs, output, suffix) if writes else [Path("-")] * len(inputs)
    if writes and output is not None and Path(output) not in targets:
        try:
            Path(output).mkdir(parents=True, exist_ok=True)
        except (OSError, ValueError) as error:
            raise OutputError(f"cannot make the folder {Path(output)!s:.100}: {reason_of(error)}") from error
    pairs = list(zip(inputs, targets, strict=True))
    reports, failed = [], False
    with contextlib.nullcontext() if during is None else during(pairs):
        for name, target in pairs:
            try:
                check_input(name, unreadable)
                report, shown = work(name, target)
                if not (quiet or as_json or (writes and str(target) == "-")):
                    show(shown)
                reports.append({"input": name, **({"output": str(target)} if writes else {}), **report})
            except KissgsError as error:
                if len(pairs) == 1:
                    raise
                failed = True
                reports.append({"input": name, "error": {"code": error.code, "message": str(error)}})
                named = name[:100] in str(error) or Path(name).name in str(error)
                where = "" if named else f"{name}: "  # files of a container have names of their own
                sys.stderr.write(f"kissgs: {where}{error}\n")
    if as_json:
        print_json(reports if len(pairs) > 1 else reports[0])
    if failed:
        raise typer.Exit(2)


def check_input(name: str, unreadable: type[KissgsError]) -> None:
    """Check the path of an input, so that an error names it and not the output path derived from it."""
    from kissgs.io.files import reason_of

    try:
        if name != "-":
            os.stat(name)  # noqa: PTH116  Path would normalise the name
    except FileNotFoundError as error:
        if not is_folder(Path(name).absolute().parent):  # otherwise reading it gives a better message
            raise unreadable(f"cannot read {name}: {reason_of(error)}") from error
    except (OSError, ValueError) as error:
        raise unreadable(f"cannot read {name:.100}: {reason_of(error)}") from error


def _targets(inputs: list[str], output: str | None, suffix: str) -> list[Path]:
    """Return the output path of each input: next to it, in the folder ``output``, or the file ``output``."""
    if "-" in inputs and (len(inputs) > 1 or output is None):
        raise OutputError("standard input has no name and must be the only input; give the output with -o")
    if output is None:
        folders, stems = [Path(name).parent for name in inputs], list(map(_stem, inputs))
    else:
        path = Path(output)
        file = "" if output.endswith(("/", os.sep)) else path.name.lower()
        if output == "-" or (suffix and file.endswith(suffix) and file != suffix):
            if len(inputs) > 1:
                remedy = "compress one scene at a time" if named_manifest(path) else "give a folder with -o"
                raise OutputError(f"{len(inputs)} inputs cannot all become {path}; {remedy}")
            return [path]
        if not names_folder(output):
            ending = path.suffix.lower()
            if suffix and ending in (*ENDINGS, *SCENE_ENDINGS):
                command = "compress" if ending in ENDINGS else "convert"
                raise OutputError(f"this command writes {suffix}; for {ending}, use kissgs {command}")
            as_file = f"in {suffix} if it is a file, or " if suffix else ""
            raise OutputError(f"there is no folder {path!s:.100}; end it {as_file}in a slash to make a folder")
        if "-" in inputs:
            raise OutputError(f"-o {path} is a folder, but standard input has no name; give -o NAME{suffix}")
        folders, stems = [path] * len(inputs), _names(inputs)
    if "" in stems:
        name = inputs[stems.index("")]
        raise OutputError(f"{name} has no name to derive the output from; give the output with -o")
    targets = [folder / (stem + (suffix or FOLDER_ENDING)) for folder, stem in zip(folders, stems, strict=True)]
    if len(set(targets)) < len(targets):
        raise OutputError("two inputs have the same name and would become one file; process them one by one")
    return targets


def _names(inputs: list[str]) -> list[str]:
    """Return the names of outputs in one folder: those of the inputs; of equal ones, the names of the nearest folders
    above them that all differ, or of two such folders. Names that differ in case only are equal on some machines."""
    names, equal = list(map(_stem, inputs)), dict[str, list[int]]()
    for n, name in enumerate(names):
        equal.setdefault(name.casefold(), []).append(n)
    for group in filter(lambda group: len(group) > 1, equal.values()):
        paths = [Path(os.path.abspath(inputs[n])) for n in group]  # noqa: PTH100  links keep their names
        levels = list(zip(*([folder.name for folder in path.parents] for path in paths), strict=False))
        pairs = [
            tuple(f"{above}_{name.removeprefix('iteration_')}" for above, name in zip(outer, inner, strict=True))
            for inner, outer in itertools.combinations(levels, 2)
        ]
        chosen = next((each for each in [*levels, *pairs] if len({name.casefold() for name in each}) == len(group)), ())
        for n, name in zip(group, chosen, strict=False):
            names[n] = name
    return names


def _refuse_output_as_input(inputs: list[str], suffix: str) -> None:
    """Raise OutputError for ``SCENE.ply NEW.zip``, as other tools name their output; -o names it here."""
    if len(inputs) != 2 or not os.path.lexists(inputs[0]) or os.path.lexists(inputs[1]):
        return
    read, written = (Path(name).suffix.lower() for name in inputs)
    if written != read and written in {suffix, *(ENDINGS if suffix in ENDINGS else ())} - {""}:
        raise OutputError(f"{inputs[1]:.100} does not exist; if it is the output, name it with -o {inputs[1]:.100}")


def source(name: str) -> Path | bytes:
    """Return the path of an input, or the bytes of standard input for "-"."""
    if name != "-":
        return Path(name)
    if sys.stdin is None:
        raise InvalidSceneError("standard input is closed; there is nothing to read")
    return sys.stdin.buffer.read()


CHECKPOINT = ".checkpoint.npz"  # ending of checkpoints beside scenes


def sibling(name: str, suffix: str) -> Path:
    """Return the path next to an input with another ending."""
    if name == "-":
        raise OutputError("standard input has no folder in which --cache or --checkpoint could keep a file")
    return Path(name).absolute().parent / (_stem(name) + suffix)


def _stem(name: str) -> str:
    """Return the name of an input without its ending, which may have two parts; folders have none."""
    path = Path(name).absolute()
    if is_folder(path):
        return path.name
    ending = next((ending for ending in DOUBLE_ENDINGS if path.name.lower().endswith(ending)), path.suffix)
    return path.name[: len(path.name) - len(ending)]


def is_folder(path: Path) -> bool:
    """Whether the path is a folder; False also for invalid names, about which opening them gives an error."""
    return os.path.isdir(path)  # noqa: PTH112  Path.is_dir raises where a name is too long


def expand(names: list[str]) -> list[str]:
    """Expand the glob patterns that the shell has not expanded."""
    found: list[str] = []
    for name in names:
        if not glob.has_magic(name) or os.path.lexists(name):  # never raises, unlike Path.exists
            found.append(name)
            continue
        matches = sorted(glob.glob(name))  # noqa: PTH207  Path.glob takes no absolute patterns
        if not matches:
            raise UnsupportedError(f"no file matches {name:.100}")
        found.extend(matches)
    return found


@contextlib.contextmanager
def stdout() -> Iterator[BinaryIO]:
    """Open standard output: errors of a full or closed one become an OutputError."""
    if sys.stdout is None:
        raise OutputError("standard output is closed; there is nowhere to write to")
    try:
        yield sys.stdout.buffer
        sys.stdout.flush()
    except BrokenPipeError:
        os._exit(128 + signal.SIGPIPE)  # the reader has closed the pipe
    except OSError as error:
        from kissgs.io.files import reason_of

        discard_stdout()
        raise OutputError(f"cannot write to standard output: {reason_of(error)}") from error


def discard_stdout() -> None:
    """Discard what standard output still holds after an error: Python's flush at exit would fail with it again."""
    os.dup2(os.open(os.devnull, os.O_WRONLY), 1)


def write_stdout(data: bytes) -> None:
    """Write bytes to standard output."""
    with stdout() as file:
        file.write(data)


def write_output(target: Path, data: bytes, *, force: bool) -> None:
    """Write a file atomically, or to standard output for "-"."""
    from kissgs.io.files import atomic_file

    with stdout() if str(target) == "-" else atomic_file(target, overwrite=force) as file:
        file.write(data)


def say_notes(name: str, notes: Sequence[str], quiet: bool) -> None:
    """Print what reading a scene left out or changed on standard error; empty notes count for nothing."""
    if any(notes) and not quiet:
        sys.stderr.write(f"kissgs: {name}: {'; '.join(filter(None, notes))}\n")


def show(what: RenderableType) -> None:
    """Print a table or a line of text."""
    with stdout():
        output().print(what)


def print_json(report: object) -> None:
    """Print indented JSON."""
    write_stdout((json.dumps(report, indent=2) + "\n").encode())
