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
ERRORS = {
    "clean": "of the cleaned scene; opacities for logits, values above 1 relative",
    "fast": "of the decoded scene, in the report's `max_quantization_error`",
    "balanced": "the same",
    "decode": "of decoded values, in ranges of their attribute",
    "image": "of a pixel, relative to the brightest above 1",
    "gradient": "relative to the largest of its kind (or to 1e-4 of the largest of all)",
    "score": "of a removal score, relative to the largest",
    "rank": "of the effective-rank loss and its gradient",
    "step": "of three steps of training, in learning rates",
    "levels": "levels that differ from fine-tuning's",
    "browser": "of the JavaScript decoder's floats, in ulps",
}
"""Meaning of the error of each stage."""

sys.path.append(str(ROOT / "tests"))

from helpers.extreme_stages import measured  # noqa: E402
from helpers.extremes import BOUNDS, EXTREMES, KEPT  # noqa: E402


def errors(measure: Callable[[str, str], float]) -> str:
    """Return a table of the largest error of each stage, and of those rows that have a bound of their own."""
    lines = ["| column | error | promised | largest | at |", "|---|---|---|---|---|"]
    for stage, bound in BOUNDS.items():
        usual = {extreme.name: measure(extreme.name, stage) for extreme in EXTREMES if stage not in extreme.bounds}
        worst = max(usual, key=lambda name: usual[name])
        lines.append(line(stage, bound, usual[worst], worst))
        own = {extreme.name: extreme.bounds[stage] for extreme in EXTREMES if stage in extreme.bounds}
        lines += [line(stage, own[name], measure(name, stage), name) for name in own]
    return "\n".join(lines) + "\n"


def rows() -> str:
    """Return a table of what happens to each row that is not kept as it is, and a list of the others."""
    lines = ["| row | given | promise |", "|---|---|---|"]
    lines += [f"| `{row.name}` | {row.given} | {row.promise} |" for row in EXTREMES if row.promise != KEPT]
    kept = [f"- `{row.name}`: {row.given}" for row in EXTREMES if row.promise == KEPT]
    return "\n".join([*lines, "", f"{KEPT.capitalize()}:", "", *kept]) + "\n"


def line(stage: str, bound: float, error: float, name: str) -> str:
    """Return a line of the table of errors."""
    return f"| `{stage}` | {ERRORS[stage]} | ≤ {figure(bound)} | {figure(error)} | `{name}` |"


def figure(value: float) -> str:
    """Return a number as text with at most two digits."""
    if value == 0 or 0.01 <= value < 100:
        return f"{value:.2g}"
    digits, exponent = f"{value:.1e}".split("e")
    return f"{digits.removesuffix('.0')}e{int(exponent)}"


def main() -> None:
    """Measure everything, and replace the part of the page between its marks."""
    before, _, rest = PAGE.read_text(encoding="utf-8").partition(BEGIN)
    written = errors(measured) + "\n" + rows()
    PAGE.write_text(before + BEGIN + written + END + rest.partition(END)[2], encoding="utf-8")


if __name__ == "__main__":
    main()
