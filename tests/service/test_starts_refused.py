"""Starts with the files of a data folder, refused because of its database or not; oracle: the files before."""

import asyncio
import contextlib
import os
import random
import shutil
import sqlite3
import time
from pathlib import Path

import pytest
from fastapi import Response
from helpers.data_folders import database, finish_a_job, listing, names, opened, service, swept

from service.core.models import SCHEMA_VERSION, State
from service.core.settings import SettingsError
from service.http.routes import facts

pytestmark = pytest.mark.usefixtures("no_variables")


def file_of(folder):
    return folder / "jobs.sqlite"


def a_folder_instead(folder):
    file_of(folder).unlink()
    file_of(folder).mkdir()


def truncate(folder):
    os.truncate(file_of(folder), file_of(folder).stat().st_size // 2 + 700)


def delete(folder):
    file_of(folder).unlink()


def executes(*statements):
    """Return a change of the database."""
    return lambda folder: database(folder, *statements)


OF_A_NEWER_VERSION = executes(f"UPDATE meta SET value = {SCHEMA_VERSION + 1} WHERE name = 'schema'")
OLDER = (f"UPDATE meta SET value = {SCHEMA_VERSION - 1} WHERE name = 'schema'", "DROP TABLE events")
OTHER_VERSION = "schema version {}, but this service needs " + str(SCHEMA_VERSION)
NONE_OF_THEM = "is new and has none of them; restore"

REFUSED = {
    "no database": (lambda it: file_of(it).write_bytes(b"none" * 5000), "file is not a database; restore it"),
    "a folder instead": (a_folder_instead, "cannot be opened"),
    "deleted": (delete, NONE_OF_THEM),
    "emptied": (lambda it: file_of(it).write_bytes(b""), NONE_OF_THEM),
    "no rows": (executes(*(f"DELETE FROM {name}" for name in ("events", "jobs", "meta"))), NONE_OF_THEM),
    "truncated": (truncate, "damaged|malformed"),
    "no table meta": (executes("DROP TABLE meta"), "damaged: the schema version of its tables is missing"),
    "a column dropped": (executes("ALTER TABLE jobs DROP COLUMN note"), "no such column: jobs.note"),
    "a value damaged": (executes("UPDATE jobs SET options = '{\"preset' WHERE number = 7"), "damaged: "),
    "an older version": (executes(*OLDER), OTHER_VERSION.format(SCHEMA_VERSION - 1)),
    "a newer version": (OF_A_NEWER_VERSION, OTHER_VERSION.format(SCHEMA_VERSION + 1)),
    **{
        f"invalid {name}": (
            executes(f"INSERT OR REPLACE INTO meta VALUES ('{name}', {value})"),
            f"damaged: its table meta has no valid {name}",
        )
        for name, value in (("identity", "'text'"), ("schema", "x'00ff'"), ("time", "1e999"))
    },
}


@pytest.mark.parametrize("change", REFUSED)
def test_a_refused_start_removes_nothing(jobs_folder, change):
    damage, message = REFUSED[change]
    damage(jobs_folder)
    for _ in range(2):  # the first attempt must not change the result of the second
        assert_refused(jobs_folder, message)
    assert not (jobs_folder / "jobs" / ".orphaned").exists()


def assert_refused(folder, message):
    """Assert that a start ends in one line and removes and changes no file."""
    before = listing(folder)
    with pytest.raises(SettingsError, match=message) as caught:
        opened(folder)
    assert "\n" not in str(caught.value)
    assert listing(folder).items() >= before.items()


@pytest.mark.quick(0)
def test_a_locked_database(jobs_folder):
    with contextlib.closing(sqlite3.connect(jobs_folder / "jobs.sqlite")) as other:
        other.execute("PRAGMA locking_mode=EXCLUSIVE")
        other.execute("BEGIN EXCLUSIVE")
        begun = time.monotonic()
        assert_refused(jobs_folder, "locked; another program has locked it")
        assert time.monotonic() - begun < 20
    with service(jobs_folder) as context:
        assert len(context.store.ids()) == 12


def test_a_read_only_folder(jobs_folder):
    if os.geteuid() == 0:
        bind = f"(mount --bind '{jobs_folder}' '{jobs_folder}' && mount -o remount,ro,bind '{jobs_folder}') 2>/dev/null"
        if os.system(bind) != 0:
            pytest.skip("mounting a folder is not permitted")
    else:
        jobs_folder.chmod(0o500)
    try:
        assert_refused(jobs_folder, "KISSGS_DATA_DIR: cannot use")
    finally:
        os.system(f"umount -l '{jobs_folder}'") if os.geteuid() == 0 else jobs_folder.chmod(0o700)


@pytest.mark.parametrize("seed", range(3))
def test_flipped_bits(jobs_folder, seed):
    """Wherever they are, the service starts and has all jobs, or refuses with one line."""
    rng = random.Random(seed)
    path = jobs_folder / "jobs.sqlite"
    content = bytearray(path.read_bytes())
    for _ in range([1, 20, 500][seed]):
        content[rng.randrange(len(content))] ^= 1 << rng.randrange(8)
    path.write_bytes(content)
    before = sorted(path.parent.name for path in (jobs_folder / "jobs").rglob("scene.ply"))
    message = ""
    try:
        with service(jobs_folder):
            pass
    except SettingsError as error:
        message = str(error)
    assert "\n" not in message
    assert sorted(path.parent.name for path in (jobs_folder / "jobs").rglob("scene.ply")) == before


def test_a_refused_start_keeps_the_journal(tmp_path):
    """The last changes of a killed service are only in the journal, which a refused start must not remove."""
    with service(tmp_path / "own") as context:
        finish_a_job(context)
        OF_A_NEWER_VERSION(tmp_path / "own")
        shutil.copytree(tmp_path / "own", tmp_path / "killed")
    before = listing(tmp_path / "killed")
    assert {"jobs.sqlite-wal", "jobs.sqlite"} <= {str(name) for name in before}
    with pytest.raises(SettingsError, match=r"job database .* schema version"):
        opened(tmp_path / "killed")
    after = listing(tmp_path / "killed")
    for name in ("jobs.sqlite", "jobs.sqlite-wal"):
        assert after[Path(name)] == before[Path(name)]


def test_the_orphaned_folder_must_be_a_folder(jobs_folder):
    (jobs_folder / "jobs" / ".orphaned").write_text("own")
    (jobs_folder / "jobs" / ("0" * 32)).mkdir()
    before = listing(jobs_folder)
    with pytest.raises(SettingsError, match=r"/jobs/\.orphaned is not a folder; move it away$"), service(jobs_folder):
        pass
    assert listing(jobs_folder).items() >= before.items()


def test_a_folder_of_an_earlier_version(jobs_folder):
    """It has numbers of the folder and of its owner, in files and in the database."""
    for name in ("identity", "database"):
        (jobs_folder / name).write_text("123\n")
    for name in ("folder", "owner", "owner-process", "owner-machine"):
        database(jobs_folder, f"INSERT INTO meta VALUES ('{name}', 123)")
    with service(jobs_folder) as context:
        assert context.storage.job_ids() == context.store.ids()
        assert context.store.monitor.health_problem() is None
        assert finish_a_job(context) in context.store.ids()


def test_a_start_after_the_jobs_were_moved_away(jobs_folder):
    (jobs_folder / "jobs.sqlite").unlink()
    (jobs_folder / "jobs").rename(jobs_folder / "old")
    with service(jobs_folder):
        pass
    (jobs_folder / "jobs.sqlite").unlink()  # without jobs, a new database is right
    with service(jobs_folder) as context:
        assert context.store.ids() == set()
        assert context.store.monitor.health_problem() is None
        finish_a_job(context)
    with service(jobs_folder) as context:
        assert len(context.store.ids()) == 1
    assert len(list((jobs_folder / "old").iterdir())) == 12


def test_folders_of_unknown_jobs_are_moved(jobs_folder, caplog):
    """The database is an older copy without the latest job."""
    known = names(jobs_folder / "jobs")
    shutil.copy(jobs_folder / "jobs.sqlite", jobs_folder.parent / "old.sqlite")
    with service(jobs_folder) as context:
        job = finish_a_job(context)
    shutil.copytree(jobs_folder / "jobs" / job, jobs_folder / "jobs" / ".orphaned" / job)
    (jobs_folder / "jobs" / ".orphaned" / job / "scene.ply").write_bytes(b"an earlier one")
    shutil.copy(jobs_folder.parent / "old.sqlite", jobs_folder / "jobs.sqlite")
    (jobs_folder / "jobs" / job / "work-0123456789abcdef").mkdir()
    before = listing(jobs_folder / "jobs" / job)
    with service(jobs_folder) as context:
        assert context.storage.job_ids() == known
        assert context.storage.count_orphaned() == 2
    assert listing(jobs_folder / "jobs" / ".orphaned" / f"{job}-2") == before
    assert (jobs_folder / "jobs" / ".orphaned" / job / "scene.ply").read_bytes() == b"an earlier one"
    assert f"that the database does not know were moved to {jobs_folder}/jobs/.orphaned: 1" in caplog.text
    caplog.clear()
    with service(jobs_folder) as context:
        assert context.storage.count_orphaned() == 2
        health = asyncio.run(facts.get_readyz(context, Response()))
        assert health.checks["orphaned"] == "folders without a job in jobs/.orphaned of the data folder: 2"
    assert caplog.text == ""


def test_other_files_are_not_removed(jobs_folder):
    job = min(names(jobs_folder / "jobs"))
    others = ["notes.txt", "incoming/notes.txt", "incoming/x.part", "jobs/notes.txt", "jobs/mine/scene.ply"]
    others += ["work-1/x", "lock", f"jobs/{job}/notes.txt"]
    for name in others:
        (jobs_folder / name).parent.mkdir(exist_ok=True)
        (jobs_folder / name).write_text("mine")
    (jobs_folder / "incoming" / "0123456789abcdef.part").write_text("half an upload")
    (jobs_folder / "jobs" / job / "work-0123456789abcdef").mkdir()
    with service(jobs_folder) as context:
        assert not (jobs_folder / "incoming" / "0123456789abcdef.part").exists()
        assert not (jobs_folder / "jobs" / job / "work-0123456789abcdef").exists()
        assert {name: (jobs_folder / name).read_text() for name in others} == dict.fromkeys(others, "mine")
        context.clock._offset += 10**6
        swept(context)
        assert context.storage.job_ids() == set()
    others[-1] = f"jobs/.orphaned/{job}/notes.txt"
    assert {name: (jobs_folder / name).read_text() for name in others} == dict.fromkeys(others, "mine")
    assert names(jobs_folder / "jobs" / ".orphaned" / job) == {"notes.txt"}


def test_an_interrupted_removal_is_completed(tmp_path):
    with service(tmp_path / "data") as context:
        job = finish_a_job(context, State.EXPIRED)
        assert context.storage.job_ids() == {job}
    with service(tmp_path / "data") as context:
        assert (context.storage.job_ids(), context.storage.count_orphaned()) == (set(), 0)


def test_only_jobs_are_removed(jobs_folder):
    with service(jobs_folder) as context:
        for name in ("", "..", ".", "../jobs", ".orphaned", "a/b", "0" * 31):
            with pytest.raises(ValueError, match="not a job id"):
                context.storage.remove_job(name)
