"""The entry point ``kissgs``: it listens for Ctrl-C before it imports what takes a while to load."""

from __future__ import annotations

from kissgs.cli.interrupts import leave_when_told


def main() -> None:
    """Do what the command line says. Errors a user can cause end in one line and exit code 2, Ctrl-C in 130."""
    leave_when_told()
    from kissgs.cli.app import run

    run()
