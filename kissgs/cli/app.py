"""The command line: a thin layer over the library. Heavy imports are deferred until a command needs them."""

from __future__ import annotations

import contextlib
import errno
import json
import logging
import sys
from typing import Annotated, NoReturn

import typer
from typer import Option

from kissgs._version import __version__
from kissgs.cli.bench import bench, warmup
from kissgs.cli.compress import compact, compress
from kissgs.cli.convert import convert, decompress, info, sample, settings
from kissgs.cli.evaluate import evaluate
from kissgs.cli.files import discard_stdout, write_stdout
from kissgs.cli.interrupts import unwinding
from kissgs.cli.options import SCENE_OPTIONS, SEE_SCENE_OPTIONS, with_default_values
from kissgs.cli.remote import app as remote
from kissgs.cli.render import render, view
from kissgs.core.errors import KissgsError, OutputError, UnsupportedError

app = typer.Typer(
    name="kissgs",
    help="Compress 3D Gaussian Splatting scenes (.ply, .sog, .spz and others) into SOG-XT containers, which any "
    "browser can decode.",
    epilog=SCENE_OPTIONS,
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    rich_markup_mode="rich",
)


def run() -> None:
    """Run the command line."""
    if logging.lastResort is not None:  # prints the warnings of the library
        logging.lastResort.setFormatter(logging.Formatter("kissgs: %(message)s"))
    unwinding(_run)


def _run() -> None:
    try:
        app(with_default_values(sys.argv[1:]))
    except KissgsError as error:
        _fail(error)
    except OSError as error:
        if error.filename is None and error.errno == errno.ENOSPC:  # files that we write have errors of their own
            discard_stdout()
            _fail(OutputError("cannot write to standard output: no space left on device"))
        if error.filename is None:  # concerns no file that the user named: a bug
            raise
        _fail(UnsupportedError(f"cannot use {error.filename!s:.100}: {(error.strerror or str(error)).lower()}"))


for command in (compress, decompress, convert, compact, render, view, evaluate, info):
    app.command(epilog=SEE_SCENE_OPTIONS)(command)
for command in (settings, sample, bench, warmup):
    app.command()(command)
app.add_typer(remote)


@app.callback(invoke_without_command=True)
def _version(version: Annotated[bool, Option("--version", help="Print the version and exit.")] = False) -> None:
    if version:
        typer.echo(f"kissgs {__version__}")
        raise typer.Exit


def _fail(error: KissgsError) -> NoReturn:
    if "--json" in sys.argv:
        with contextlib.suppress(KissgsError):  # standard output itself may have failed
            write_stdout((json.dumps({"error": {"code": error.code, "message": str(error)}}) + "\n").encode())
    sys.stderr.write(f"kissgs: {error}\n")
    sys.exit(2)
