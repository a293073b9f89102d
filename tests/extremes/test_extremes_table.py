"""Every stage at every extreme. Oracle: reference implementations in float64 (tests/helpers/reference_*.py)."""

import re
import runpy
from pathlib import Path

import pytest
from helpers.extreme_containers import BY_NAME
from helpers.extreme_stages import STAGES, measured
from helpers.extremes import BOUNDS, EXTREMES

ROOT = Path(__file__).parents[2]
PAGE = ROOT / "docs" / "reference" / "numerics.md"
NAMES = list(BY_NAME)
HERE = [stage for stage in STAGES if stage != "browser"]


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.quick(24)
def test_every_stage_keeps_its_promise(name):
    bound = BY_NAME[name].bound
    assert {stage: measured(name, stage) for stage in HERE if not measured(name, stage) <= bound(stage)} == {}


def test_the_javascript_decoder_keeps_its_promise():
    """One process of Node decodes all rows."""
    assert {name: measured(name, "browser") for name in NAMES if measured(name, "browser") > BOUNDS["browser"]} == {}


def test_names_are_unique_and_rows_have_bounds_of_stages():
    assert len(BY_NAME) == len(EXTREMES)
    assert set(BOUNDS) == set(STAGES)
    assert all(set(extreme.bounds) <= set(STAGES) for extreme in EXTREMES)


def between_the_marks():
    """Return what ``python docs/numerics.py`` has written into the page."""
    return PAGE.read_text(encoding="utf-8").partition("<!-- measured -->\n")[2].partition("<!-- end -->")[0]


def test_the_page_has_every_stage_within_what_is_promised():
    found = re.findall(r"^\| `(\w+)` \| .+ \| ≤ (\S+) \| (\S+) \| `(.+)` \|$", between_the_marks(), re.MULTILINE)
    own = [(stage, bound) for extreme in EXTREMES for stage, bound in extreme.bounds.items()]
    assert sorted((stage, float(bound)) for stage, bound, _, _ in found) == sorted([*BOUNDS.items(), *own])
    for stage, _, largest, name in found:
        assert float(largest) <= BY_NAME[name].bound(stage), f"{name}, {stage}"


def test_the_page_has_every_row():
    rows = runpy.run_path(str(ROOT / "docs" / "numerics.py"))["rows"]()
    assert between_the_marks().endswith(rows), "run: python docs/numerics.py"


def test_every_promise_of_the_page_names_a_test_that_exists():
    """The parentheses at the end of each line of the lists: `file::test`, several with commas."""
    lists = PAGE.read_text(encoding="utf-8").partition("<!-- end -->")[2]
    promises = re.findall(r"^- .+(?:\n  .+)*", lists, re.MULTILINE)
    assert len(promises) > 20
    for promise in promises:
        named = re.findall(r"`(\w+)::(\w+)`", promise.rpartition("(")[2])
        assert named, promise
        for module, function in named:
            files = [file.read_text(encoding="utf-8") for file in (ROOT / "tests").glob(f"**/{module}.py")]
            assert sum(f"def {function}(" in text for text in files) == 1, f"{module}::{function}"
