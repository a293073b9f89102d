"""The command ``kissgs`` as a user runs it."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

KISSGS = Path(sys.executable).with_name("kissgs")


def run(*words: object, stdin: bytes = b"", cwd: Path | None = None) -> subprocess.CompletedProcess[bytes]:
    return subprocess.run(
        [KISSGS, *map(str, words)], input=stdin, capture_output=True, cwd=cwd, timeout=120, check=False
    )


def failure(*words: object, stdin: bytes = b"", cwd: Path | None = None) -> str:
    """Run what must fail: exit code 2, one line, no traceback. Returns the line."""
    done = run(*words, stdin=stdin, cwd=cwd)
    assert done.returncode == 2, done
    lines = done.stderr.decode().splitlines()
    assert len(lines) == 1, lines
    assert lines[0].startswith("kissgs: ")
    return lines[0]
