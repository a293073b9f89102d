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
        OF_A_NEWER_VERSION(tmp_path / "own")
        shutil.copytree(tmp_path / "own", tmp_path / "killed")
    before = listing(tmp_path / "killed")
    assert {"jobs.sqlite-wal", "jobs.sqlite"} <= {str(name) for name in before}
    ended = command(tmp_path / "killed")
    assert (ended.returncode, ended.stdout) == (2, "")
    (line,) = ended.stderr.splitlines()
    assert line.startswith("kissgs-serve: ")
    assert "job database" in line
    assert "schema version" in line
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
