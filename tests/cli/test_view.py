"""``kissgs view``; reference: the scene and the page that it is given."""

import os
import re
import signal
import subprocess
import urllib.request

import pytest
from helpers.command_line import KISSGS, failure, run

import kissgs
from kissgs import preview as page_files
from kissgs.streaming import build


@pytest.fixture
def scene(tmp_path):
    path = tmp_path / "scene.zip"
    kissgs.compress(kissgs.sample_scene(65, sh_degree=1), path, settings=kissgs.Settings(preset="fast"))
    return path


needs_viewer = pytest.mark.skipif(
    not (page_files.ROOT / "web_decoder" / "vendor").exists(), reason="scripts/vendor has not run"
)


@needs_viewer
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
@pytest.mark.quick(1)
def test_it_serves_until_a_signal(scene, number):
    environment = {**os.environ, "DISPLAY": ""}
    words = [KISSGS, "view", scene, "--no-browser"]
    with subprocess.Popen(words, stdout=subprocess.PIPE, stderr=subprocess.PIPE, env=environment) as process:
        address = re.fullmatch(
            r"(http://127\.0\.0\.1:\d+/)\?src=(\S+)  \(Ctrl-C ends\)\n", process.stdout.readline().decode()
        )
        with urllib.request.urlopen(address[1] + address[2]) as answer:
            assert answer.read() == scene.read_bytes()
        process.send_signal(number)
        assert process.communicate(timeout=30) == (b"", b"")
        assert process.returncode == 0


@needs_viewer
def test_a_page(tmp_path, scene):
    page = tmp_path / "page.html"
    done = run("view", scene, "-o", page)
    assert (done.returncode, done.stderr) == (0, b"")
    assert done.stdout.decode().split() == [str(page), f"{page.stat().st_size:,}", "bytes,", "holds", "scene.zip"]
    assert "exists already" in failure("view", scene, "-o", page)
    before = page.read_bytes()
    assert run("view", "-", "-o", page, "--force", "--quiet", stdin=scene.read_bytes()).stdout == b""
    assert page.read_bytes() == before


@needs_viewer
def test_a_page_of_a_ply(tmp_path):
    kissgs.save(kissgs.sample_scene(65, sh_degree=0), tmp_path / "scene.ply")
    done = run("view", tmp_path / "scene.ply", "-o", tmp_path / "page.html")
    assert re.search(r"holds scene\.zip, compressed by the preset balanced to [\d,]+\s+bytes", done.stdout.decode())


@pytest.fixture
def city(tmp_path, monkeypatch):
    """A streamed scene of few Gaussians and several levels."""
    folder = tmp_path / "streamed"
    monkeypatch.setattr(build, "COARSEST", 50)
    kissgs.save(kissgs.sample_scene(200, sh_degree=0), tmp_path / "large.ply")
    kissgs.compress_streamed(tmp_path / "large.ply", folder / "lod-meta.json", settings=kissgs.Settings(preset="fast"))
    return folder


@needs_viewer
@pytest.mark.quick(0)
def test_a_streamed_scene(tmp_path, city):
    """The files of its folder are served one by one; ``--level`` and ``-o`` show one level, which was decoded."""
    environment = {**os.environ, "DISPLAY": ""}

    def served(*options):
        words = [KISSGS, "view", city, "--no-browser", *options]
        with subprocess.Popen(words, stdout=subprocess.PIPE, stderr=subprocess.PIPE, env=environment) as process:
            base, query = re.match(r"(http://[\d.:]+/)\?src=(\S+)", process.stdout.readline().decode()).groups()
            with urllib.request.urlopen(base + query) as answer:
                content = answer.read()
            process.send_signal(signal.SIGINT)
            warnings = process.communicate(timeout=30)[1].decode()
        return query, content, warnings

    query, manifest, warnings = served()
    assert warnings == ""
    assert query == "scene/streamed/lod-meta.json"
    assert manifest == (city / "lod-meta.json").read_bytes()
    query, ply, _ = served("--level", "1")
    assert query == "scene/streamed.ply"
    assert ply.startswith(b"ply")
    assert b"element vertex %d\n" % len(kissgs.load(city, level=1)) in ply
    for options, level in (((), 0), (("--max-gaussians", len(kissgs.load(city)) - 1, "--force"), 1)):
        done = run("view", city, "-o", tmp_path / "page.html", *options)
        assert f"holds streamed.zip, level {level} of 0 to 2, compressed" in " ".join(done.stdout.decode().split())
    assert "--max-gaussians does not apply" in failure("view", city, "--no-browser", "--max-gaussians", "9")
    (city / "0_0" / "sh0.webp").unlink()
    lacks = f"kissgs: {city} lacks 0_0/sh0.webp"
    assert served()[2] == f"{lacks}, so a part will be missing; export or download the scene again\n"
    (city / "0_0" / "quats.webp").unlink()
    assert "lacks 0_0/quats.webp and 1 more file, so" in served()[2]
    assert served("--quiet")[2] == ""
    for name in ("sh0.webp", "quats.webp"):
        (tmp_path / name).touch()
        (city / "0_0" / name).symlink_to(tmp_path / name)
    warning = served()[2]
    assert warning.startswith(f"kissgs: the page gets only files inside {city}, not links out of it, so a part will be")
    assert warning.endswith("copy what they lead to: 0_0/quats.webp and 1 more file\n")
    (city / "0_0" / "sh0.webp").unlink()
    first, second = served()[2].splitlines()
    assert first.startswith(lacks)
    assert second.endswith("copy what they lead to: 0_0/quats.webp")


@needs_viewer
def test_errors(tmp_path, scene):
    assert "cannot read" in failure("view", tmp_path / "none.ply")
    assert "end it in .html" in failure("view", scene, "-o", tmp_path / "page.zip")
    assert "there is no folder" in failure("view", scene, "-o", tmp_path / "none" / "page.html")
    assert "for the server" in failure("view", scene, "-o", tmp_path / "page.html", "--no-browser")
    (tmp_path / "text.ply").write_text("no scene")
    assert "text.ply" in failure("view", tmp_path / "text.ply", "-o", tmp_path / "page.html")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["scene.zip", "text.ply"]


def test_without_the_viewer(tmp_path, scene, monkeypatch):
    (tmp_path / "web_decoder").mkdir()
    (tmp_path / "web_decoder" / "preview.html").touch()
    monkeypatch.setattr(page_files, "ROOT", tmp_path)
    assert "add --fetch-viewer" in failure("view", scene, "--no-browser")


def test_fetching_the_viewer(tmp_path, scene, monkeypatch):
    """The script is run; if it fails, so does the command, after the script's own words."""
    (tmp_path / "scripts").mkdir()
    (tmp_path / "scripts" / "vendor").write_text("import sys; sys.exit('no network')")
    monkeypatch.setattr(page_files, "ROOT", tmp_path)
    done = run("view", scene, "--fetch-viewer")
    assert done.returncode == 2
    assert b"could not be downloaded; the reason is above" in done.stderr
