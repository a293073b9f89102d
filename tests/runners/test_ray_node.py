"""Files of items on nodes that do not see their folder. Oracle: the files themselves, and their SHA-256."""

import hashlib
import os
import shutil

import pytest
from helpers.running import item, wait_until
from helpers.streamed_scenes import files_of as contents

ray_node = pytest.importorskip("kissgs.runners.ray_node")  # which needs Ray
changed, receive, times_of = ray_node.changed, ray_node.receive, ray_node.times_of

BLOCK = 10


@pytest.fixture
def folders(tmp_path, monkeypatch):
    monkeypatch.setattr(ray_node, "BLOCK_BYTES", BLOCK)
    for name in ("there", "here"):
        (tmp_path / name).mkdir()
    return tmp_path / "there", tmp_path / "here"


def test_new_and_changed_files_arrive(folders):
    there, here = folders
    for size in (0, 1, BLOCK - 1, BLOCK, BLOCK + 1, 3 * BLOCK):
        (there / f"file{size}").write_bytes(os.urandom(size))
    (there / "made" / "files").mkdir(parents=True)
    (there / "made" / "files" / "nested").write_bytes(bytes(25))
    (there / ".file.part").write_bytes(b"not complete")
    before = {"file1": times_of(there)["file1"]}
    for event in changed(there, before, complete=False):
        receive(here, event)
    expected = {name: data for name, data in contents(there).items() if name not in ("file1", ".file.part")}
    assert contents(here) == {name: data for name, data in expected.items() if "/" not in name}
    for event in changed(there, before, complete=True):
        receive(here, event)
    assert contents(here) == expected
    assert list(changed(there, before, complete=True)) == []


def test_a_transfer_that_was_interrupted_begins_again(folders):
    there, here = folders
    (there / "file").write_bytes(bytes(range(45)))
    for event in list(changed(there, {}, complete=True))[:-1]:
        receive(here, event)
    assert [path.name for path in here.iterdir()] == [".file.part"]
    (there / "file").write_bytes(b"shorter")
    for event in changed(there, {}, complete=True):
        receive(here, event)
    assert contents(here) == {"file": b"shorter"}


def test_a_folder_that_was_removed_is_not_made_again(folders):
    there, here = folders
    (there / "made").mkdir()
    (there / "made" / "file").write_bytes(b"x")
    here.rmdir()
    with pytest.raises(FileNotFoundError):
        receive(here, next(changed(there, {}, complete=True)))
    assert not here.exists()


@pytest.fixture
def work(tmp_path):
    """A folder that no node sees, with 9 MB, and an item that needs them."""
    (tmp_path / "job").mkdir()
    (tmp_path / "job" / "scene").write_bytes(os.urandom(9_000_000))
    starts = tmp_path / "starts"
    return tmp_path / "job", item("digest", starts=str(starts), folder=str(tmp_path / "job"), files=("scene",))


def test_an_item_whose_node_is_killed_leaves_its_checkpoint(whole_cluster, ray_runner, work):
    folder, submitted = work
    stages = []
    handle = ray_runner.submit(submitted, lambda *event: stages.append(event))
    wait_until((folder / "checkpoint").exists)
    assert {path.name for path in folder.iterdir()} == {"scene", "checkpoint"}
    (pid,) = whole_cluster.items()
    whole_cluster.kill_node_of(pid)
    outcome = handle.result(120)
    assert outcome.kind == "done"
    assert stages[0][:2] == stages[-1][:2] == ("digest", 0.0)
    assert outcome.result["folder"].startswith(str(whole_cluster.folder))
    digest = hashlib.sha256((folder / "scene").read_bytes()).hexdigest()
    assert contents(folder / "made") == {"digest": digest.encode()}
    assert len((folder.parent / "starts").read_text().splitlines()) == 2
    wait_until(lambda: whole_cluster.left_by_items() == [])


def test_files_that_cannot_be_stored_end_the_item(ray_cluster, ray_runner, work):
    folder, submitted = work
    shutil.rmtree(folder)
    outcome = ray_runner.submit(submitted).result(120)
    assert (outcome.kind, outcome.code) == ("error", "output")
    assert outcome.message == "the files of the work cannot be read or written: no such file or directory"
