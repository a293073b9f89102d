"""Ctrl-C while modules are loaded, and at the very end: one line and exit code 130, never a traceback."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest

import kissgs

HOME = str(Path(kissgs.__file__).parents[1])
SAID = "kissgs: interrupted; nothing half-written is left\n"

PROGRAM = """
import os, sys
from kissgs.cli.main import main
left = int(sys.argv.pop(1))
count = 0
def told(event, arguments):
    global count
    if event == "import":
        count += 1
        if count == left:
            os.kill(os.getpid(), SIGNAL)
sys.addaudithook(told)
try:
    main()
finally:
    if left == 0:
        sys.stderr.write(str(count))
"""


def start(left: int, *words: str, number: int = signal.SIGINT) -> subprocess.CompletedProcess[str]:
    """The command line, told to end at its so-manieth import; with 0 it is not, and counts them."""
    return subprocess.run(
        [sys.executable, "-P", "-c", PROGRAM.replace("SIGNAL", str(int(number))), str(left), *words],
        env=os.environ | {"PYTHONPATH": HOME},
        capture_output=True,
        text=True,
        timeout=60,
        check=False,
    )


@pytest.mark.parametrize("words", [["--version"], ["compress", "none.ply"]])
def test_interrupts_at_every_stage_of_loading(words: list[str]) -> None:
    imports = int(start(0, *words).stderr.rsplit("\n", 1)[-1])
    assert imports > 100
    for left in sorted({1, 2, 4, 8, 16, 32, 64, *range(1, imports, imports // 10), imports}):
        done = start(left, *words)
        assert (done.returncode, done.stderr) == (130, SAID), (left, done.stderr[-2000:])


def test_requests_to_end_likewise() -> None:
    done = start(40, "--version", number=signal.SIGTERM)
    assert (done.returncode, done.stderr) == (143, SAID)


def test_an_interrupt_that_a_library_turns_into_its_own_error() -> None:
    """Python itself does so with what is raised while a class is made."""
    lines = (
        "import signal; from kissgs.cli import app, main",
        "class Thing:",
        "    def __set_name__(self, owner, name):",
        "        signal.raise_signal(signal.SIGINT)",
        "def work(words):",
        "    class Owner:",
        "        thing = Thing()",
        "app.app = work",
        "main.main()",
    )
    done = _python("\n".join(lines))
    assert (done.returncode, done.stderr) == (130, SAID)


def test_an_interrupt_while_python_ends() -> None:
    lines = (
        "import atexit, signal; from kissgs.cli import app, main",
        "atexit.register(lambda: signal.raise_signal(signal.SIGINT))",
        "app.app = lambda words: None",
        "main.main()",
    )
    done = _python("\n".join(lines))
    assert (done.returncode, done.stderr) == (130, SAID)


def test_nothing_is_loaded_before_it_listens() -> None:
    """What Python loads by itself, and of kissgs what is needed to listen."""
    bare = set(_python("import re, signal, sys; print(*sys.modules)").stdout.split())
    ours = set(_python("import re, signal, sys; import kissgs.cli.main; print(*sys.modules)").stdout.split())
    assert ours - bare <= {
        *("__future__", "kissgs", "kissgs._version", "kissgs.cli", "kissgs.cli.main", "kissgs.cli.interrupts")
    }


def _python(program: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-P", "-c", program],
        env=os.environ | {"PYTHONPATH": HOME},
        capture_output=True,
        text=True,
        timeout=60,
        check=False,
    )
