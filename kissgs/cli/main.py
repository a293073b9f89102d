"""Entry point of ``kissgs``: handles Ctrl-C before the slow imports begin."""

from __future__ import annotations

from kissgs.cli.interrupts import exit_on_signal


def main() -> None:
    """Run the command line. Exit code 2 with one line for errors that a user can cause, 130 on Ctrl-C."""
    exit_on_signal()
    from kissgs.cli.app import run

    run()
