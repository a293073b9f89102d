"""The command ``kissgs``, run in this process; for signals and pipes, the executable ``KISSGS``."""

import contextlib
import faulthandler
import functools
import os
import signal
import subprocess
import sys
import tempfile
from pathlib import Path

import typer.main

from kissgs.cli.main import main

KISSGS = Path(sys.executable).with_name("kissgs")

TIMEOUT_SECONDS = 900.0
"""A command that takes longer hangs: it ends its test process, after a traceback of all threads."""


typer.main.get_command = functools.cache(typer.main.get_command)  # which takes longer than many commands


def run(*words, stdin=b"", cwd=None, encoding="utf-8"):
    """Run ``kissgs WORDS`` with these bytes on standard input and return the exit code and both outputs."""
    arguments = ["kissgs", *map(str, words)]
    with tempfile.TemporaryFile() as given, tempfile.TemporaryFile() as out, tempfile.TemporaryFile() as err:
        given.write(stdin)
        given.seek(0)
        with _process_state(), _standard_files(encoding, given, out, err), contextlib.chdir(cwd or Path.cwd()):
            sys.argv = arguments
            code = _exit_code()
        out.seek(0)
        err.seek(0)
        return subprocess.CompletedProcess(arguments, code, out.read(), err.read())


def failure(*words, stdin=b"", cwd=None):
    """Run a command that must fail with exit code 2 and one line, and return the line."""
    done = run(*words, stdin=stdin, cwd=cwd)
    assert done.returncode == 2, done
    lines = done.stderr.decode().splitlines()
    assert len(lines) == 1, lines
    assert lines[0].startswith("kissgs: ")
    return lines[0]


def _exit_code():
    code = 0
    faulthandler.dump_traceback_later(TIMEOUT_SECONDS, exit=True, file=sys.__stderr__)
    try:
        main()
    except SystemExit as end:
        code = end.code or 0
    finally:
        faulthandler.cancel_dump_traceback_later()
    assert isinstance(code, int), code
    return code


@contextlib.contextmanager
def _process_state():
    """Restore process state that commands change: arguments, signal handlers, the hook for unraisable exceptions."""
    arguments, hook = sys.argv, sys.unraisablehook
    handlers = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield
    finally:
        sys.argv, sys.unraisablehook = arguments, hook
        for number, handler in handlers.items():
            signal.signal(number, handler)


@contextlib.contextmanager
def _standard_files(encoding, *files):
    """Replace standard input, output and error by files, for Python and for C libraries."""
    before = sys.stdin, sys.stdout, sys.stderr
    sys.stdout.flush()
    sys.stderr.flush()
    copies = [os.dup(number) for number in range(3)]
    for number, file in enumerate(files):
        os.dup2(file.fileno(), number)
    sys.stdin, sys.stdout, sys.stderr = (
        os.fdopen(number, mode, encoding=encoding, errors=errors, closefd=False)
        for number, (mode, errors) in enumerate((("r", None), ("w", None), ("w", "backslashreplace")))
    )
    try:
        yield
    finally:
        sys.stdout.flush()
        sys.stderr.flush()
        sys.stdin, sys.stdout, sys.stderr = before
        for number, copy in enumerate(copies):
            os.dup2(copy, number)
            os.close(copy)
