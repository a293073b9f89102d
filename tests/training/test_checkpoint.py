"""Oracle: what was put in, and the file system."""

import numpy as np
import pytest

from kissgs import OutputError
from kissgs.training import checkpoint
from kissgs.training.checkpoint import Checkpoint

STATE = {"a": np.arange(6.0).reshape(2, 3), "told": np.asarray('{"x": 1}'), "none": np.empty(0, np.float32)}


def test_what_is_kept_comes_back(tmp_path):
    path = tmp_path / "c.npz"
    kept = Checkpoint(path, "key")
    assert kept.load() is None
    kept.save(STATE)
    found = Checkpoint(path, "key").load()
    assert found.keys() == STATE.keys()
    assert all((found[name] == STATE[name]).all() and found[name].dtype == STATE[name].dtype for name in STATE)
    assert [entry.name for entry in tmp_path.iterdir()] == ["c.npz"]


def test_other_work_is_not_taken_up_and_not_written_over(tmp_path):
    Checkpoint(tmp_path / "c.npz", "one").save(STATE)
    with pytest.raises(OutputError, match=r"checkpoint of other work.*delete it to begin anew"):
        Checkpoint(tmp_path / "c.npz", "other").load()


@pytest.mark.parametrize("content", [b"", b"PK\x03\x04 cut short", b"some text", "npz", "npy"])
def test_other_files_are_told_from_checkpoints(tmp_path, content):
    path = tmp_path / "c.npz"
    if content == "npz":
        np.savez(path, x=np.zeros(3))
    elif content == "npy":
        with path.open("wb") as file:
            np.save(file, np.zeros(3))
    else:
        path.write_bytes(content)
    with pytest.raises(OutputError, match=r"c\.npz is no checkpoint of kissgs; move it away or delete it"):
        Checkpoint(path, "key").load()


def test_a_damaged_one_is_told_too(tmp_path):
    path = tmp_path / "c.npz"
    Checkpoint(path, "key").save(STATE)
    data = bytearray(path.read_bytes())
    for signature, at in ((b"PK\x03\x04", 8), (b"PK\x01\x02", 10)):
        data[data.index(signature) + at] = 99  # a method of compression that nobody has
    path.write_bytes(data)
    with pytest.raises(OutputError, match=r"c\.npz is no checkpoint of kissgs"):
        Checkpoint(path, "key")


def test_a_folder_in_its_place(tmp_path):
    with pytest.raises(OutputError, match="is a folder; name a file"):
        Checkpoint(tmp_path, "key").load()


@pytest.mark.parametrize(("seconds", "due"), [(0.0, True), (1000.0, False)])
def test_it_is_due_after_its_time(tmp_path, monkeypatch, seconds, due):
    monkeypatch.setattr(checkpoint, "SECONDS", seconds)
    assert Checkpoint(tmp_path / "c.npz", "key").due == due
    assert not Checkpoint(None, "key").due


def test_without_a_path_nothing_is_kept():
    kept = Checkpoint(None, "")
    kept.save(STATE)
    assert kept.load() is None
