"""The documentation tells the truth; oracle: the code it describes."""

from __future__ import annotations

import re
import runpy
from pathlib import Path

import pytest

from kissgs import Preset
from kissgs.sogxt.names import FILES

ROOT = Path(__file__).parents[1]
PAGES = runpy.run_path(str(ROOT / "docs" / "generate.py"))["PAGES"]


@pytest.mark.parametrize("name", PAGES)
def test_generated_pages_are_up_to_date(name: str) -> None:
    assert (ROOT / "docs" / name).read_text(encoding="utf-8") == PAGES[name](), "run: make docs"


def test_the_format_page_names_every_file() -> None:
    page = (ROOT / "docs" / "format.md").read_text(encoding="utf-8")
    assert [name for name in FILES if name not in page] == []


def test_the_readme_starts_with_what_to_type() -> None:
    lines = (ROOT / "README.md").read_text(encoding="utf-8").splitlines()
    assert "make demo" in "".join(lines[:10])
    assert "make test" in "".join(lines[:10])
    table = "\n".join(lines)
    assert [preset for preset in Preset if f"| `{preset}` |" not in table] == []


def test_links_lead_somewhere() -> None:
    for page in (ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))):
        for target in re.findall(r"\]\((?!https?:)([^)#]+)\)", page.read_text(encoding="utf-8")):
            assert (page.parent / target).exists(), f"{page.name} links to {target}"


def test_no_page_is_left_unfinished() -> None:
    for page in (ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))):
        unfinished = re.findall(
            r"^[A-Z_]{6,}$|TODO|FIXME|[A-Z]{4,}SSIM", page.read_text(encoding="utf-8"), re.MULTILINE
        )
        assert not unfinished, f"{page.name}: {unfinished}"
