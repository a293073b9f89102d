"""The real splat-transform, if scripts/setup dev has installed it; it may hang after it has written its output."""

import contextlib
import subprocess
import time
from pathlib import Path

import pytest

from helpers.web_tools import node

TOOL = Path(__file__).parents[2] / "web_decoder/node_modules/.bin/splat-transform"

SECONDS = 60

needs_splat_transform = pytest.mark.skipif(not TOOL.exists(), reason="scripts/setup dev installs splat-transform")


def convert(source, target, *options):
    """Convert a scene; a tool that hangs is ended, and its output counts if its size no longer changes."""
    target.parent.mkdir(parents=True, exist_ok=True)
    call = [node(), str(TOOL), "-g", "cpu", "-w", "-q", *options, str(source), str(target)]
    process = subprocess.Popen(call, stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE)
    try:
        _, errors = process.communicate(timeout=SECONDS)
        assert process.returncode == 0, errors.decode(errors="replace")
    except subprocess.TimeoutExpired:
        sizes = []
        for _ in range(2):
            sizes.append(target.stat().st_size if target.exists() else 0)
            time.sleep(0.5)
        assert sizes[0] == sizes[1] > 0, "splat-transform hangs and has written nothing"
    finally:
        with contextlib.suppress(ProcessLookupError):
            process.kill()
        process.communicate()
    return target
