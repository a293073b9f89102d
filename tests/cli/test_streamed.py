"""``kissgs compress -o FOLDER/lod-meta.json``, ``-o NAME.sogxt/``. Oracle: what the library writes, and the input."""

import json
import os
import re
import signal
import subprocess
import time
from pathlib import Path

import pytest
from helpers.command_line import KISSGS, failure, run
from helpers.streamed_scenes import files_of, small_sizes

import kissgs
from kissgs import Settings


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    path = tmp_path_factory.mktemp("streamed") / "scene.ply"
    kissgs.save(kissgs.sample_scene(2000, sh_degree=1), path)
    return path


@pytest.mark.parametrize("name", ["city/lod-meta.json", "city.sogxt/", "city/levels.json"])
def test_the_command_writes_what_the_library_writes(scene, tmp_path, name):
    target = f"{tmp_path}/{name}"
    folder = Path(name).parts[0]
    done = run("compress", scene, "-o", target, "-p", "fast")
    assert done.returncode == 0
    assert f"{folder}.partial takes up to ".encode() in done.stderr
    stored = len(kissgs.load(target))
    assert f"  {stored:,} of 2,000 Gaussians in 1 chunk, ".encode() in done.stdout
    (tmp_path / "own").mkdir()
    kissgs.compress_streamed(scene, f"{tmp_path}/own/{name}", settings=Settings.from_preset("fast"))
    assert files_of(tmp_path / folder) == files_of(tmp_path / "own" / folder)
    report = json.loads(run("compress", scene, "-o", target, "-p", "fast", "--json", "--force").stdout)
    assert report["source_count"] == 2000
    for source in (folder, report["output"]):
        assert b"level 0 of 0 to 0" in run("info", tmp_path / source).stdout
    assert sorted(path.name for path in tmp_path.iterdir()) == [folder, "own"]


@pytest.mark.parametrize("name", ["city/lod-meta.json", "city.sogxt"])
def test_options_that_do_not_fit_are_refused(scene, tmp_path, name):
    target = tmp_path / name
    for words in (["--evaluate"], ["--cache"], ["--container", "sog"], ["--unpacked"]):
        said = failure("compress", scene, "-o", target, *words)
        assert "levels of detail (l" in said
        assert f"are made without {words[0]}" in said
    assert "without goals" in failure("compress", scene, "-o", target, "--target-size", "1MB")
    assert "become" in (said := failure("compress", scene, scene, "-o", target))
    assert said.endswith("; compress one scene at a time")
    assert "levels of detail need a file" in failure("compress", "-", "-o", target, stdin=scene.read_bytes())
    assert list(tmp_path.iterdir()) == []


def test_interrupted_work_says_that_it_goes_on_and_does(tmp_path):
    kissgs.save(kissgs.sample_scene(150_000, sh_degree=0), tmp_path / "scene.ply")
    target = tmp_path / "city" / "lod-meta.json"
    call = [str(KISSGS), "compress", str(tmp_path / "scene.ply"), "-o", str(target), "-p", "fast"]
    process = subprocess.Popen(call, stderr=subprocess.PIPE, stdout=subprocess.DEVNULL)
    work = tmp_path / "city.partial"
    while not any(work.glob("chunk_*_level_*")):  # written by the first stage that is not repeated
        assert process.poll() is None
        time.sleep(0.01)
    process.send_signal(signal.SIGINT)
    _, errors = process.communicate(timeout=60)
    assert process.returncode == 130
    assert errors.endswith(b"kissgs: interrupted; the same command goes on where it was\n")
    assert not Path(target.parent).exists()
    assert (work / "partition.json").exists()
    subprocess.run(call, check=True, capture_output=True)
    assert len(kissgs.load(target)) > 100_000
    assert not work.exists()


@pytest.mark.parametrize("again", [False, True])
def test_the_message_of_an_interruption_says_whether_something_is_left(scene, tmp_path, again):
    # A sitecustomize that interrupts the partition once it has written a file, and perhaps the removal of that, too.
    (tmp_path / "sitecustomize.py").write_text(
        "import os, pathlib, signal\n"
        "from kissgs.streaming import build, items\n"
        f"work, again = pathlib.Path('city.partial'), {again}\n"
        "def partition(*arguments):\n"
        "    (work / 'chunk_0.f32').write_bytes(b'1234')\n"
        "    os.kill(os.getpid(), signal.SIGINT)\n"
        "unlink = pathlib.Path.unlink\n"
        "def interrupted(path, *arguments, **options):\n"
        "    if again and path.name == 'chunk_0.f32':\n"
        "        os.kill(os.getpid(), signal.SIGINT)\n"
        "    unlink(path, *arguments, **options)\n"
        "build.partition, pathlib.Path.unlink = partition, interrupted\n"
    )
    call = [str(KISSGS), "compress", str(scene), "-o", "city/lod-meta.json", "-p", "fast"]
    paths = f"{tmp_path}:{os.environ.get('PYTHONPATH', '')}"
    environment = {**os.environ, "PYTHONPATH": paths}
    done = subprocess.run(call, check=False, cwd=tmp_path, env=environment, capture_output=True)
    left = b"the same command begins anew" if again else b"no partial file is left"
    assert done.returncode == 130
    assert done.stderr.endswith(b"kissgs: interrupted; " + left + b"\n")
    assert (tmp_path / "city.partial").exists() == again
    subprocess.run(call, cwd=tmp_path, check=True, capture_output=True)
    assert not (tmp_path / "city.partial").exists()


@pytest.mark.parametrize("early", ["kissgs.streaming.build", "kissgs.streaming.compress"])
def test_a_resumed_run_that_is_interrupted_early_says_that_it_goes_on(scene, tmp_path, early):
    """The signal arrives before any new work: while the modules are imported, or when the layout is read."""

    class Stop(Exception):
        pass

    def stop(stage, fraction, note=""):
        if stage == "merge":
            raise Stop

    with pytest.raises(Stop):
        kissgs.compress_streamed(
            scene, tmp_path / "city/lod-meta.json", settings=Settings.from_preset("fast"), progress=stop
        )
    if early == "kissgs.streaming.build":
        hook = (
            "import os, signal, sys\n"
            "class Finder:\n"
            "    def find_spec(self, name, *rest):\n"
            f"        if name == '{early}': os.kill(os.getpid(), signal.SIGINT)\n"
            "sys.meta_path.insert(0, Finder())\n"
        )
    else:
        hook = (
            "import os, signal\n"
            f"import {early} as module\n"
            "module.read_layout = lambda work: os.kill(os.getpid(), signal.SIGINT)\n"
        )
    (tmp_path / "sitecustomize.py").write_text(hook)
    call = [str(KISSGS), "compress", str(scene), "-o", "city/lod-meta.json", "-p", "fast"]
    environment = {**os.environ, "PYTHONPATH": f"{tmp_path}:{os.environ.get('PYTHONPATH', '')}"}
    done = subprocess.run(call, check=False, cwd=tmp_path, env=environment, capture_output=True)
    assert done.returncode == 130
    assert done.stderr.endswith(b"kissgs: interrupted; the same command goes on where it was\n")
    assert (tmp_path / "city.partial" / "partition.json").exists()


def test_numbers_say_what_they_count(tmp_path):
    """``info`` describes one of two levels, and gives the bytes of both in its heading."""
    with pytest.MonkeyPatch.context() as patch:
        small_sizes(patch, chunk=400, leaf=200, coarsest=200)
        kissgs.save(kissgs.sample_scene(300, sh_degree=0), tmp_path / "scene.ply")
        kissgs.compress_streamed(
            tmp_path / "scene.ply", tmp_path / "city/lod-meta.json", settings=Settings.from_preset("fast")
        )
    for level in (0, 1):
        said = run("info", tmp_path / "city", "--level", str(level)).stdout.decode()
        sizes = {path: path.stat().st_size for path in (tmp_path / "city").rglob("*.*")}
        assert f"{sum(sizes.values()) / 1000:.1f} kB in all levels\n" in said
        own = [size for path, size in sizes.items() if path.parent.name in (f"{level}_0", "city")]
        assert re.search(rf"\ntotal of level {level} +{sum(own):,} ", said)


def test_one_gaussian_takes_less_than_a_megabyte(tmp_path):
    kissgs.save(kissgs.sample_scene(100, sh_degree=0).select(slice(9, 10)), tmp_path / "scene.ply")
    done = run("compress", tmp_path / "scene.ply", "-o", tmp_path / "city.sogxt", "-p", "fast")
    assert b"  1 of 1 Gaussian in 1 chunk, " in done.stdout
    assert re.search(rb"city\.partial takes up to \d+ kB until", done.stderr.replace(b".sogxt", b""))
    assert b"\n1 Gaussian, SH degree 0, " in run("info", tmp_path / "city.sogxt").stdout
    said = run("decompress", tmp_path / "city.sogxt", "-o", tmp_path / "one.ply").stdout
    assert b"  1 Gaussian, SH degree 0" in said
