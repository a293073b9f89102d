"""Ctrl-C during imports and at exit: one line and exit code 130, never a traceback."""

import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest

import kissgs

HOME = str(Path(kissgs.__file__).parents[1])
SAID = "kissgs: interrupted; no partial file is left\n"

PROGRAM = """
import os, sys
from kissgs.cli.main import main
left = int(sys.argv.pop(1))
count = 0
def on_event(event, arguments):
    global count
    if event == "import":
        count += 1
        if count == left:
            os.kill(os.getpid(), SIGNAL)
sys.addaudithook(on_event)
try:
    main()
finally:
    if left == 0:
        sys.stderr.write(str(count))
"""


def start(left, *words, number=signal.SIGINT):
    """Run the command line, with a signal at its ``left``-th import; 0 sends none and prints the number of imports."""
    return subprocess.run(
        [sys.executable, "-P", "-c", PROGRAM.replace("SIGNAL", str(int(number))), str(left), *words],
        env=os.environ | {"PYTHONPATH": HOME},
        capture_output=True,
        text=True,
        timeout=300,
        check=False,
    )


@pytest.mark.parametrize("words", [["--version"], ["compress", "none.ply"]])
@pytest.mark.quick(1)
def test_interrupts_at_every_stage_of_loading(words):
    imports = int(start(0, *words).stderr.rsplit("\n", 1)[-1])
    assert imports > 100
    for left in sorted({1, 4, 16, 64, *range(1, imports, imports // 6), imports}):
        done = start(left, *words)
        assert (done.returncode, done.stderr) == (130, SAID), (left, done.stderr[-2000:])


def test_sigterm():
    done = start(40, "--version", number=signal.SIGTERM)
    assert (done.returncode, done.stderr) == (143, SAID)


WORK = {
    "a library turns it into its own error: Python wraps exceptions that are raised while a class is created": """
class Thing:
    def __set_name__(self, owner, name):
        signal.raise_signal(signal.SIGINT)
def work(words):
    class Owner:
        thing = Thing()
""",
    "in a finalizer, whose exceptions Python prints and ignores; numba and torch have such during imports": """
class Thing: pass
def work(words):
    thing = Thing()
    watch = weakref.ref(thing, lambda _: signal.raise_signal(signal.SIGINT))
    del thing
    time.sleep(30)
""",
    "at exit": """
atexit.register(lambda: signal.raise_signal(signal.SIGINT))
def work(words): pass
""",
}


@pytest.mark.parametrize("moment", WORK)
def test_an_interrupt_is_never_lost(moment):
    begin = "import atexit, signal, time, weakref; from kissgs.cli import app, main"
    done = _python(f"{begin}\n{WORK[moment]}\napp.app = work\nmain.main()")
    assert (done.returncode, done.stderr) == (130, SAID)


def test_no_module_is_imported_before_signals_are_handled():
    """Only modules that Python loads itself, and those of kissgs that handle signals."""
    bare = set(_python("import re, signal, sys; print(*sys.modules)").stdout.split())
    ours = set(_python("import re, signal, sys; import kissgs.cli.main; print(*sys.modules)").stdout.split())
    assert ours - bare <= {
        *("__future__", "kissgs", "kissgs._version", "kissgs.cli", "kissgs.cli.main", "kissgs.cli.interrupts")
    }


def _python(program):
    return subprocess.run(
        [sys.executable, "-P", "-c", program],
        env=os.environ | {"PYTHONPATH": HOME},
        capture_output=True,
        text=True,
        timeout=300,
        check=False,
    )


def test_help_loads_nothing_heavy():
    heavy = ("numpy", "numba", "torch", "scipy", "PIL", "kissgs.settings")
    program = f"""
import atexit, sys
from kissgs.cli.main import main
atexit.register(lambda: print([name for name in {heavy} if name in sys.modules]))
sys.argv[1:] = ["compress", "--help"]
main()
"""
    assert _python(program).stdout.splitlines()[-1] == "[]"
