"""Temporary folders of items. Oracle: what lies in the system's folder for temporary files."""

import fcntl
import os
import signal
import subprocess
import sys
import tempfile
from pathlib import Path

import pytest
from helpers.ray_cluster import PATHS
from helpers.running import item, pid_in, wait_until

from kissgs.runners.process import ItemProcess, temporary_folder

SUPERVISOR = """
import sys
from helpers.running import item
from kissgs.runners.process import ItemProcess
for event in ItemProcess(item("count", numbers=1000, seconds_between=0.1, pid=sys.argv[1])).events():
    pass
"""


@pytest.fixture(autouse=True)
def temporary(tmp_path, monkeypatch):
    """The system's folder for temporary files, of this test alone."""
    folder = tmp_path / "temporary"
    folder.mkdir()
    monkeypatch.setenv("TMPDIR", str(folder))
    monkeypatch.setattr(tempfile, "tempdir", None)
    return folder


def test_an_item_works_in_a_folder_of_its_own_that_is_gone_at_its_end(temporary):
    process = ItemProcess(item("leave_a_file", text="scene"))
    (_, during), (outcome, after) = [(event, sorted(temporary.iterdir())) for event in process.events()]
    assert (outcome.kind, after) == ("done", [])
    assert during == [Path(outcome.result["folder"])]


def test_a_killed_item_leaves_nothing(temporary):
    process = ItemProcess(item("leave_a_file", text="scene", seconds_between=600))
    events = process.events()
    next(events)
    process.kill()
    assert [outcome.kind for outcome in events] == ["cancelled"]
    assert list(temporary.iterdir()) == []


def test_what_a_killed_supervisor_leaves_is_removed_by_the_next_item(temporary, tmp_path):
    command = [sys.executable, "-c", SUPERVISOR, tmp_path / "pid"]
    with subprocess.Popen(command, env={**os.environ, "PYTHONPATH": PATHS}) as supervisor:
        working = Path(f"/proc/{pid_in(tmp_path / 'pid')}/cwd").readlink()
        with temporary_folder() as other:  # of a living one, it stays
            assert working.is_dir()
        assert not other.exists()
        supervisor.send_signal(signal.SIGKILL)
    assert working.is_dir()
    wait_until(lambda: list(ItemProcess(item("count", numbers=0)).events()) and not working.exists())
    assert list(temporary.iterdir()) == []


@pytest.mark.parametrize("function", ["fcntl.flock", "shutil.rmtree"])
def test_what_is_left_by_a_kill_at_any_step_is_removed(temporary, function):
    """Regression: a process killed before it had locked its folder left that for ever."""
    code = f"""
import fcntl, os, shutil
from kissgs.runners.process import temporary_folder
{function} = lambda *words, **options: os.kill(os.getpid(), 9)
with temporary_folder() as folder:
    (folder / "file").touch()
"""
    killed = subprocess.run([sys.executable, "-c", code], check=False)
    assert killed.returncode == -signal.SIGKILL
    assert list(temporary.iterdir())
    with temporary_folder() as folder:
        assert list(temporary.iterdir()) == [folder]


def test_a_folder_that_is_being_made_survives_the_removal_of_remains(temporary, monkeypatch):
    """The other process looks for remains when the folder is there, but not locked yet."""
    lock, others = fcntl.flock, []

    def slow(file, how):
        if not others:
            others.append(True)
            with temporary_folder():
                pass
        lock(file, how)

    monkeypatch.setattr(fcntl, "flock", slow)
    with temporary_folder() as folder, temporary_folder() as other:
        assert folder.is_dir()
        assert other != folder
    assert list(temporary.iterdir()) == []


def test_links_and_other_files_stay(temporary, tmp_path):
    (tmp_path / "precious").mkdir()
    (temporary / "kissgs-item-link").symlink_to(tmp_path / "precious")
    (temporary / "kissgs-item-file").touch()
    with temporary_folder():
        assert (tmp_path / "precious").is_dir()
        assert len(list(temporary.iterdir())) == 3


def test_folders_of_other_users_stay(temporary, monkeypatch):
    (temporary / "kissgs-item-other").mkdir()
    user = os.geteuid()
    monkeypatch.setattr(os, "geteuid", lambda: user + 1)
    with temporary_folder():
        assert (temporary / "kissgs-item-other").is_dir()


def test_no_folder_can_be_made(temporary, monkeypatch):
    def refuse(*words, **options):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(tempfile, "mkdtemp", refuse)
    (outcome,) = ItemProcess(item("count", numbers=1)).events()
    assert (outcome.kind, outcome.code) == ("lost", "not-started")
    assert "could not start a process: no space left on device" in outcome.message
    assert list(temporary.iterdir()) == []
