"""Entry point of ``kissgs``: handles Ctrl-C before the slow imports begin."""

from __future__ import annotations

import io
import os
import sys

from kissgs.cli.interrupts import exit_on_signal


def main() -> None:
    """Run the command line. Exit code 2 with one line for errors that a user can cause, 130 on Ctrl-C."""
    exit_on_signal()
    if isinstance(sys.stdout, io.TextIOWrapper):  # None if closed. A name that it cannot encode must not end the work
        sys.stdout.reconfigure(errors="backslashreplace")
    # torch's threads otherwise spin while the rasteriser's own threads work: a sixth of the time of a training step
    os.environ.setdefault("OMP_WAIT_POLICY", "passive")
    from kissgs.cli.app import run

    run()
