"""Streamed scenes. Oracle: the reader of streamed SOG, the input's Gaussians, and work that is interrupted anywhere."""

import json
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from helpers.format_scenes import assert_alike
from helpers.splat_transform import convert, needs_splat_transform

import kissgs
from kissgs import Settings
from kissgs.core.errors import InvalidSceneError, OutputError, UnsupportedError
from kissgs.core.splats import concatenate
from kissgs.streaming import build
from kissgs.streaming.compress import compress_streamed
from kissgs.streaming.levels import bounds

FAST = Settings.from_preset("fast")
COUNT = 3000


@pytest.fixture(autouse=True)
def small(monkeypatch):
    for name, value in {"CHUNK": 800, "LEAF": 150, "COARSEST": 500}.items():
        monkeypatch.setattr(build, name, value)


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    path = tmp_path_factory.mktemp("streamed") / "scene.ply"
    kissgs.save(kissgs.sample_scene(COUNT, sh_degree=1, seed=3), path)
    return path


def tree_leaves(node):
    return [node] if "lods" in node else [leaf for child in node["children"] for leaf in tree_leaves(child)]


def files_of(folder):
    return {str(path.relative_to(folder)): path.read_bytes() for path in sorted(folder.rglob("*")) if path.is_file()}


def test_every_level_is_read_and_every_leaf_has_every_level(scene, tmp_path):
    report = compress_streamed(scene, tmp_path / "city" / "lod-meta.json", settings=FAST)
    original = kissgs.load(scene)
    document = json.loads((tmp_path / "city" / "lod-meta.json").read_bytes())
    assert document["lodLevels"] == len(report.counts) == 4
    leaves = tree_leaves(document["tree"])
    assert all(sorted(leaf["lods"]) == ["0", "1", "2", "3"] for leaf in leaves)
    for level in range(4):
        found = kissgs.load(tmp_path / "city" / "lod-meta.json", level=level)
        assert len(found) == report.counts[level] == document["counts"][level]
        assert abs(len(found) - len(original) / 2**level) < 0.02 * COUNT + len(leaves)
    assert report.total_bytes == sum(map(len, files_of(tmp_path / "city").values()))
    assert not (tmp_path / "city.partial").exists()


def test_rows_of_a_leaf_are_inside_its_bounds(scene, tmp_path):
    compress_streamed(scene, tmp_path / "city" / "lod-meta.json", settings=FAST)
    document = json.loads((tmp_path / "city" / "lod-meta.json").read_bytes())
    decoded = [kissgs.load(tmp_path / "city" / name) for name in document["filenames"]]
    for leaf in tree_leaves(document["tree"]):
        rows = [
            decoded[lod["file"]].select(slice(lod["offset"], lod["offset"] + lod["count"]))
            for lod in leaf["lods"].values()
        ]
        low, high = bounds(concatenate(rows))
        slack = 0.05 * (high - low) + 1e-3
        assert (low >= np.array(leaf["bound"]["min"]) - slack).all()
        assert (high <= np.array(leaf["bound"]["max"]) + slack).all()


class Stop(Exception):
    pass


def test_interrupted_work_goes_on_and_ends_with_the_same_bytes(scene, tmp_path, monkeypatch):
    compress_streamed(scene, tmp_path / "whole" / "lod-meta.json", settings=FAST)
    expected = files_of(tmp_path / "whole")
    target = tmp_path / "city" / "lod-meta.json"
    events = 0
    while True:
        left = [events]

        def stop(stage, fraction, note="", left=left):
            left[0] -= 1
            if left[0] < 0:
                raise Stop

        try:
            compress_streamed(scene, target, settings=FAST, progress=stop)
        except Stop:
            events += 1
            assert not target.exists()
            continue
        break
    assert events > 6
    assert files_of(tmp_path / "city") == expected


def test_work_of_other_settings_is_not_continued(scene, tmp_path):
    target = tmp_path / "city" / "lod-meta.json"

    def stop(stage, fraction, note=""):
        if stage == "images":
            raise Stop

    with pytest.raises(Stop):
        compress_streamed(scene, target, settings=FAST, progress=stop)
    other = Settings.from_preset("fast", sh0_step=0.1)
    with pytest.raises(OutputError, match=r"city\.partial belongs to other or older work; delete it"):
        compress_streamed(scene, target, settings=other)
    shutil.rmtree(tmp_path / "city.partial")
    compress_streamed(scene, target, settings=other)


def test_what_cannot_be_read_leaves_no_work_folder(scene, tmp_path):
    (tmp_path / "cut.ply").write_bytes(scene.read_bytes()[:-10])
    with pytest.raises(InvalidSceneError, match=r"cut\.ply"):
        compress_streamed(tmp_path / "cut.ply", tmp_path / "city" / "lod-meta.json", settings=FAST)
    assert [path.name for path in tmp_path.iterdir()] == ["cut.ply"]


def test_a_full_disk_is_noticed_before_any_work(scene, tmp_path, monkeypatch):
    usage = shutil.disk_usage(tmp_path)
    monkeypatch.setattr(shutil, "disk_usage", lambda path: usage._replace(free=100_000))
    with pytest.raises(OutputError, match=r"city\.partial will take up to 1 MB, but its disk has 0 MB free; free some"):
        compress_streamed(scene, tmp_path / "city" / "lod-meta.json", settings=FAST)
    assert list(tmp_path.iterdir()) == []


def test_invisible_gaussians_are_left_out_and_counted(tmp_path):
    made = kissgs.sample_scene(COUNT, sh_degree=0, seed=3)
    opacities, means = made.opacities.copy(), made.means.copy()
    opacities[::7], means[5] = -9.0, np.nan
    kissgs.save(replace(made, opacities=opacities, means=means), tmp_path / "scene.ply")
    report = compress_streamed(tmp_path / "scene.ply", tmp_path / "city" / "lod-meta.json", settings=FAST)
    untiled = kissgs.compress(tmp_path / "scene.ply", settings=FAST).report
    assert report.changed["invisible"] == untiled.invisible > len(opacities[::7])
    assert (report.changed["non_finite"], report.changed["pruned_by_rd"]) == (1, 0)
    assert (report.source_count, report.counts[0]) == (COUNT, untiled.count)


def test_leaves_have_errors_that_rise_with_the_level(scene, tmp_path):
    compress_streamed(scene, tmp_path / "city" / "lod-meta.json", settings=FAST)
    leaves = tree_leaves(json.loads((tmp_path / "city" / "lod-meta.json").read_bytes())["tree"])
    for leaf in leaves:
        assert leaf["errors"][0] == 0 < leaf["errors"][1]
        assert leaf["errors"] == sorted(leaf["errors"])
        assert leaf["errors"][-1] < 0.5


@needs_splat_transform
def test_splat_transform_reads_every_level(scene, tmp_path):
    target = tmp_path / "city" / "lod-meta.json"
    report = compress_streamed(scene, target, settings=FAST)
    for level in range(len(report.counts)):
        theirs = kissgs.load(convert(target, tmp_path / f"{level}.ply", "-L", str(level)))
        assert_alike(kissgs.load(target, level=level), theirs, rtol=1e-6, atol=1e-6)


def test_other_files_are_never_replaced(scene, tmp_path):
    """Neither in another folder, nor beside the files of a streamed scene, nor in the work folder."""
    folder = tmp_path / "city"
    folder.mkdir()
    (folder / "mine.txt").write_text("mine")
    with pytest.raises(OutputError, match="holds other files"):
        compress_streamed(scene, folder / "lod-meta.json", settings=FAST, overwrite=True)
    (folder / "mine.txt").unlink()
    compress_streamed(scene, folder / "lod-meta.json", settings=FAST)
    (folder / "0_0" / "mine.txt").write_text("mine")
    with pytest.raises(OutputError, match=r"holds other files \(0_0/mine\.txt\)"):
        compress_streamed(scene, folder / "lod-meta.json", settings=FAST, overwrite=True)
    assert (folder / "0_0" / "mine.txt").read_text() == "mine"
    (tmp_path / "town.partial").mkdir()
    (tmp_path / "town.partial" / "mine.txt").write_text("mine")
    with pytest.raises(OutputError, match=r"town\.partial holds other files"):
        compress_streamed(scene, tmp_path / "town" / "lod-meta.json", settings=FAST)
    assert [path.name for path in (tmp_path / "town.partial").iterdir()] == ["mine.txt"]


def test_a_streamed_scene_is_replaced_only_if_allowed(scene, tmp_path):
    target = tmp_path / "city" / "lod-meta.json"
    compress_streamed(scene, target, settings=FAST)
    with pytest.raises(OutputError, match="exists already"):
        compress_streamed(scene, target, settings=FAST)
    other = Settings.from_preset("fast", sh0_step=0.1)
    compress_streamed(scene, target, settings=other, overwrite=True)
    compress_streamed(scene, tmp_path / "new" / "lod-meta.json", settings=other)
    assert files_of(tmp_path / "city") == files_of(tmp_path / "new")


@pytest.mark.parametrize("name", ["lod-meta.json", "inner/../lod-meta.json"])
def test_the_current_folder_is_not_replaced(scene, tmp_path, monkeypatch, name):
    (tmp_path / "here" / "inner").mkdir(parents=True)
    monkeypatch.chdir(tmp_path / "here")
    with pytest.raises(OutputError, match="in a new folder"):
        compress_streamed(scene, Path(name), settings=FAST)
    assert [path.name for path in tmp_path.iterdir()] == ["here"]


def test_two_processes_do_not_work_in_one_folder(scene, tmp_path):
    target = tmp_path / "city" / "lod-meta.json"

    def again(stage, fraction, note=""):
        if stage == "merge":
            with pytest.raises(OutputError, match="another process works in"):
                compress_streamed(scene, target, settings=FAST)

    compress_streamed(scene, target, settings=FAST, progress=again)
    assert len(kissgs.load(target)) > 0


def test_a_missing_folder_above_is_named(scene, tmp_path):
    with pytest.raises(OutputError, match="there is no folder"):
        compress_streamed(scene, tmp_path / "none" / "city" / "lod-meta.json", settings=FAST)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("changes", [{"target_size": "1MB"}, {"compact": {"ratio": 0.5}}, {"order": "plas"}])
def test_settings_that_do_not_fit_are_refused(scene, tmp_path, changes):
    with pytest.raises(UnsupportedError):
        compress_streamed(scene, tmp_path / "city" / "lod-meta.json", settings=Settings.from_preset("fast", **changes))


def test_the_number_of_threads_does_not_matter(scene, tmp_path):
    for threads in (1, 3):
        compress_streamed(scene, tmp_path / str(threads) / "lod-meta.json", settings=FAST, threads=threads)
    assert files_of(tmp_path / "1") == files_of(tmp_path / "3")
