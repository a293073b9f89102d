"""``kissgs compress -o FOLDER/lod-meta.json``. Oracle: what the library writes, and the input."""

import json
import signal
import subprocess
import time
from pathlib import Path

import pytest
from helpers.command_line import KISSGS, failure, run

import kissgs
from kissgs import Settings


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    path = tmp_path_factory.mktemp("streamed") / "scene.ply"
    kissgs.save(kissgs.sample_scene(2000, sh_degree=1), path)
    return path


def contents(folder):
    return {str(path.relative_to(folder)): path.read_bytes() for path in sorted(folder.rglob("*")) if path.is_file()}


def test_the_command_writes_what_the_library_writes(scene, tmp_path):
    done = run("compress", scene, "-o", tmp_path / "city" / "lod-meta.json", "-p", "fast")
    assert done.returncode == 0
    assert b"city.partial takes up to 0 MB" in done.stderr or b"city.partial takes up to 1 MB" in done.stderr
    assert b"2,000 Gaussians in 1 chunk, " in done.stdout
    kissgs.compress_streamed(scene, tmp_path / "own" / "lod-meta.json", settings=Settings.from_preset("fast"))
    assert contents(tmp_path / "city") == contents(tmp_path / "own")
    report = run("compress", scene, "-o", tmp_path / "city" / "lod-meta.json", "-p", "fast", "--json", "--force")
    assert json.loads(report.stdout)["source_count"] == 2000
    assert report.stderr == b""
    assert sorted(path.name for path in tmp_path.iterdir()) == ["city", "own"]


def test_options_that_do_not_fit_are_refused(scene, tmp_path):
    target = tmp_path / "city" / "lod-meta.json"
    for words in (["--evaluate"], ["--cache"], ["--container", "sog"]):
        assert f"levels of detail (lod-meta.json) are made without {words[0]}" in failure(
            "compress", scene, "-o", target, *words
        )
    assert "without goals" in failure("compress", scene, "-o", target, "--target-size", "1MB")
    assert "2 inputs cannot all become" in failure("compress", scene, scene, "-o", target)
    assert "levels of detail need a file" in failure("compress", "-", "-o", target, stdin=scene.read_bytes())
    assert list(tmp_path.iterdir()) == []


def test_interrupted_work_says_that_it_goes_on_and_does(tmp_path):
    kissgs.save(kissgs.sample_scene(150_000, sh_degree=0), tmp_path / "scene.ply")
    target = tmp_path / "city" / "lod-meta.json"
    call = [str(KISSGS), "compress", str(tmp_path / "scene.ply"), "-o", str(target), "-p", "fast"]
    process = subprocess.Popen(call, stderr=subprocess.PIPE, stdout=subprocess.DEVNULL)
    work = tmp_path / "city.partial"
    while not (work / "partition.json").exists():
        assert process.poll() is None
        time.sleep(0.01)
    time.sleep(0.2)
    process.send_signal(signal.SIGINT)
    _, errors = process.communicate(timeout=60)
    assert process.returncode == 130
    assert errors.endswith(b"kissgs: interrupted; the same command goes on where it was\n")
    assert not Path(target.parent).exists()
    assert (work / "partition.json").exists()
    subprocess.run(call, check=True, capture_output=True)
    assert len(kissgs.load(target)) > 100_000
    assert not work.exists()
