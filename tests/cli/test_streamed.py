"""``kissgs compress -o FOLDER/lod-meta.json``, ``-o NAME.sogxt/``. Oracle: what the library writes, and the input."""

import json
import os
import re
import subprocess
from pathlib import Path

import pytest
from helpers.command_line import KISSGS, failure, run
from helpers.streamed_scenes import files_of, write_small

import kissgs
from kissgs import Settings


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    path = tmp_path_factory.mktemp("streamed") / "scene.ply"
    kissgs.save(kissgs.sample_scene(2000, sh_degree=1), path)
    return path


@pytest.mark.parametrize("name", ["city/lod-meta.json", "city.sogxt/"])
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


def test_options_that_do_not_fit_are_refused(scene, tmp_path):
    for name in ("city/lod-meta.json", "city.sogxt"):
        for words in (["--evaluate"], ["--cache"], ["--container", "sog"], ["--unpacked"]):
            said = failure("compress", scene, "-o", tmp_path / name, *words)
            assert "levels of detail (l" in said
            assert f"are made without {words[0]}" in said
    target = tmp_path / "city.sogxt"
    assert "without goals" in failure("compress", scene, "-o", target, "--target-size", "1MB")
    assert "become" in (said := failure("compress", scene, scene, "-o", target))
    assert said.endswith("; compress one scene at a time")
    assert "levels of detail need a file" in failure("compress", "-", "-o", target, stdin=scene.read_bytes())
    assert list(tmp_path.iterdir()) == []


HOOKS = {
    "while the scene is partitioned": """
from kissgs.streaming import build
def partition(*arguments):
    (work / "chunk_0.f32").write_bytes(b"1234")
    os.kill(os.getpid(), signal.SIGINT)
build.partition = partition
""",
    "and once more while that is removed": """
unlink = pathlib.Path.unlink
def interrupted(path, *arguments, **options):
    if path.name == "chunk_0.f32":
        os.kill(os.getpid(), signal.SIGINT)
    unlink(path, *arguments, **options)
pathlib.Path.unlink = interrupted
""",
    "after the partition": """
import kissgs.streaming.work_folder as module
write = module.write_json
def written(path, values):
    write(path, values)
    if path.name == module.PARTITION: os.kill(os.getpid(), signal.SIGINT)
module.write_json = written
""",
    "in the next run while modules are imported": """
class Finder:
    def find_spec(self, name, *rest):
        if name == "kissgs.streaming.build": os.kill(os.getpid(), signal.SIGINT)
sys.meta_path.insert(0, Finder())
""",
    "in the next run before it has read the layout": """
import kissgs.streaming.work_folder as module
module.read_layout = lambda work: os.kill(os.getpid(), signal.SIGINT)
""",
}
"""Code of a ``sitecustomize`` that interrupts the command, by the moment."""

FIRST, SECOND, PARTITIONED, *LATER = HOOKS


@pytest.mark.parametrize(
    ("moments", "left"),
    [
        ([FIRST], "no partial file is left"),
        ([FIRST, SECOND], "the same command begins anew"),
        ([PARTITIONED], "the same command goes on where it was"),
        *(([PARTITIONED, moment], "the same command goes on where it was") for moment in LATER),
    ],
)
@pytest.mark.quick(2)
def test_an_interruption_says_what_is_left_and_the_same_command_completes_it(scene, tmp_path, moments, left):
    call = [str(KISSGS), "compress", str(scene), "-o", "city/lod-meta.json", "-p", "fast"]
    environment = {**os.environ, "PYTHONPATH": f"{tmp_path}:{os.environ.get('PYTHONPATH', '')}"}
    starts = [[moment] for moment in moments] if PARTITIONED in moments else [moments]
    for hooks in starts:
        lines = [
            "import os, pathlib, signal, sys",
            "work = pathlib.Path('city.partial')",
            *(HOOKS[hook] for hook in hooks),
        ]
        (tmp_path / "sitecustomize.py").write_text("\n".join(lines))
        done = subprocess.run(call, check=False, cwd=tmp_path, env=environment, capture_output=True)
        assert done.returncode == 130, done.stderr
        assert done.stderr.decode().endswith(f"kissgs: interrupted; {left}\n")
    assert (tmp_path / "city.partial").exists() == (left != "no partial file is left")
    assert (tmp_path / "city.partial" / "partition.json").exists() == (PARTITIONED in moments)
    assert not (tmp_path / "city").exists()
    assert run(*call[1:], cwd=tmp_path).returncode == 0
    kissgs.compress_streamed(scene, tmp_path / "own/lod-meta.json", settings=Settings.from_preset("fast"))
    assert files_of(tmp_path / "city") == files_of(tmp_path / "own")
    assert not (tmp_path / "city.partial").exists()


def test_numbers_say_what_they_count(tmp_path):
    """``info`` describes one of two levels, and gives the bytes of both in its heading."""
    scene = kissgs.sample_scene(300, sh_degree=0)
    write_small(scene, tmp_path / "city" / "lod-meta.json", chunk=400, leaf=200, coarsest=200)
    for level in (0, 1):
        said = run("info", tmp_path / "city", "--level", str(level)).stdout.decode()
        sizes = {path: path.stat().st_size for path in (tmp_path / "city").rglob("*.*")}
        assert f"{sum(sizes.values()) / 1000:.1f} kB in all levels\n" in said
        own = [size for path, size in sizes.items() if path.parent.name in (f"{level}_0", "city")]
        assert re.search(rf"\ntotal of level {level} +{sum(own):,} ", said)
