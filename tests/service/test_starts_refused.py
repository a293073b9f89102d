"""Refused starts, because the database and the data folder do not belong together; oracle: the files before."""

import contextlib
import os
import shutil
import sqlite3
import time
from pathlib import Path

import pytest
from helpers.data_folders import command, database, finish_a_job, listing, opened, service

from service.core.models import SCHEMA_VERSION
from service.core.settings import SettingsError
from service.storage.database import connect
from service.storage.job_records import Store

pytestmark = pytest.mark.usefixtures("no_variables")


def no_database(folder):
    (folder / "jobs.sqlite").write_bytes(b"this is no database" * 1000)


def of_another_program(folder):
    (folder / "jobs.sqlite").unlink()
    database(folder, "CREATE TABLE jobs (name TEXT)", "INSERT INTO jobs VALUES ('x')")


def a_folder_instead(folder):
    (folder / "jobs.sqlite").unlink()
    (folder / "jobs.sqlite").mkdir()


def new(folder):
    return f"sqlite:///{folder.parent / 'new.sqlite'}"


def deleted(folder):
    (folder / "jobs.sqlite").unlink()


def emptied(folder):
    (folder / "jobs.sqlite").write_bytes(b"")


def rows_deleted(folder):
    database(folder, "DELETE FROM events", "DELETE FROM jobs", "DELETE FROM meta")


def replaced(folder):
    (folder / "jobs.sqlite").unlink()
    Store(f"sqlite:///{folder / 'jobs.sqlite'}", time.time).close()


def of_an_earlier_binding(folder):
    """Use a database that was bound to the folder before its present one."""
    number = int((folder / "identity").read_text())
    (folder / "jobs.sqlite").unlink()
    store = Store(f"sqlite:///{folder / 'jobs.sqlite'}", time.time)
    store.bind_to(number, 5)
    store.close()


def of_another_service(folder):
    with service(folder.parent / "other") as context:
        finish_a_job(context)
    shutil.copy(folder.parent / "other" / "jobs.sqlite", folder / "jobs.sqlite")


def with_the_folder_of_another_service(folder):
    with service(folder.parent / "other") as context:
        finish_a_job(context)
    shutil.copytree(folder.parent / "other" / "jobs", folder / "jobs", dirs_exist_ok=True)
    shutil.copy(folder.parent / "other" / "identity", folder / "identity")


def read_only(folder):
    return f"sqlite:///file:{folder / 'jobs.sqlite'}?mode=ro&uri=true"


def truncated(folder):
    os.truncate(folder / "jobs.sqlite", (folder / "jobs.sqlite").stat().st_size // 2 + 700)


def a_table_dropped(folder):
    database(folder, "DROP TABLE jobs")


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


def a_number_damaged(folder):
    (folder / "identity").write_bytes(b"\0\0\0")


REFUSED = {
    no_database: "file is not a database; restore it",
    of_another_program: "the schema version of its tables is missing",
    a_folder_instead: "cannot be opened",
    new: "the job database is new and has none of them; restore",
    deleted: "the job database is new and has none of them; restore",
    emptied: "the job database is new and has none of them; restore",
    rows_deleted: "the job database is new and has none of them; restore",
    replaced: "has none of them; restore",
    of_an_earlier_binding: "they belong to another database; restore",
    of_another_service: "this database belongs to another data folder",
    with_the_folder_of_another_service: "this database belongs to another data folder",
    read_only: "readonly database; give the service write permission",
    truncated: "damaged|malformed",
    a_table_dropped: "damaged: it has no table jobs; restore it",
    the_meta_table_dropped: "damaged: the schema version of its tables is missing",
    a_column_dropped: "no such column: jobs.note",
    a_value_damaged: "damaged: ",
    of_an_older_version: f"schema version {SCHEMA_VERSION - 1}, but this service needs {SCHEMA_VERSION}",
    of_a_newer_version: f"schema version {SCHEMA_VERSION + 1}, but this service needs {SCHEMA_VERSION}",
    a_number_damaged: "does not contain a number",
}


@pytest.mark.parametrize("change", REFUSED, ids=lambda change: change.__name__)
def test_a_refused_start_removes_nothing(jobs_folder, change):
    url = change(jobs_folder)
    before = listing(jobs_folder)
    for _ in range(2):  # the first attempt must not change the result of the second
        with pytest.raises(SettingsError, match=REFUSED[change]) as caught:
            opened(jobs_folder, url)
        assert "\n" not in str(caught.value)
        assert listing(jobs_folder).items() >= before.items()
    assert not (jobs_folder.parent / "new.sqlite").exists()
    assert not (jobs_folder / "jobs" / ".orphaned").exists()


@pytest.mark.parametrize(
    "change",
    [
        no_database,
        new,
        deleted,
        replaced,
        read_only,
        truncated,
        a_table_dropped,
        of_another_service,
        of_a_newer_version,
    ],
)
@pytest.mark.quick(2)
def test_a_refused_command_prints_one_line(jobs_folder, change):
    url = change(jobs_folder)
    before = listing(jobs_folder)
    ended = command(jobs_folder, **({"KISSGS_DATABASE_URL": url} if url else {}))
    assert (ended.returncode, ended.stdout) == (2, "")
    (line,) = ended.stderr.splitlines()
    assert line.startswith("kissgs-serve: ")
    assert "KISSGS_" in line or "job database" in line
    assert listing(jobs_folder).items() >= before.items()


@pytest.mark.quick(0)
@pytest.mark.parametrize("encoding", ["SQL_ASCII", "LATIN1"])
def test_a_database_of_postgresql_that_cannot_hold_every_name(new_database, tmp_path, encoding):
    remedy = r"create another with CREATE DATABASE … ENCODING 'UTF8' TEMPLATE template0$"
    with pytest.raises(SettingsError, match=f"^KISSGS_DATABASE_URL: .* the encoding {encoding}, but .* UTF8; {remedy}"):
        connect(new_database(encoding))
    engine, *_ = connect(new_database())
    engine.dispose()


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
        assert len(context.store.ids()) == 120


def test_a_read_only_folder(jobs_folder):
    if os.geteuid() == 0:
        bind = f"(mount --bind '{jobs_folder}' '{jobs_folder}' && mount -o remount,ro,bind '{jobs_folder}') 2>/dev/null"
        if os.system(bind) != 0:
            pytest.skip("mounting a folder is not permitted")
    else:
        jobs_folder.chmod(0o500)
    before = listing(jobs_folder)
    try:
        ended = command(jobs_folder)
    finally:
        os.system(f"umount -l '{jobs_folder}'") if os.geteuid() == 0 else jobs_folder.chmod(0o700)
    (line,) = ended.stderr.splitlines()
    assert (ended.returncode, "KISSGS_DATA_DIR: cannot use" in line) == (2, True)
    assert listing(jobs_folder) == before


@pytest.mark.parametrize("seed", range(12))
def test_flipped_bits(jobs_folder, seed):
    """Wherever they are, the service starts and has all jobs, or refuses with one line."""
    import random

    rng = random.Random(seed)
    path = jobs_folder / "jobs.sqlite"
    content = bytearray(path.read_bytes())
    for _ in range(rng.choice([1, 20, 500])):
        content[rng.randrange(len(content))] ^= 1 << rng.randrange(8)
    path.write_bytes(content)
    before = {name: data for name, data in listing(jobs_folder).items() if name.parts[0] == "jobs"}
    message = ""
    try:
        with service(jobs_folder):
            pass
    except SettingsError as error:
        message = str(error)
    assert "\n" not in message
    after = [name.parent.name for name in listing(jobs_folder) if name.parts[0] == "jobs"]
    assert sorted(after) == sorted(name.parent.name for name in before)


def test_a_refused_start_keeps_the_journal(sample_folder, tmp_path):
    """The last changes of a killed service are only in the journal, which a refused start must not remove."""
    with service(tmp_path / "own") as context:
        finish_a_job(context)
        shutil.copytree(tmp_path / "own", tmp_path / "killed")
    with service(tmp_path / "other") as context:
        finish_a_job(context)
    shutil.copy(tmp_path / "other" / "identity", tmp_path / "killed" / "identity")
    before = listing(tmp_path / "killed")
    assert {"jobs.sqlite-wal", "jobs.sqlite"} <= {str(name) for name in before}
    ended = command(tmp_path / "killed")
    assert "another data folder" in ended.stderr
    after = listing(tmp_path / "killed")
    for name in ("jobs.sqlite", "jobs.sqlite-wal"):
        assert after[Path(name)] == before[Path(name)]


@pytest.mark.parametrize("name", ["identity", "folder", "schema", "time"])
@pytest.mark.parametrize("value", ["'text'", "x'00ff'", "1e999", "-1", "0.5"])
def test_invalid_values_in_the_meta_table(jobs_folder, name, value):
    database(jobs_folder, f"INSERT OR REPLACE INTO meta VALUES ('{name}', {value})")
    if name == "time" and value in ("-1", "0.5"):
        with service(jobs_folder):
            return
    with pytest.raises(SettingsError) as caught:
        opened(jobs_folder)
    assert "\n" not in str(caught.value)
    if name != "schema" or value not in ("-1", "0.5"):
        assert f"damaged: its table meta has no valid {name}" in str(caught.value)


def test_the_orphaned_folder_must_be_a_folder(jobs_folder):
    (jobs_folder / "jobs" / ".orphaned").write_text("own")
    (jobs_folder / "jobs" / ("0" * 32)).mkdir()
    before = listing(jobs_folder)
    ended = command(jobs_folder)
    assert (ended.returncode, ended.stdout) == (2, "")
    (line,) = ended.stderr.splitlines()
    assert line.endswith("/jobs/.orphaned is not a folder; move it away")
    assert listing(jobs_folder).items() >= before.items()
