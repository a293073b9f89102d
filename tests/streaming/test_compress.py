"""Streamed scenes. Oracle: the reader, the input's Gaussians, and work that is interrupted anywhere."""

import errno
import itertools
import json
import os
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from helpers.codec_scenes import covariances
from helpers.format_scenes import assert_alike
from helpers.splat_transform import convert, needs_splat_transform
from helpers.stages import by_stages
from helpers.streamed_scenes import FAST, TARGETS, Stop, files_of, saved_sample, small_sizes, tree_leaves

import kissgs
from kissgs import Settings
from kissgs.core.errors import InvalidSceneError, OutputError, UnsupportedError
from kissgs.core.splats import concatenate
from kissgs.io.streamed import MAX_TREE_BYTES
from kissgs.streaming import levels
from kissgs.streaming.compress import compress_streamed

COUNT = 1500
SIZES = {"chunk": 400, "leaf": 120, "coarsest": 250}


@pytest.fixture(autouse=True)
def small(monkeypatch):
    small_sizes(monkeypatch, **SIZES)


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    return saved_sample(tmp_path_factory, COUNT, 1)


@pytest.fixture(params=TARGETS)
def target(request, tmp_path):
    return tmp_path / request.param


@pytest.fixture(scope="module")
def written(scene, tmp_path_factory):
    """``written(name)`` returns a manifest that is written once, the report, and the progress by stages."""
    made = {}

    def write(name):
        if name not in made:
            target, stages = tmp_path_factory.mktemp("written") / name, {}

            def progress(stage, fraction, note=""):
                stages.setdefault(stage, []).append(fraction)

            with pytest.MonkeyPatch.context() as patch:
                small_sizes(patch, **SIZES)
                by_stages(patch)
                made[name] = target, compress_streamed(scene, target, settings=FAST, progress=progress), stages
        return made[name]

    return write


@pytest.fixture
def copied(written, target):
    """A copy of a streamed scene that a test may change."""
    shutil.copytree(written("/".join(target.parts[-2:]))[0].parent, target.parent)
    return target


@pytest.mark.parametrize("name", TARGETS)
@pytest.mark.quick(1)
def test_every_level_is_read_and_every_leaf_has_every_level(scene, written, name):
    target, report, stages = written(name)
    original = kissgs.load(scene)
    document = json.loads(target.read_bytes())
    assert document["lodLevels"] == len(report.counts) == 4
    assert document.get("format") == ("sog-xt" if target.name == "levels.json" else None)
    leaves = tree_leaves(document["tree"])
    assert all(sorted(leaf["lods"]) == ["0", "1", "2", "3"] for leaf in leaves)
    for leaf in leaves:  # whose errors rise with the level
        assert leaf["errors"][0] == 0 < leaf["errors"][1]
        assert leaf["errors"] == sorted(leaf["errors"])
        assert leaf["errors"][-1] < 0.5
    for level in range(4):
        found = kissgs.load(target, level=level)
        assert len(found) == report.counts[level] == document["counts"][level]
        assert abs(len(found) - len(original) / 2**level) < 0.02 * COUNT + len(leaves)
    assert report.total_bytes == sum(map(len, files_of(target.parent).values()))
    assert not target.parent.with_name(f"{target.parent.name}.partial").exists()
    distances = np.linalg.norm(kissgs.load(target).means[:, None] - original.means[None], axis=2)
    assert len(set(distances.argmin(axis=1))) > 0.98 * len(original)
    assert np.median(distances.min(axis=1)) < 0.1 * np.median(np.sort(distances, axis=1)[:, 1])
    assert_items_report_within(stages)


def assert_items_report_within(stages):
    """Assert that chunks and files, of which there are four and more, report more than their beginnings, in order."""
    for stage, items in (("merge", 4), ("images", 5)):
        own = stages[stage]
        assert own == sorted(own)
        for item in range(items - 1):
            assert any(item / items < fraction < (item + 1) / items for fraction in own)


def box_of(splats):
    """Return the corners of the box around one standard deviation of all Gaussians."""
    reach = np.sqrt(np.diagonal(covariances(splats.quats, splats.scales), axis1=1, axis2=2))
    return (splats.means - reach).min(axis=0), (splats.means + reach).max(axis=0)


@pytest.mark.parametrize("preset", ["fast", "balanced"])
@pytest.mark.quick(1)
def test_rows_of_a_leaf_are_those_of_its_part_of_space(scene, written, tmp_path, monkeypatch, preset):
    """Leaves are cells between cuts, so that no Gaussian of a leaf, merged or not, is between those of another."""
    if preset == "fast":
        target, report, _ = written("city/lod-meta.json")
    else:
        target, stages = tmp_path / "city" / "lod-meta.json", {}

        def progress(stage, fraction, note=""):
            stages.setdefault(stage, []).append(fraction)

        by_stages(monkeypatch)
        report = compress_streamed(scene, target, settings=Settings.from_preset(preset), progress=progress)
        assert_items_report_within(stages)
    document = json.loads(target.read_bytes())
    decoded = [kissgs.load(target.parent / name) for name in document["filenames"]]
    assert sum(map(len, decoded)) == sum(report.counts)
    leaves = tree_leaves(document["tree"])
    rows = [
        [
            decoded[lod["file"]].select(slice(lod["offset"], lod["offset"] + lod["count"]))
            for lod in leaf["lods"].values()
        ]
        for leaf in leaves
    ]
    for leaf, own in zip(leaves, rows, strict=True):
        low, high = box_of(concatenate(own))
        slack = 0.05 * (high - low) + 1e-3
        assert (low >= np.array(leaf["bound"]["min"]) - slack).all()
        assert (high <= np.array(leaf["bound"]["max"]) + slack).all()
    boxes = np.array([[(part.means.min(axis=0), part.means.max(axis=0)) for part in own] for own in rows])
    sides = (boxes[:, :, 1] - boxes[:, :, 0]).max(axis=2)
    for one, other in itertools.combinations(range(len(leaves)), 2):
        overlap = np.minimum(boxes[one, :, 1], boxes[other, :, 1]) - np.maximum(boxes[one, :, 0], boxes[other, :, 0])
        assert (overlap.min(axis=1) < 0.05 * np.minimum(sides[one], sides[other])).all()


@pytest.mark.quick(1)
def test_interrupted_work_goes_on_and_ends_with_the_same_bytes(target, tmp_path, monkeypatch):
    kissgs.save(kissgs.sample_scene(500, sh_degree=0, seed=3), tmp_path / "scene.ply")
    small_sizes(monkeypatch, chunk=250, leaf=150, coarsest=200)
    monkeypatch.setattr(levels, "FEWEST", 20)  # the sky becomes an environment
    compress_streamed(tmp_path / "scene.ply", tmp_path / "whole" / target.name, settings=FAST)
    expected = files_of(tmp_path / "whole")
    assert any(name.startswith("environment") for name in expected)
    events = 0
    while True:
        left = [events]

        def stop(stage, fraction, note="", left=left):
            left[0] -= 1
            if left[0] < 0:
                raise Stop

        try:
            compress_streamed(tmp_path / "scene.ply", target, settings=FAST, progress=stop)
        except Stop:
            events += 1
            assert not target.exists()
            continue
        break
    assert events > 6
    assert files_of(target.parent) == expected


def test_work_is_continued_with_the_same_settings_for_the_same_container_alone(scene, written, tmp_path, monkeypatch):
    """Work that goes on needs no room for what is done: new files take the place of others, and what a killed process
    left incomplete is removed."""
    target, expected = tmp_path / "city" / "lod-meta.json", files_of(written("city/lod-meta.json")[0].parent)

    def stop(stage, fraction, note=""):
        if stage == "images" and fraction > 0.5:
            raise Stop

    with pytest.raises(Stop):
        compress_streamed(scene, target, settings=FAST, progress=stop)
    (tmp_path / "city.partial" / "out" / ".kissgs.0.part").write_bytes(b"half")
    (tmp_path / ".kissgs.city.partial.old").mkdir()
    other = Settings.research("fast", sh0_step=0.1)
    for destination, settings in ((target, other), (target.with_name("levels.json"), FAST)):
        with pytest.raises(OutputError, match=r"city\.partial belongs to other or older work; delete it"):
            compress_streamed(scene, destination, settings=settings)

    def again(stage, fraction, note=""):
        if fraction == 1:  # the end
            return
        with pytest.raises(OutputError, match="another process works in"):
            compress_streamed(scene, target, settings=FAST)

    usage = shutil.disk_usage(tmp_path)
    monkeypatch.setattr(shutil, "disk_usage", lambda path: usage._replace(free=100_000))
    compress_streamed(scene, target, settings=FAST, progress=again)
    assert files_of(tmp_path / "city") == expected
    assert [path.name for path in tmp_path.iterdir()] == ["city"]


@pytest.mark.parametrize("name", TARGETS)
@pytest.mark.quick(0)
def test_the_number_of_threads_does_not_matter(scene, written, tmp_path, name):
    for threads in (1, 3):
        (tmp_path / str(threads)).mkdir()
        compress_streamed(scene, tmp_path / str(threads) / name, settings=FAST, threads=threads)
        assert files_of((tmp_path / str(threads) / name).parent) == files_of(written(name)[0].parent)


def test_what_cannot_be_made_leaves_nothing(scene, tmp_path, monkeypatch):
    """A scene that cannot be read, a missing folder, a disk that is too small."""
    target = tmp_path / "city" / "lod-meta.json"
    (tmp_path / "cut.ply").write_bytes(scene.read_bytes()[:-10])
    with pytest.raises(InvalidSceneError, match=r"cut\.ply"):
        compress_streamed(tmp_path / "cut.ply", target, settings=FAST)
    with pytest.raises(OutputError, match=r"there is no folder .*/none; make it first"):
        compress_streamed(scene, tmp_path / "none" / "city" / "lod-meta.json", settings=FAST)
    usage = shutil.disk_usage(tmp_path)
    monkeypatch.setattr(shutil, "disk_usage", lambda path: usage._replace(free=100_000))
    with pytest.raises(
        OutputError, match=r"city\.partial will take up to 358 kB, but its disk has 100 kB free; free some"
    ):
        compress_streamed(scene, target, settings=FAST)
    assert [path.name for path in tmp_path.iterdir()] == ["cut.ply"]


def test_invisible_gaussians_are_left_out_and_counted(tmp_path):
    made = kissgs.sample_scene(800, sh_degree=0, seed=3)
    opacities, means = made.opacities.copy(), made.means.copy()
    opacities[::7], means[5] = -9.0, np.nan
    kissgs.save(replace(made, opacities=opacities, means=means), tmp_path / "scene.ply")
    report = compress_streamed(tmp_path / "scene.ply", tmp_path / "city" / "lod-meta.json", settings=FAST)
    untiled = kissgs.compress(tmp_path / "scene.ply", settings=FAST).report
    assert report.changed["invisible"] == untiled.invisible > len(opacities[::7])
    assert (report.changed["non_finite"], report.changed["pruned_by_rd"]) == (1, 0)
    assert (report.source_count, report.counts[0]) == (800, untiled.count)


@needs_splat_transform
def test_splat_transform_reads_every_level(written, tmp_path):
    target, report, _ = written("city/lod-meta.json")
    for level in range(len(report.counts)):
        theirs = kissgs.load(convert(target, tmp_path / f"{level}.ply", "-L", str(level)))
        assert_alike(kissgs.load(target, level=level), theirs, rtol=1e-6, atol=1e-6)


def test_other_files_are_never_replaced(scene, copied, tmp_path):
    """Neither in another folder, nor beside the files of a streamed scene, nor in the work folder."""
    inner, mine = copied.parent / "0_0" / "mine.txt", copied.parent / "mine.txt"
    inner.parent.mkdir(exist_ok=True)
    inner.write_text("mine")
    with pytest.raises(OutputError, match=r"holds other files \(0_0"):
        compress_streamed(scene, copied, settings=FAST, overwrite=True)
    assert inner.read_text() == "mine"
    inner.unlink()
    document = json.loads(copied.read_bytes())
    document["filenames"] += ["mine.txt", "../mine.txt", "/etc/hosts", "sub/mine.txt"]
    copied.write_text(json.dumps(document))  # a manifest that names files beside its containers
    mine.write_text("mine")
    with pytest.raises(OutputError, match=r"holds other files \(mine\.txt\)"):
        compress_streamed(scene, copied, settings=FAST, overwrite=True)
    assert mine.read_text() == "mine"
    for folder, named in (("empty", "holds other files"), ("town.partial", r"town\.partial holds other files")):
        (tmp_path / folder).mkdir()
        (tmp_path / folder / "mine.txt").write_text("mine")
        target = tmp_path / folder.removesuffix(".partial") / copied.name
        with pytest.raises(OutputError, match=named):
            compress_streamed(scene, target, settings=FAST, overwrite=True)
        assert [path.name for path in (tmp_path / folder).iterdir()] == ["mine.txt"]


def test_what_is_no_manifest_is_never_replaced(scene, target):
    """One is too deep, the other too large."""
    target.parent.mkdir()
    for content in (b"[" * 100_000, b'{"filenames": []}' + b" " * MAX_TREE_BYTES):
        target.write_bytes(content)
        with pytest.raises(OutputError, match=f"holds other files .{target.name}"):
            compress_streamed(scene, target, settings=FAST, overwrite=True)
        assert target.stat().st_size == len(content)


@pytest.mark.quick(0)
def test_a_streamed_scene_is_replaced_only_if_allowed(scene, copied, tmp_path):
    """A scene of the other kind in the same folder is one too."""
    with pytest.raises(OutputError, match="exists already"):
        compress_streamed(scene, copied, settings=FAST)
    other = Settings.research("fast", sh0_step=0.1)
    for name in ("lod-meta.json", "levels.json", "lod-meta.json"):
        compress_streamed(scene, copied.parent / name, settings=other, overwrite=True)
        shutil.rmtree(tmp_path / "new", ignore_errors=True)
        compress_streamed(scene, tmp_path / "new" / name, settings=other)
        assert files_of(copied.parent) == files_of(tmp_path / "new")


def test_the_folder_of_levels_of_sogxt_is_named_by_its_ending(scene, written, tmp_path):
    compress_streamed(scene, f"{tmp_path}/city.sogxt/", settings=FAST)
    assert files_of(tmp_path / "city.sogxt") == files_of(written("city.sogxt/levels.json")[0].parent)
    assert "0_0.zip" in files_of(tmp_path / "city.sogxt")
    with pytest.raises(OutputError, match=r"town is no name of a streamed scene"):
        compress_streamed(scene, tmp_path / "town", settings=FAST)


def test_the_current_folder_is_not_replaced(scene, tmp_path, monkeypatch):
    (tmp_path / "here" / "inner").mkdir(parents=True)
    for folder, says in (("here", "is the current folder"), ("here/inner", "has the current folder in it")):
        monkeypatch.chdir(tmp_path / folder)
        for name in ("lod-meta.json", "inner/../lod-meta.json"):
            path = Path(name) if folder == "here" else Path("..", name)
            with pytest.raises(OutputError, match=rf"as a whole, but {says}; name lod-meta\.json in a new folder$"):
                compress_streamed(scene, path, settings=FAST)
    assert [path.name for path in tmp_path.iterdir()] == ["here"]


@pytest.mark.parametrize("made", ["link", "mount point", "file"])
def test_what_is_no_folder_of_its_own_is_not_replaced(scene, tmp_path, monkeypatch, made):
    folder = tmp_path / "city"
    if made == "link":
        folder.symlink_to(tmp_path)
    elif made == "file":
        folder.write_text("mine")
    else:
        folder.mkdir()
        monkeypatch.setattr(Path, "is_mount", lambda path: path == folder)
    with pytest.raises(
        OutputError, match=f"city is a {made} and cannot be replaced as a whole; name lod-meta.json in a"
    ):
        compress_streamed(scene, folder / "lod-meta.json", settings=FAST)


@pytest.mark.parametrize(("stage", "reason"), [("partition", errno.EDQUOT), ("images", errno.ENOSPC)])
@pytest.mark.quick(1)
def test_a_disk_that_fills_up_does_not_end_the_work_for_good(scene, target, tmp_path, monkeypatch, stage, reason):
    with monkeypatch.context() as patch:

        def fill(now, fraction, note=""):
            if now == stage:
                patch.setattr(os, "fsync", full)

        def full(descriptor):
            raise OSError(reason, os.strerror(reason))

        then = "goes on where it was" if stage == "images" else "begins anew"
        said = f"^cannot write .*: {os.strerror(reason).lower()}; once there is room, the same command {then}$"
        with pytest.raises(OutputError, match=said):
            compress_streamed(scene, target, settings=FAST, progress=fill)
    assert target.parent.with_name(f"{target.parent.name}.partial").exists() == (stage == "images")
    compress_streamed(scene, target, settings=FAST)
    assert len(kissgs.load(target)) > 0


@pytest.mark.parametrize("changes", [{"target_size": "1MB"}, {"compact": {"ratio": 0.5}}, {"order": "plas"}])
def test_settings_that_do_not_fit_are_refused(scene, tmp_path, changes):
    with pytest.raises(UnsupportedError):
        compress_streamed(scene, tmp_path / "city" / "lod-meta.json", settings=Settings.research("fast", **changes))
