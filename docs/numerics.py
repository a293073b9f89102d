"""Measure every stage at every extreme (tests/extremes): ``python docs/numerics.py`` writes docs/reference/numerics.md.

The figures depend on the machine, so no test compares them with those of another: they must stay within the bounds.
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from pathlib import Path

ROOT = Path(__file__).parents[1]
PAGE = ROOT / "docs" / "reference" / "numerics.md"
BEGIN, END = "<!-- measured -->\n", "<!-- end -->\n"

sys.path.append(str(ROOT / "tests"))

from helpers.extreme_stages import measured  # noqa: E402
from helpers.extremes import BOUNDS, EXTREMES  # noqa: E402


def table(measure: Callable[[str, str], float]) -> str:
    """Return a table with a row of bounds, then a row per extreme with the errors that ``measure`` finds."""
    lines = [f"| row | given | promise | {' | '.join(BOUNDS)} |", "|---" * (3 + len(BOUNDS)) + "|"]
    lines.append(f"|  |  | unless said otherwise | {' | '.join(f'≤ {figure(bound)}' for bound in BOUNDS.values())} |")
    for extreme in EXTREMES:
        found = [cell(measure(extreme.name, stage), extreme.bounds.get(stage)) for stage in BOUNDS]
        lines.append(f"| `{extreme.name}` | {extreme.given} | {extreme.promise} | {' | '.join(found)} |")
    return "\n".join(lines) + "\n"


def cell(value: float, bound: float | None) -> str:
    """Return an error as text, followed by its bound where the row has a bound of its own."""
    return figure(value) + ("" if bound is None else f" ≤ {figure(bound)}")


def figure(value: float) -> str:
    """Return a number as text with at most two digits."""
    if value == 0 or 0.01 <= value < 100:
        return f"{value:.2g}"
    digits, exponent = f"{value:.1e}".split("e")
    return f"{digits.removesuffix('.0')}e{int(exponent)}"


def main() -> None:
    """Measure everything, and replace the part of the page between its marks."""
    before, _, rest = PAGE.read_text(encoding="utf-8").partition(BEGIN)
    PAGE.write_text(before + BEGIN + table(measured) + END + rest.partition(END)[2], encoding="utf-8")


if __name__ == "__main__":
    main()
