"""``kissgs compress --ray``. Oracle: the files and reports of the command without it."""

import json
import os
import signal
import subprocess

import pytest
from helpers.command_line import KISSGS, failure, run
from helpers.running import is_alive, wait_until

import kissgs
from kissgs.cli.compress_scenes import compress_scene
from kissgs.cli.options import with_default_values
from kissgs.io.ply import write_ply

TIMES = {"seconds", "cpu_seconds", "peak_memory", "output"}


@pytest.fixture(scope="module")
def scenes(tmp_path_factory):
    """Folder of small scenes a.ply and b.ply, and c.ply, which takes about a second."""
    folder = tmp_path_factory.mktemp("scenes")
    for seed, (name, count) in enumerate({"a": 300, "b": 500, "c": 20_000}.items()):
        with (folder / f"{name}.ply").open("wb") as file:
            write_ply(file, kissgs.sample_scene(count, sh_degree=2, seed=seed))
    return folder


def comparable(report):
    return {name: value for name, value in report.items() if name not in TIMES}


@pytest.mark.quick(0)
def test_files_and_reports_are_those_without_a_cluster(whole_cluster, scenes, tmp_path):
    (tmp_path / "broken.ply").write_bytes(b"ply\nnonsense\n")
    inputs = [scenes / "a.ply", tmp_path / "broken.ply", scenes / "b.ply"]
    for name, more in {"here": [], "there": ["--ray", whole_cluster.address]}.items():
        done = run("compress", *inputs, "-p", "fast", "-o", f"{tmp_path}/{name}/", "--json", *more)
        assert done.returncode == 2
        (tmp_path / f"{name}.json").write_bytes(done.stdout)
        (tmp_path / f"{name}.txt").write_bytes(done.stderr)
    for scene in ("a.zip", "b.zip"):
        assert (tmp_path / "there" / scene).read_bytes() == (tmp_path / "here" / scene).read_bytes()
    here, there = (json.loads((tmp_path / name).read_text()) for name in ("here.json", "there.json"))
    assert [comparable(report) for report in there] == [comparable(report) for report in here]
    assert there[1]["error"]["code"] == "invalid-scene"
    assert (tmp_path / "there.txt").read_text() == (tmp_path / "here.txt").read_text()
    assert sorted(path.name for path in (tmp_path / "there").iterdir()) == ["a.zip", "b.zip"]


@pytest.mark.quick(0)
def test_a_folder_is_written_shown_and_replaced_only_if_allowed(whole_cluster, scenes, tmp_path):
    words = ["compress", scenes / "a.ply", "-p", "fast", "-o", tmp_path, "--unpacked", "--ray", whole_cluster.address]
    done = run(*words)
    assert (done.returncode, done.stderr) == (0, b"")
    assert b"Gaussians, SH degree 2" in done.stdout
    assert done.stdout.endswith(b"\n")
    assert not done.stdout.endswith(b"\n\n")  # no empty line, as without a cluster
    files = {path.name: path.read_bytes() for path in (tmp_path / "a.container").iterdir()}
    assert files == dict(kissgs.compress(scenes / "a.ply", settings=kissgs.Settings.from_preset("fast")).files)
    assert "exists already" in failure(*words)
    (tmp_path / "a.container" / "meta.json").unlink()
    assert run(*words, "--force", "-q").returncode == 0
    assert {path.name: path.read_bytes() for path in (tmp_path / "a.container").iterdir()} == files
    assert [path.name for path in tmp_path.iterdir()] == ["a.container"]


def working(cluster):
    """Wait for the process of an item; return its id."""
    wait_until(cluster.items)
    return cluster.items()[0]


def test_ctrl_c_ends_all_items_and_leaves_nothing(whole_cluster, scenes, tmp_path):
    words = [KISSGS, "compress", scenes / "c.ply", "-o", tmp_path / "c.zip", "--ray", whole_cluster.address]
    with subprocess.Popen(words, stderr=subprocess.PIPE, text=True) as command:
        pid = working(whole_cluster)
        wait_until(lambda: any(path.is_dir() and any(path.iterdir()) for path in tmp_path.iterdir()))
        os.kill(command.pid, signal.SIGINT)
        _, said = command.communicate(timeout=60)
    assert (command.returncode, said) == (130, "kissgs: interrupted; no partial file is left\n")
    wait_until(lambda: not is_alive(pid))
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        (
            ["a.ply", "--threads", "64"],
            "no node has 64 CPUs; the largest has 1 CPUs and 1 GB of memory; choose another",
        ),
        (["a.ply", "--device", "cuda", "--finetune"], "no node has 1 CPUs and 1 GPUs; the largest has"),
        (["-", "-o", "x.zip"], "--ray needs files that all machines see, not standard input or output"),
        (["a.ply", "-o", "-"], "--ray needs files that all machines see, not standard input or output"),
        (["none.ply"], "cannot read none.ply"),
    ],
)
@pytest.mark.quick(3)
def test_one_sentence_for_what_a_cluster_cannot_do(whole_cluster, scenes, words, expected):
    assert expected in failure("compress", *words, "-p", "fast", "--ray", whole_cluster.address, cwd=scenes)
    assert not list(scenes.glob("*.zip"))


def test_a_machine_without_the_shared_storage(scenes, tmp_path):
    scene = scenes / "a.ply"
    arguments = {"scene": str(scene), "bytes": scene.stat().st_size, "work": str(tmp_path)}
    for change, expected in (
        ({"scene": "/nowhere/a.ply"}, "does not see /nowhere/a.ply; --ray needs storage"),
        ({"bytes": 7}, "sees another file as"),
        ({"work": "/nowhere/x"}, "does not see what this machine writes to /nowhere"),
    ):
        with pytest.raises(kissgs.UnsupportedError, match=expected):
            compress_scene(arguments | change, lambda *event: None)


@pytest.mark.quick(0)
def test_a_cluster_of_this_machine_is_started_where_there_is_none(scenes, tmp_path, monkeypatch):
    monkeypatch.setenv("RAY_TMPDIR", str(tmp_path))  # where a cluster of this machine would be found
    for name in ("RAY_ADDRESS", "RAY_AUTH_MODE", "RAY_AUTH_TOKEN"):
        monkeypatch.delenv(name, raising=False)
    home = tmp_path / "home"
    home.mkdir()
    monkeypatch.setenv("HOME", str(home))
    words = [KISSGS, "compress", scenes / "a.ply", "-p", "fast", "-o", tmp_path / "a.zip", "--ray", "-q"]
    subprocess.run(words, check=True, timeout=120)
    expected = kissgs.compress(scenes / "a.ply", settings=kissgs.Settings.from_preset("fast")).to_zip()
    assert (tmp_path / "a.zip").read_bytes() == expected
    assert list(home.iterdir()) == []


def test_values_that_may_be_left_out(tmp_path):
    for words, meant in (
        (["a.ply", "--ray"], ["a.ply", "--ray", "auto"]),
        (["--ray", "a.ply"], ["--ray", "auto", "a.ply"]),
        (["--ray", "head:6379", "a.ply"], ["--ray", "head:6379", "a.ply"]),
        (["--ray", "[::1]:6379"], ["--ray", "[::1]:6379"]),
        (["--ray", str(tmp_path)], ["--ray", "auto", str(tmp_path)]),  # a container or a streamed scene
        *((["--ray", scene], ["--ray", "auto", scene]) for scene in ("*.ply", "missing.zip", "dir/x", "-q", "a.sog")),
        (["a.ply", "--finetune"], ["a.ply", "--finetune", "auto"]),
        (["--finetune", "a.ply", "-q"], ["--finetune", "auto", "a.ply", "-q"]),
        (["--finetune", "70", "a.ply"], ["--finetune", "70", "a.ply"]),
        (["--finetune", "auto"], ["--finetune", "auto"]),
        (["--", "--ray"], ["--", "--ray"]),
    ):
        assert with_default_values(["compress", *words]) == ["compress", *meant]


def test_an_address_without_a_port_is_not_taken_for_a_scene(scenes, tmp_path):
    for address in ("127.0.0.1", "http://127.0.0.1:6379", "head", "head.example.com", "h:port"):
        said = failure("compress", "--ray", address, scenes / "a.ply", "-o", tmp_path)
        assert said == f"kissgs: --ray takes HOST:PORT, such as head:6379, not {address}"


def test_an_address_is_not_asked_for_where_there_is_no_cluster(scenes):
    """Regression: convert, which has no --ray, said what --ray takes."""
    said = run("convert", scenes / "a.ply", "--ray", "head").stderr
    assert b"No such option: --ray" in said
    assert b"HOST:PORT" not in said
