"""Checkpoints. Oracle: the saved state, and the file system."""

import numpy as np
import pytest

from kissgs import OutputError
from kissgs.training import checkpoint
from kissgs.training.checkpoint import Checkpoint

STATE = {"a": np.arange(6.0).reshape(2, 3), "json": np.asarray('{"x": 1}'), "none": np.empty(0, np.float32)}


def test_a_saved_state_is_loaded(tmp_path):
    path = tmp_path / "c.npz"
    saved = Checkpoint(path, "key")
    assert saved.load() is None
    saved.save(STATE)
    found = Checkpoint(path, "key").load()
    assert found.keys() == STATE.keys()
    assert all((found[name] == STATE[name]).all() and found[name].dtype == STATE[name].dtype for name in STATE)
    assert [entry.name for entry in tmp_path.iterdir()] == ["c.npz"]


def test_checkpoints_of_other_work_are_neither_loaded_nor_overwritten(tmp_path):
    Checkpoint(tmp_path / "c.npz", "one").save(STATE)
    with pytest.raises(OutputError, match=r"checkpoint of other work.*delete it to start again"):
        Checkpoint(tmp_path / "c.npz", "other").load()


@pytest.mark.parametrize("content", [b"", b"PK\x03\x04 cut short", b"some text", "npz", "npy"])
def test_files_that_are_no_checkpoints_are_rejected(tmp_path, content):
    path = tmp_path / "c.npz"
    if content == "npz":
        np.savez(path, x=np.zeros(3))
    elif content == "npy":
        with path.open("wb") as file:
            np.save(file, np.zeros(3))
    else:
        path.write_bytes(content)
    with pytest.raises(OutputError, match=r"c\.npz is no checkpoint of kissgs; move or delete it"):
        Checkpoint(path, "key").load()


def test_damaged_checkpoints_are_rejected(tmp_path):
    path = tmp_path / "c.npz"
    Checkpoint(path, "key").save(STATE)
    data = bytearray(path.read_bytes())
    for signature, offset in ((b"PK\x03\x04", 8), (b"PK\x01\x02", 10)):
        data[data.index(signature) + offset] = 99  # an unknown compression method
    path.write_bytes(data)
    with pytest.raises(OutputError, match=r"c\.npz is no checkpoint of kissgs"):
        Checkpoint(path, "key")
    with pytest.raises(OutputError, match="is a folder; name a file"):
        Checkpoint(tmp_path, "key")


@pytest.mark.parametrize(("seconds", "due"), [(0.0, True), (1000.0, False)])
def test_a_save_is_due_after_the_interval(tmp_path, monkeypatch, seconds, due):
    monkeypatch.setattr(checkpoint, "SAVE_INTERVAL", seconds)
    assert Checkpoint(tmp_path / "c.npz", "key").due == due
    assert not Checkpoint(None, "key").due


def test_nothing_is_saved_without_a_path():
    checkpoint_ = Checkpoint(None, "")
    checkpoint_.save(STATE)
    assert checkpoint_.load() is None
