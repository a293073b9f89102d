"""``kissgs-serve``, where its packages are installed; ``python -m service`` in a checkout."""

from __future__ import annotations

import io
import sys


def main() -> None:
    """Entry point."""
    if isinstance(sys.stdout, io.TextIOWrapper):  # None if closed. Not every encoding has all characters of the help
        sys.stdout.reconfigure(errors="backslashreplace")
    try:
        from .cli import run
    except ModuleNotFoundError as error:
        sys.stderr.write(
            f"kissgs-serve: the package {error.name} is missing: run pip install '.[service]' in a checkout of kissgs\n"
        )
        sys.exit(2)
    run()


if __name__ == "__main__":
    main()
