"""The documentation is true; reference: the code, the files and the headings that it names."""

import argparse
import importlib
import re
import runpy
import shlex
import subprocess
import sys
from pathlib import Path

import pytest
import typer.main

from kissgs import Preset, Settings
from kissgs.cli.app import app
from kissgs.settings import PRESETS, TrainingViewSettings
from kissgs.sogxt import FILES
from service.core.presets import presets

ROOT = Path(__file__).parents[1]
GENERATED = runpy.run_path(str(ROOT / "docs" / "generate.py"))["PAGES"]
FOLDERS = ("kissgs/", "service/", "bench/", "web_decoder/", "tests/", "docs/", "scripts/", "docker/", ".ci/")


def pages():
    """Every Markdown file that git tracks, or all outside of hidden and installed folders where there is no git."""
    listed = subprocess.run(["git", "ls-files", "*.md"], cwd=ROOT, capture_output=True, text=True, check=False)
    names = listed.stdout.split() or [str(path.relative_to(ROOT)) for path in ROOT.glob("docs/**/*.md")] + ["README.md"]
    return [ROOT / name for name in names if (ROOT / name).is_file()]


def prose(page):
    """The text of a page without its code blocks."""
    return re.sub(r"^```.*?^```$", "", page.read_text(encoding="utf-8"), flags=re.MULTILINE | re.DOTALL)


def anchors(page):
    """The anchors of a page's headings, as GitHub makes them."""
    found = set()
    for heading in re.findall(r"^#{1,6} (.+)$", prose(page), re.MULTILINE):
        text = re.sub(r"\[([^\]]*)\]\([^)]*\)", r"\1", heading).lower()
        anchor = re.sub(r"[^\w\- ]", "", text).strip().replace(" ", "-")
        while anchor in found:
            anchor += "-1"
        found.add(anchor)
    return found


@pytest.mark.parametrize("name", GENERATED)
def test_generated_pages_are_up_to_date(name):
    assert (ROOT / "docs" / "reference" / name).read_text(encoding="utf-8") == GENERATED[name](), "run: make docs"


def test_the_format_page_names_every_file():
    page = (ROOT / "docs" / "reference" / "format.md").read_text(encoding="utf-8")
    assert [name for name in FILES if name not in page] == []


def test_the_readme_is_short_and_starts_with_a_command():
    lines = (ROOT / "README.md").read_text(encoding="utf-8").splitlines()
    assert len(lines) <= 90
    assert "make demo" in "".join(lines[:10])
    table = "\n".join(lines)
    assert [preset for preset in Preset if f"| `{preset}` |" not in table] == []


def test_commands_of_the_readme_can_be_repeated():
    """Whatever writes a file overwrites it, and every file that is read was written before."""
    readme = (ROOT / "README.md").read_text(encoding="utf-8")
    blocks = re.findall(r"^```sh\n(.*?)^```$", readme, re.MULTILINE | re.DOTALL)
    commands = [line.partition("#")[0].split() for block in blocks for line in block.splitlines()]
    written = set()
    writing = {"sample", "compress", "decompress", "render"}
    for command in commands:
        if command[:1] != ["kissgs"]:
            continue
        named = [word for word in command if re.fullmatch(r"[\w-]+\.(ply|zip|png|webp|html)", word)]
        new = named if command[1] == "sample" else [command[command.index("-o") + 1]] if "-o" in command else []
        assert set(named) - set(new) <= written, command
        assert command[1] not in writing or ("--force" in command and new), command
        written |= set(new)
    assert written


def documented_measurements():
    """The words of every ``kissgs bench`` and ``python bench/…`` command, in code blocks and in running text."""
    found = []
    for page in pages():
        text = page.read_text(encoding="utf-8")
        lines = re.findall(r"^(?:\$ )?(kissgs bench .*|python bench/.*)$", text, re.MULTILINE)
        inline = re.findall(r"`(kissgs bench [^`]*|python bench/[^`]*)`", prose(page))
        found += [shlex.split(line, comments=True) for line in lines + inline]
    return found


def test_documented_measurements_are_accepted(monkeypatch):
    """Every study is documented."""

    class Parsed(Exception):
        pass

    def parse(parser):
        parse_known(parser, sys.argv[1:])
        raise Parsed

    parse_known = argparse.ArgumentParser.parse_args
    monkeypatch.setattr(argparse.ArgumentParser, "parse_args", parse)
    monkeypatch.setattr("bench.common.load_views", lambda path: None)
    studies = set()
    for command, target, *words in documented_measurements():
        if command == "kissgs":
            typer.main.get_command(app).commands["bench"].make_context("bench", words)  # type: ignore[attr-defined]
            continue
        study = importlib.import_module(target.removesuffix(".py").replace("/", "."))
        studies.add(Path(target).stem)
        monkeypatch.setattr(sys, "argv", [target, *words])
        with pytest.raises(Parsed):
            study.main()
    shared = {"__init__", "common", "curves", "external", "paper_parts", "paper_points"}
    assert studies == {path.stem for path in ROOT.glob("bench/*.py")} - shared


def test_links_and_anchors_lead_somewhere():
    checked = 0
    for page in pages():
        for target, _, anchor in re.findall(r"\]\((?!https?:)([^)#\s]*)(#([^)\s]*))?\)", prose(page)):
            aim = (page.parent / target).resolve() if target else page
            assert aim.exists(), f"{page.relative_to(ROOT)} links to {target}"
            if anchor and aim.suffix == ".md":
                assert anchor in anchors(aim), f"{page.relative_to(ROOT)} links to {target}#{anchor}"
            checked += 1
    assert checked > 50


def test_files_that_pages_name_exist():
    for page in pages():
        named = re.findall(r"`([\w./-]+/[\w./-]*)`", prose(page))
        missing = [name for name in named if name.startswith(FOLDERS) and not (ROOT / name).exists()]
        assert [name for name in missing if name != "web_decoder/vendor"] == [], page.relative_to(ROOT)


def test_no_page_is_left_unfinished():
    for page in pages():
        unfinished = re.findall(
            r"^[A-Z_]{6,}$|TODO|FIXME|[A-Z]{4,}SSIM", page.read_text(encoding="utf-8"), re.MULTILINE
        )
        assert not unfinished, f"{page.name}: {unfinished}"


def test_presets_of_the_service_have_the_figures_of_the_benchmarks():
    """Without cameras, as the service compresses: bytes per Gaussian and the change of PSNR to photographs."""
    text = (ROOT / "docs" / "benchmarks.md").read_text(encoding="utf-8").partition("### Without the capture")[2]
    text = text.partition("\n#")[0]
    for facts in presets().presets:
        (row,) = re.findall(rf"^\| `{facts.name}` \| (.*)$", text, re.MULTILINE)
        cells = [cell.strip() for cell in row.split("|")]
        assert (cells[1], cells[4]) == (f"{facts.bytes_per_gaussian:.2f}", f"{facts.psnr_change:.2f}")


def shown(preset, group, name):
    """The value of a setting as the page on the paper writes it."""
    value = getattr(getattr(Settings.from_preset(preset), group), name)
    if isinstance(value, list):
        return " and ".join(f"{each:g}" for each in value) or "none"
    if value is None or isinstance(value, bool):
        return {True: "yes", False: "no", None: "auto"}[value]
    return value if isinstance(value, str) else f"{value:.6g}"


def test_the_page_on_the_paper_has_the_values_of_the_presets():
    """Values that the paper gives are those of ``paper``, and every value that sets this preset apart is listed."""
    page = (ROOT / "docs" / "method" / "paper.md").read_text(encoding="utf-8")
    listed = set()
    for row in re.findall(r"^\| `.*$", page, re.MULTILINE):
        cells = [cell.strip() for cell in row.split("|")[1:-1]]
        names, group = re.findall(r"`([^`]*)`", cells[0]), ""
        for at, name in enumerate(names):
            group, name = name.split(".") if "." in name else (group, name)
            given, paper, balanced = (re.sub(r" \(.*\)", "", cell).split(", ")[at] for cell in cells[1:4])
            assert (paper, balanced) == (shown("paper", group, name), shown("balanced", group, name)), name
            assert given in ("-", paper), name
            listed.add((group, name))
            if name in TrainingViewSettings.model_fields and shown("paper", "finetune", name) == paper:
                listed.add(("finetune", name))
    own = {(group, name) for group, values in PRESETS[Preset.PAPER].items() for name in values}
    assert own <= listed, "add it to docs/method/paper.md"


def test_the_page_expects_what_goals_with_photographs_have_reached():
    """These are bytes per Gaussian of fox, and the change of PSNR to its photographs."""
    text = (ROOT / "docs" / "method" / "rate-distortion.md").read_text(encoding="utf-8")
    section = text.partition("### With photographs")[2].partition("\n###")[0]
    row = r"^\| `--(?:quality|max-psnr-drop) ([\w.]+)` \| ([\d,]+) \| ([\d.]+) dB"
    page = (ROOT / "service" / "static" / "expected.js").read_text(encoding="utf-8")
    figures = re.findall(
        r'\["([\w.]+)", ([\d.]+), (-?[\d.]+)\]', page.partition("photographs: [")[2].partition("\n  ],")[0]
    )
    expected = {goal: (float(size), float(change)) for goal, size, change in figures}
    rows = re.findall(row, section, re.MULTILINE)
    assert len(rows) == 4
    for goal, size, psnr in rows:
        found = int(size.replace(",", "")) / 79_451, float(psnr) - 32.09
        assert expected[goal] == pytest.approx(found, abs=0.006), goal


def test_docker_gets_every_file_that_it_copies():
    """Regression: scripts/install_torch was copied, but not sent to the builder."""
    sent = set(re.findall(r"^!(.*)$", (ROOT / ".dockerignore").read_text(), re.MULTILINE))
    lines = re.findall(r"^COPY (?!--from)(?:--\S+ )*(.*)$", (ROOT / "docker" / "Dockerfile").read_text(), re.MULTILINE)
    copied = {source for line in lines for source in line.split()[:-1]}
    assert {"kissgs", "scripts/install_torch"} <= copied
    assert [source for source in sorted(copied) if source not in sent and source.split("/")[0] not in sent] == []
