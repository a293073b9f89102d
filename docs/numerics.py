"""Measure every stage at every extreme (tests/extremes), and write the table into numerics.md: python docs/numerics.py.

The figures are this machine's, so no test compares them with others: they must only keep what is promised.
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from pathlib import Path

ROOT = Path(__file__).parents[1]
PAGE = ROOT / "docs" / "numerics.md"
BEGIN, END = "<!-- measured -->\n", "<!-- end -->\n"

sys.path.append(str(ROOT / "tests"))

from helpers.extreme_stages import measured  # noqa: E402
from helpers.extremes import BOUNDS, EXTREMES  # noqa: E402


def table(measure: Callable[[str, str], float]) -> str:
    """A row for each extreme, with what ``measure`` finds at each stage; the first says what is promised."""
    lines = [f"| row | given | promise | {' | '.join(BOUNDS)} |", "|---" * (3 + len(BOUNDS)) + "|"]
    lines.append(f"|  |  | unless said otherwise | {' | '.join(f'≤ {figure(bound)}' for bound in BOUNDS.values())} |")
    for extreme in EXTREMES:
        found = [cell(measure(extreme.name, stage), extreme.bounds.get(stage)) for stage in BOUNDS]
        lines.append(f"| `{extreme.name}` | {extreme.given} | {extreme.promise} | {' | '.join(found)} |")
    return "\n".join(lines) + "\n"


def cell(value: float, bound: float | None) -> str:
    """With the bound, where that is the row's own."""
    return figure(value) + ("" if bound is None else f" ≤ {figure(bound)}")


def figure(value: float) -> str:
    """With two digits at most."""
    if value == 0 or 0.01 <= value < 100:
        return f"{value:.2g}"
    digits, exponent = f"{value:.1e}".split("e")
    return f"{digits.removesuffix('.0')}e{int(exponent)}"


def main() -> None:
    """Measure all, and replace what the page has between its marks."""
    before, _, rest = PAGE.read_text(encoding="utf-8").partition(BEGIN)
    PAGE.write_text(before + BEGIN + table(measured) + END + rest.partition(END)[2], encoding="utf-8")


if __name__ == "__main__":
    main()
