"""Arguments and inputs of studies, and tables in Markdown."""

from __future__ import annotations

import argparse
import hashlib
import sys
from collections.abc import Callable, Sequence
from functools import cache
from pathlib import Path

from kissgs import KissgsError, load_views


def parser_of(about: str | None) -> argparse.ArgumentParser:
    """Return a parser; ``about`` is the docstring of the module."""
    return argparse.ArgumentParser(description=about, formatter_class=argparse.RawDescriptionHelpFormatter)


def parser_with_views(about: str | None) -> argparse.ArgumentParser:
    """Return a parser with a capture, which most studies take."""
    parser = parser_of(about)
    parser.add_argument("--views", type=lambda folder: load_views(Path(folder)), metavar="DATA", help="capture")
    return parser


views_of = cache(load_views)


@cache
def digest_of(path: Path) -> str:
    """Return the hash of a file."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


@cache
def digest_of_capture(path: Path) -> str:
    """Return the hash of all cameras and photographs of a capture, and of what else renderings depend on."""
    views = views_of(path)
    digest = hashlib.sha256(f"{views.background} {[each.matrix.tolist() for each in views.similarities]}".encode())
    for role, each in (("train", views.train), ("test", views.test)):
        for view in each:
            photo = "" if view.photo is None else digest_of(view.photo)
            geometry = view.camera.viewmat.tolist(), view.camera.K.tolist(), view.undistortion, view.background
            digest.update(f"{role} {view.name} {photo} {geometry}".encode())
    return digest.hexdigest()


def positive(text: str) -> int:
    """Return a whole number of at least 1."""
    number = int(text)
    if number < 1:
        raise ValueError
    return number


def run(study: Callable[[], None]) -> None:
    """Run a study; an error of the library or the system becomes one sentence, and exit status 2."""
    try:
        study()
    except KeyboardInterrupt:
        sys.stderr.write("stopped; run it again to go on\n")
        raise SystemExit(130) from None
    except (KissgsError, OSError) as error:
        sys.stderr.write(f"{Path(sys.argv[0]).name}: {error}\n")
        raise SystemExit(2) from error


def write(*lines: str) -> None:
    """Print lines at once."""
    sys.stdout.write("".join(f"{line}\n" for line in lines))
    sys.stdout.flush()


def head(*names: str) -> None:
    """Print the head of a table."""
    row(*names)
    write("|" + "---|" * len(names))


def row(*cells: object) -> None:
    """Print a row of a table: numbers with thousands separators, other texts as they are."""
    write(_line(cells))


def markdown(head: Sequence[str], rows: Sequence[Sequence[object]]) -> str:
    """Return a table without its empty columns; empty if it has no rows."""
    kept = [number for number in range(len(head)) if any(row[number] != "" for row in rows)]
    lines = [[cells[number] for number in kept] for cells in (head, *rows)]
    lines.insert(1, ["---"] * len(kept))
    return "".join(f"{_line(cells)}\n" for cells in lines) if rows else ""


def _line(cells: Sequence[object]) -> str:
    return (
        "| "
        + " | ".join(f"{cell:,}" if isinstance(cell, int) else str(cell).replace("|", "\\|") for cell in cells)
        + " |"
    )


def signed(value: float | None, digits: int = 2) -> str:
    """Return a difference as text; empty for None."""
    return "" if value is None else f"{value:+.{digits}f}"


def percent(share: float | None) -> str:
    """Return a change as a signed percentage; empty for None."""
    return "" if share is None else f"{100 * share:+.1f} %"
