"""The end of a streamed compression, interrupted anywhere. Oracle: the result of work that was not interrupted."""

import contextlib
import os
import shutil
from pathlib import Path

import pytest
from helpers.streamed_scenes import FAST, files_of, saved_sample, small_sizes

import kissgs
from kissgs import Settings
from kissgs.core.errors import OutputError
from kissgs.streaming.compress import compress_streamed

OTHER = Settings.research("fast", sh0_step=0.1)


@pytest.fixture(autouse=True)
def small(monkeypatch):
    small_sizes(monkeypatch, chunk=800, leaf=300, coarsest=800)


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    return saved_sample(tmp_path_factory, 1500, 0)


class Killed(BaseException):
    pass


def killed_at(step, monkeypatch):
    """Let the process die before the n-th time that it renames or removes something outside of its own temporaries."""
    left = [step]

    def counted(function):
        def call(*arguments, **options):
            if ".kissgs." not in Path(str(arguments[0])).name:
                left[0] -= 1
                if left[0] < 0:
                    raise Killed
            return function(*arguments, **options)

        return call

    monkeypatch.setattr(Path, "rename", counted(Path.rename))
    monkeypatch.setattr(os, "unlink", counted(os.unlink))  # rmtree
    monkeypatch.setattr(os, "rmdir", counted(os.rmdir))
    return left


@pytest.mark.parametrize(("name", "force"), [("lod-meta.json", False), ("lod-meta.json", True), ("levels.json", True)])
@pytest.mark.quick(0)
def test_it_may_be_killed_before_every_change_of_the_disk(scene, tmp_path, monkeypatch, name, force):
    target = tmp_path / "city" / name
    compress_streamed(scene, tmp_path / "whole" / name, settings=FAST)
    expected = files_of(tmp_path / "whole")
    step = 0
    while True:
        shutil.rmtree(tmp_path / "city", ignore_errors=True)
        if force:
            compress_streamed(scene, target, settings=OTHER)
        with monkeypatch.context() as patch:
            left = killed_at(step, patch)
            with contextlib.suppress(Killed):
                compress_streamed(scene, target, settings=FAST, overwrite=force)
            done = left[0] >= 0
        if not done and (tmp_path / "city.partial").exists():
            compress_streamed(scene, target, settings=FAST, overwrite=force)
        assert files_of(tmp_path / "city") == expected
        assert not (tmp_path / "city.partial").exists()
        if done:
            break
        step += 1
    assert step >= 4


FILE_OPERATIONS = ("lstat", "open", "rename", "replace", "rmdir", "scandir", "unlink")
"""Functions of ``os`` by which files are removed, and those by which they might be."""


def test_the_removal_of_a_partition_may_be_interrupted_before_every_operation(scene, tmp_path, monkeypatch):
    target, work = tmp_path / "city" / "lod-meta.json", tmp_path / "city.partial"

    def partitioned(step):
        """Interrupt a partition that has written files, and the n-th operation of their removal, if there is one."""
        with monkeypatch.context() as patch:
            left = [step]

            def counted(function):
                def call(*arguments, **options):
                    left[0] -= 1
                    if left[0] == -1:
                        raise Killed
                    return function(*arguments, **options)

                return call

            def interrupt(stage, fraction, note=""):
                if stage == "partition" and any(work.glob("chunk_*")):
                    for name in FILE_OPERATIONS:
                        patch.setattr(os, name, counted(getattr(os, name)))
                    raise Killed

            with pytest.raises(Killed):
                compress_streamed(scene, target, settings=FAST, progress=interrupt)
            return left[0] < 0

    step = 0
    while partitioned(step):
        step += 1
    assert step >= 8
    assert list(tmp_path.iterdir()) == []
    partitioned(step // 2)
    assert work.exists()
    compress_streamed(scene, target, settings=FAST)
    assert [path.name for path in tmp_path.iterdir()] == ["city"]


def test_files_that_appear_meanwhile_are_kept(scene, tmp_path):
    target = tmp_path / "city" / "lod-meta.json"

    def put(stage, fraction, note=""):
        if stage == "images" and fraction < 1:
            target.parent.mkdir(exist_ok=True)
            (target.parent / "mine.txt").write_text("mine")

    for overwrite in (False, True):
        with pytest.raises(OutputError, match=r"holds other files \(mine\.txt\)"):
            compress_streamed(scene, target, settings=FAST, overwrite=overwrite, progress=put)
    (target.parent / "mine.txt").unlink()
    compress_streamed(scene, target, settings=FAST)
    assert len(kissgs.load(target)) > 1000


def test_a_result_of_another_process_is_not_replaced(scene, tmp_path):
    target = tmp_path / "city" / "lod-meta.json"
    compress_streamed(scene, tmp_path / "other" / "lod-meta.json", settings=OTHER)
    expected = files_of(tmp_path / "other")

    def put(stage, fraction, note=""):
        if stage == "images" and fraction < 1 and (tmp_path / "other").exists():
            (tmp_path / "other").rename(tmp_path / "city")

    with pytest.raises(OutputError, match="exists already"):
        compress_streamed(scene, target, settings=FAST, progress=put)
    assert files_of(tmp_path / "city") == expected


@pytest.mark.parametrize(("stage", "name"), [("merge", "chunk_0.f32"), ("images", "chunk_0_level_0.f32")])
def test_scratch_files_that_are_cut_are_noticed(scene, tmp_path, stage, name):
    def cut(now, fraction, note=""):
        path = tmp_path / "city.partial" / name
        if now == stage and path.exists():
            os.truncate(path, path.stat().st_size - 8)

    with pytest.raises(OutputError, match=rf"{name} is not complete; delete .*city\.partial and start again"):
        compress_streamed(scene, tmp_path / "city" / "lod-meta.json", settings=FAST, progress=cut)
    assert not (tmp_path / "city").exists()


def test_a_scene_that_changes_while_it_is_read_is_refused(scene, tmp_path):
    shutil.copy(scene, tmp_path / "scene.ply")

    def change(stage, fraction, note=""):
        if stage == "partition" and fraction < 1:
            os.utime(tmp_path / "scene.ply", (1, 1))

    with pytest.raises(kissgs.InvalidSceneError, match="was changed while it was read"):
        compress_streamed(tmp_path / "scene.ply", tmp_path / "city" / "lod-meta.json", settings=FAST, progress=change)
    assert [path.name for path in tmp_path.iterdir()] == ["scene.ply"]


def test_names_and_inputs_that_would_be_replaced_are_refused(scene, tmp_path):
    compress_streamed(str(scene), str(tmp_path / "city" / "lod-meta.json"), settings=FAST)
    target = tmp_path / "city" / "lod-meta.json"
    for source in (target, tmp_path / "city" / "0_0" / "meta.json"):
        with pytest.raises(OutputError, match="would be replaced as a whole, but has the input in it"):
            compress_streamed(source, target, settings=FAST, overwrite=True)
    (tmp_path / "city" / "0_0" / "empty").mkdir()
    with pytest.raises(OutputError, match=r"holds other files \(0_0/empty\)"):
        compress_streamed(scene, target, settings=FAST, overwrite=True)
    (tmp_path / "town.partial").symlink_to(tmp_path)
    with pytest.raises(OutputError, match="is a link"):
        compress_streamed(scene, tmp_path / "town" / "lod-meta.json", settings=FAST)
    assert len(kissgs.load(target)) > 1000
