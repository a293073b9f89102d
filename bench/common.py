"""Arguments of studies, tables in Markdown, and bytes at equal quality."""

from __future__ import annotations

import argparse
import math
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from kissgs import EncodeSettings, KissgsError, Settings, Views, load_views
from kissgs.settings import GOALS

Curve = Sequence[tuple[float, float]]
"""Points (quality, bytes) in any order."""


def parser_of(about: str | None) -> argparse.ArgumentParser:
    """Return a parser; ``about`` is the docstring of the module."""
    return argparse.ArgumentParser(description=about, formatter_class=argparse.RawDescriptionHelpFormatter)


def arguments(about: str | None) -> argparse.ArgumentParser:
    """Return a parser with a scene and a capture, which most studies need."""
    parser = parser_of(about)
    parser.add_argument("scene", type=Path)
    parser.add_argument("--views", type=capture, metavar="DATA", help="capture with cameras and photographs")
    return parser


def capture(path: str) -> Views:
    """Return the capture in a folder."""
    try:
        return load_views(Path(path))
    except KissgsError as error:
        raise argparse.ArgumentTypeError(str(error)) from error


def training_views(views: Views, source: str) -> Views:
    """Return views to train by ``photos``, ``cameras`` or ``scene``, and to evaluate by the held-out ones, or all."""
    if source == "photos":
        return views
    bare = tuple(replace(view, photo=None) for view in views.train) if source == "cameras" else ()
    return replace(views, train=bare, test=views.test or views.train)


def positive(text: str) -> int:
    """Return a whole number of at least 1."""
    number = int(text)
    if number < 1:
        raise ValueError
    return number


def fraction(text: str) -> float:
    """Return a number above 0 and up to 1."""
    number = float(text)
    if not 0 < number <= 1:
        raise ValueError
    return number


def run(study: Callable[[], None]) -> None:
    """Run a study; an error of the library or the system becomes one sentence."""
    try:
        study()
    except (KissgsError, OSError) as error:
        raise SystemExit(f"{Path(sys.argv[0]).name}: {error}") from error


def at_quality_offset(settings: Settings, decibels: float) -> Settings:
    """Return settings with rate-distortion planning at another quality offset, without a lambda or a goal."""
    changes = {"quality_offset_db": decibels, "rd_lambda": None, **dict.fromkeys(GOALS)}
    return with_changes(settings, changes)


def with_changes(settings: Settings, changes: Mapping[str, object]) -> Settings:
    """Return settings with other values of the encoder's settings."""
    encode = EncodeSettings(**{**settings.encode.model_dump(), **changes})
    return settings.model_copy(update={"encode": encode})


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
    write("| " + " | ".join(f"{cell:,}" if isinstance(cell, int) else str(cell) for cell in cells) + " |")


def signed(value: float | None, digits: int = 2) -> str:
    """Return a difference as text; empty for None."""
    return "" if value is None else f"{value:+.{digits}f}"


def percent(share: float | None) -> str:
    """Return a change as a signed percentage; empty for None."""
    return "" if share is None else f"{100 * share:+.1f} %"


def bytes_at(curve: Curve, quality: float) -> float | None:
    """Return the bytes at this quality, their logarithm interpolated linearly; None beyond the ends of the curve."""
    x, y = _sorted(curve)
    if not len(x) or not x[0] <= quality <= x[-1]:
        return None
    return float(np.exp(np.interp(quality, x, y)))


def saving(curve: Curve, other: Curve) -> float | None:
    """Return the share of bytes that ``other`` saves at equal quality, on average; negative if it needs more.

    The Bjøntegaard delta rate (VCEG-M33), negated, with linear interpolation: the mean difference of the logarithms of
    bytes over the range of quality that both curves cover. None if there is no such range.
    """
    (x0, y0), (x1, y1) = _sorted(curve), _sorted(other)
    low = max(x.min(initial=np.inf) for x in (x0, x1))
    high = min(x.max(initial=-np.inf) for x in (x0, x1))
    if not low < high:
        return None
    grid = np.linspace(low, high, 1001)
    return 1 - float(np.exp(np.mean(np.interp(grid, x1, y1) - np.interp(grid, x0, y0))))


def _sorted(curve: Curve) -> tuple[np.ndarray, np.ndarray]:
    """Return ascending finite qualities, and the logarithms of the bytes."""
    kept = sorted((quality, math.log(size)) for quality, size in curve if math.isfinite(quality))
    return np.array([q for q, _ in kept]), np.array([b for _, b in kept])
