"""Refused starts, because of the database of a data folder; oracle: the files before."""

import contextlib
import os
import random
import shutil
import sqlite3
import time
from pathlib import Path

import pytest
from helpers.data_folders import command, database, finish_a_job, listing, opened, service

from service.core.models import SCHEMA_VERSION
from service.core.settings import SettingsError

pytestmark = pytest.mark.usefixtures("no_variables")


def no_database(folder):
    (folder / "jobs.sqlite").write_bytes(b"this is no database" * 1000)


def a_folder_instead(folder):
    (folder / "jobs.sqlite").unlink()
    (folder / "jobs.sqlite").mkdir()


def deleted(folder):
    (folder / "jobs.sqlite").unlink()


def emptied(folder):
    (folder / "jobs.sqlite").write_bytes(b"")


def rows_deleted(folder):
    database(folder, "DELETE FROM events", "DELETE FROM jobs", "DELETE FROM meta")


def truncated(folder):
    os.truncate(folder / "jobs.sqlite", (folder / "jobs.sqlite").stat().st_size // 2 + 700)


def the_meta_table_dropped(folder):
    database(folder, "DROP TABLE meta")


def a_column_dropped(folder):
    database(folder, "ALTER TABLE jobs DROP COLUMN note")


def a_value_damaged(folder):
    database(folder, "UPDATE jobs SET options = '{\"preset' WHERE number = 7")


def of_an_older_version(folder):
    database(folder, f"UPDATE meta SET value = {SCHEMA_VERSION - 1} WHERE name = 'schema'", "DROP TABLE events")


def of_a_newer_version(folder):
    database(folder, f"UPDATE meta SET value = {SCHEMA_VERSION + 1} WHERE name = 'schema'")


REFUSED = {
    no_database: "file is not a database; restore it",
    a_folder_instead: "cannot be opened",
    deleted: "is new and has none of them; restore",
    emptied: "is new and has none of them; restore",
    rows_deleted: "is new and has none of them; restore",
    truncated: "damaged|malformed",
    the_meta_table_dropped: "damaged: the schema version of its tables is missing",
    a_column_dropped: "no such column: jobs.note",
    a_value_damaged: "damaged: ",
    of_an_older_version: f"schema version {SCHEMA_VERSION - 1}, but this service needs {SCHEMA_VERSION}",
    of_a_newer_version: f"schema version {SCHEMA_VERSION + 1}, but this service needs {SCHEMA_VERSION}",
}


@pytest.mark.parametrize("change", REFUSED, ids=lambda change: change.__name__)
def test_a_refused_start_removes_nothing(jobs_folder, change):
    change(jobs_folder)
    for _ in range(2):  # the first attempt must not change the result of the second
        assert_refused(jobs_folder, REFUSED[change])
    assert not (jobs_folder / "jobs" / ".orphaned").exists()


def assert_refused(folder, message):
    """Assert that a start ends in one line and removes and changes no file."""
    before = listing(folder)
    with pytest.raises(SettingsError, match=message) as caught:
        opened(folder)
    assert "\n" not in str(caught.value)
    assert listing(folder).items() >= before.items()


def test_a_refused_command_prints_one_line(jobs_folder):
    deleted(jobs_folder)
    ended = command(jobs_folder)
    assert (ended.returncode, ended.stdout) == (2, "")
    (line,) = ended.stderr.splitlines()
    assert line.startswith("kissgs-serve: ")
    assert "job database" in line


@pytest.mark.quick(0)
def test_a_locked_database(jobs_folder):
    before = listing(jobs_folder)
    with contextlib.closing(sqlite3.connect(jobs_folder / "jobs.sqlite")) as other:
        other.execute("PRAGMA locking_mode=EXCLUSIVE")
        other.execute("BEGIN EXCLUSIVE")
        begun = time.monotonic()
        ended = command(jobs_folder)
        assert time.monotonic() - begun < 20
    (line,) = ended.stderr.splitlines()
    assert (ended.returncode, "locked; another program has locked it" in line) == (2, True)
    assert listing(jobs_folder).items() >= before.items()
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
        of_a_newer_version(tmp_path / "own")
        shutil.copytree(tmp_path / "own", tmp_path / "killed")
    before = listing(tmp_path / "killed")
    assert {"jobs.sqlite-wal", "jobs.sqlite"} <= {str(name) for name in before}
    ended = command(tmp_path / "killed")
    assert "schema version" in ended.stderr
    after = listing(tmp_path / "killed")
    for name in ("jobs.sqlite", "jobs.sqlite-wal"):
        assert after[Path(name)] == before[Path(name)]


@pytest.mark.parametrize(("name", "value"), [("identity", "'text'"), ("schema", "x'00ff'"), ("time", "1e999")])
def test_invalid_values_in_the_meta_table(jobs_folder, name, value):
    database(jobs_folder, f"INSERT OR REPLACE INTO meta VALUES ('{name}', {value})")
    assert_refused(jobs_folder, f"damaged: its table meta has no valid {name}")


def test_the_orphaned_folder_must_be_a_folder(jobs_folder):
    (jobs_folder / "jobs" / ".orphaned").write_text("own")
    (jobs_folder / "jobs" / ("0" * 32)).mkdir()
    before = listing(jobs_folder)
    with pytest.raises(SettingsError, match=r"/jobs/\.orphaned is not a folder; move it away$"), service(jobs_folder):
        pass
    assert listing(jobs_folder).items() >= before.items()
