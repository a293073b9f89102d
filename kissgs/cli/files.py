"""What the commands share: which files come in, where results go, and what one failure among several means."""

from __future__ import annotations

import contextlib
import glob
import json
import os
import signal
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import typer

from kissgs.core.errors import InvalidSceneError, KissgsError, OutputError, UnsupportedError

if TYPE_CHECKING:
    from rich.console import RenderableType


def each(
    names: list[str],
    output: Path | None,
    suffix: str,
    as_json: bool,
    work: Callable[[str, Path], dict[str, Any]],
    *,
    writes: bool = True,
    unreadable: type[KissgsError] = InvalidSceneError,
) -> None:
    """Do ``work`` for every input. Where one of several fails, the others are done all the same; then it is exit 2.

    Args:
        names: of the inputs, as they were given.
        output: where results go, as it was given.
        suffix: of a result's name.
        as_json: whether to print reports.
        work: takes an input and the place of its result.
        writes: whether there are results.
        unreadable: what an input is said to be that no file system would find.
    """
    inputs = expand(names)
    if writes and as_json and str(output) == "-":
        raise OutputError("--json and -o - would both write to standard output; choose one")
    targets = _targets(inputs, output, suffix) if writes else [Path("-")] * len(inputs)
    if len(inputs) == 1:
        _look_at(inputs[0], unreadable)
        report = work(inputs[0], targets[0])
        if as_json:
            print_json(_entry(inputs[0], targets[0], writes, report))
        return
    reports, failed = [], False
    for name, target in zip(inputs, targets, strict=True):
        try:
            _look_at(name, unreadable)
            reports.append(_entry(name, target, writes, work(name, target)))
        except KissgsError as error:
            failed = True
            reports.append({"input": name, "error": {"code": error.code, "message": str(error)}})
            sys.stderr.write(f"kissgs: {error}\n")
    if as_json:
        print_json(reports)
    if failed:
        raise typer.Exit(2)


def _look_at(name: str, unreadable: type[KissgsError]) -> None:
    """Say what is wrong with the name of an input before it is said of the result's, which is made from it."""
    from kissgs.io.atomic import reason_of

    try:
        if name != "-":
            os.stat(name)  # noqa: PTH116  the name as it is
    except FileNotFoundError as error:
        if not is_folder(Path(name).absolute().parent):  # else reading it says the same, and how to mend it
            raise unreadable(f"cannot read {name}: {reason_of(error)}") from error
    except (OSError, ValueError) as error:
        raise unreadable(f"cannot read {name:.100}: {reason_of(error)}") from error


def _entry(name: str, target: Path, writes: bool, report: dict[str, Any]) -> dict[str, Any]:
    return {"input": name, **({"output": str(target)} if writes else {}), **report}


def _targets(inputs: list[str], output: Path | None, suffix: str) -> list[Path]:
    """Where each result goes: beside its input, or as ``output`` says, which is one file only if it looks like one."""
    if "-" in inputs and (len(inputs) > 1 or output is None):
        raise OutputError("standard input has no name and comes alone; say where to write with -o")
    if output is not None and (str(output) == "-" or (suffix and output.suffix.lower() == suffix)):
        if len(inputs) > 1:
            raise OutputError(f"{len(inputs)} inputs cannot all become {output}; name a folder with -o")
        return [output]
    if output is not None and "-" in inputs:
        raise OutputError(f"{output} is taken for a folder, and standard input has no name; write -o NAME{suffix}")
    if output is not None:
        make_folder(output)
    targets = []
    for name in inputs:
        path = Path(name).absolute()
        stem = path.name if is_folder(path) else path.stem
        if not stem:
            raise OutputError(f"{name} has no name to call the result after; say where to write with -o")
        folder = output if output is not None else Path(name).parent
        targets.append(folder / (stem + (suffix or ".container")))
    if len(set(targets)) < len(targets):
        raise OutputError("two inputs have the same name and would become one file; convert them one by one")
    return targets


def source(name: str) -> Path | bytes:
    """A path, or what comes in on standard input."""
    if name != "-":
        return Path(name)
    if sys.stdin is None:
        raise InvalidSceneError("standard input is closed; there is nothing to read")
    return sys.stdin.buffer.read()


def beside(name: str, suffix: str) -> Path:
    """The file of the same name with another ending."""
    if name == "-":
        raise OutputError("standard input has no place beside which anything could be kept")
    path = Path(name).absolute()
    return path.parent / ((path.name if is_folder(path) else path.stem) + suffix)


def is_folder(path: Path) -> bool:
    """Whether there is a folder; whatever is wrong with the name, opening it will tell."""
    return os.path.isdir(path)  # noqa: PTH112  Path.is_dir raises where a name is too long


def make_folder(folder: Path) -> None:
    """Make a folder and its parents; exists already: fine."""
    from kissgs.io.atomic import reason_of

    try:
        folder.mkdir(parents=True, exist_ok=True)
    except (OSError, ValueError) as error:
        raise OutputError(f"cannot make the folder {folder!s:.100}: {reason_of(error)}") from error


def expand(names: list[str]) -> list[str]:
    """Patterns that the shell has not expanded, expanded."""
    found: list[str] = []
    for name in names:
        if not glob.has_magic(name) or os.path.lexists(name):  # which never raises, as Path.exists may
            found.append(name)
            continue
        matches = sorted(glob.glob(name))  # noqa: PTH207  Path.glob takes no absolute patterns
        if not matches:
            raise UnsupportedError(f"no file matches {name:.100}")
        found.extend(matches)
    return found


@contextlib.contextmanager
def stdout() -> Iterator[None]:
    """Writing to standard output, which may be full or gone."""
    if sys.stdout is None:
        raise OutputError("standard output is closed; there is nowhere to write to")
    try:
        yield
        sys.stdout.flush()
    except BrokenPipeError:
        os._exit(128 + signal.SIGPIPE)  # whoever read it has seen enough
    except OSError as error:
        from kissgs.io.atomic import reason_of

        os.dup2(os.open(os.devnull, os.O_WRONLY), 1)  # what is still in the buffer would fail again at the end
        raise OutputError(f"cannot write to standard output: {reason_of(error)}") from error


def write_stdout(data: bytes) -> None:
    """Write bytes to standard output."""
    with stdout():
        sys.stdout.buffer.write(data)


def show(what: RenderableType) -> None:
    """Print a table or a line for people."""
    from kissgs.cli.console import output

    with stdout():
        output().print(what)


def print_json(report: object) -> None:
    """Print indented JSON."""
    write_stdout((json.dumps(report, indent=2) + "\n").encode())
