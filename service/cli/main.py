"""``kissgs-serve``, where its packages are installed."""

from __future__ import annotations

import sys


def main() -> None:
    """Entry point."""
    try:
        from .commands import run
    except ModuleNotFoundError as error:
        sys.stderr.write(f"kissgs-serve: the package {error.name} is missing: pip install 'kissgs[service]'\n")
        sys.exit(2)
    run()
