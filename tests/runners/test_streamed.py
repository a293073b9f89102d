"""Streamed scenes on a runner. Oracle: what one process makes, one item after another."""

import json

import pytest
from helpers.command_line import run
from helpers.running import processors, wait_until
from helpers.stages import by_stages
from helpers.streamed_scenes import FAST, files_of, saved_sample, small_sizes

from kissgs import Settings
from kissgs.core.errors import KissgsError
from kissgs.streaming.compress import compress_streamed


@pytest.fixture(autouse=True)
def small(monkeypatch):
    small_sizes(monkeypatch, chunk=1600, leaf=300, coarsest=2000)
    by_stages(monkeypatch)


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    return saved_sample(tmp_path_factory, 3000, 1)


@pytest.mark.parametrize(
    ("preset", "name"), [("fast", "lod-meta.json"), ("balanced", "lod-meta.json"), ("fast", "levels.json")]
)
@pytest.mark.quick(1)
def test_a_runner_makes_the_same_bytes(runner, scene, tmp_path, preset, name):
    settings, stages = Settings.from_preset(preset), set()

    def progress(stage, fraction, note=""):
        stages.add(stage)

    here = compress_streamed(scene, tmp_path / "here" / name, settings=settings)
    there = compress_streamed(scene, tmp_path / "there" / name, settings=settings, runner=runner, progress=progress)
    assert there == here
    assert files_of(tmp_path / "there") == files_of(tmp_path / "here")
    assert {"merge", "images"} <= stages


@pytest.mark.quick(0)
def test_stopped_work_cancels_its_items_and_goes_on_elsewhere(local_runner, scene, tmp_path):
    target = tmp_path / "city" / "lod-meta.json"

    class Stop(Exception):
        pass

    def stop(stage, fraction, note=""):
        if stage == "images" and fraction > 0:
            raise Stop

    with pytest.raises(Stop):
        compress_streamed(scene, target, settings=FAST, runner=local_runner, progress=stop)
    assert not target.exists()
    compress_streamed(scene, target, settings=FAST)
    compress_streamed(scene, tmp_path / "whole" / "lod-meta.json", settings=FAST)
    assert files_of(tmp_path / "city") == files_of(tmp_path / "whole")


@pytest.mark.quick(0)
def test_an_item_that_fails_ends_the_work(local_runner, scene, tmp_path):
    """A level that another program has removed cannot be read, and the work folder stays as it is."""
    target = tmp_path / "city" / "lod-meta.json"

    def remove(stage, fraction, note=""):
        if stage == "images" and fraction == 0:
            (tmp_path / "city.partial" / "chunk_0_level_0.f32").unlink(missing_ok=True)

    with pytest.raises(KissgsError, match=r"cannot read .*chunk_0_level_0"):
        compress_streamed(scene, target, settings=FAST, runner=local_runner, progress=remove)


@pytest.mark.quick(0)
def test_the_command_on_a_cluster(ray_cluster, ray_runner, scene, tmp_path):
    wait_until(lambda: processors(ray_runner) == 2)
    words = ("compress", scene, "-p", "fast", "--json", "-o")
    here = run(*words, tmp_path / "here" / "lod-meta.json")
    there = run(*words, tmp_path / "there" / "lod-meta.json", "--ray", ray_cluster.address)
    assert here.returncode == there.returncode == 0
    assert json.loads(there.stdout)["counts"] == json.loads(here.stdout)["counts"]
    assert files_of(tmp_path / "there") == files_of(tmp_path / "here")
