"""Starts that are refused: a database that is not that of the data folder; oracle: what lay there before."""

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
from service.storage.job_store import Store

pytestmark = pytest.mark.usefixtures("no_variables")


def wrong(folder):
    (folder / "jobs.sqlite").write_bytes(b"this is no database" * 1000)


def another_programs(folder):
    (folder / "jobs.sqlite").unlink()
    database(folder, "CREATE TABLE jobs (name TEXT)", "INSERT INTO jobs VALUES ('x')")


def a_folder_in_its_place(folder):
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


def of_former_times(folder):
    """The folder's own database, before it was given another one and jobs."""
    mark = int((folder / "identity").read_text())
    (folder / "jobs.sqlite").unlink()
    store = Store(f"sqlite:///{folder / 'jobs.sqlite'}", time.time)
    store.belong_to(mark, 5)
    store.close()


def of_another_tenant(folder):
    with service(folder.parent / "theirs") as context:
        finish_a_job(context)
    shutil.copy(folder.parent / "theirs" / "jobs.sqlite", folder / "jobs.sqlite")


def with_the_folder_of_another_tenant(folder):
    with service(folder.parent / "theirs") as context:
        finish_a_job(context)
    shutil.copytree(folder.parent / "theirs" / "jobs", folder / "jobs", dirs_exist_ok=True)
    shutil.copy(folder.parent / "theirs" / "identity", folder / "identity")


def read_only(folder):
    return f"sqlite:///file:{folder / 'jobs.sqlite'}?mode=ro&uri=true"


def truncated(folder):
    os.truncate(folder / "jobs.sqlite", (folder / "jobs.sqlite").stat().st_size // 2 + 700)


def a_table_dropped(folder):
    database(folder, "DROP TABLE jobs")


def the_table_of_versions_dropped(folder):
    database(folder, "DROP TABLE meta")


def a_column_dropped(folder):
    database(folder, "ALTER TABLE jobs DROP COLUMN note")


def a_value_damaged(folder):
    database(folder, "UPDATE jobs SET options = '{\"preset' WHERE number = 7")


def of_an_older_version(folder):
    database(folder, f"UPDATE meta SET value = {SCHEMA_VERSION - 1} WHERE name = 'schema'", "DROP TABLE events")


def of_a_newer_version(folder):
    database(folder, f"UPDATE meta SET value = {SCHEMA_VERSION + 1} WHERE name = 'schema'")


def a_mark_damaged(folder):
    (folder / "identity").write_bytes(b"\0\0\0")


REFUSED = {
    wrong: "file is not a database; restore it",
    another_programs: "does not say which version",
    a_folder_in_its_place: "cannot be opened",
    new: "the job database is new and knows none of them; restore",
    deleted: "the job database is new and knows none of them; restore",
    emptied: "the job database is new and knows none of them; restore",
    rows_deleted: "the job database is new and knows none of them; restore",
    replaced: "knows none of them; restore",
    of_former_times: "they came with another database than this; restore",
    of_another_tenant: "this database is that of another data folder",
    with_the_folder_of_another_tenant: "this database is that of another data folder",
    read_only: "readonly database; let the service write to it",
    truncated: "damaged|malformed",
    a_table_dropped: "damaged: it has no table jobs; restore it",
    the_table_of_versions_dropped: "damaged: it does not say which version",
    a_column_dropped: "no such column: jobs.note",
    a_value_damaged: "damaged: ",
    of_an_older_version: f"tables of version {SCHEMA_VERSION - 1}, this service of {SCHEMA_VERSION}",
    of_a_newer_version: f"tables of version {SCHEMA_VERSION + 1}, this service of {SCHEMA_VERSION}",
    a_mark_damaged: "does not hold a number",
}


@pytest.mark.parametrize("way", REFUSED, ids=lambda way: way.__name__)
def test_a_start_that_is_refused_removes_nothing(jobs_folder, way):
    url = way(jobs_folder)
    before = listing(jobs_folder)
    for _ in range(2):  # the first leaves no trace by which the second could go on
        with pytest.raises(SettingsError, match=REFUSED[way]) as caught:
            opened(jobs_folder, url)
        assert "\n" not in str(caught.value)
        assert listing(jobs_folder).items() >= before.items()
    assert not (jobs_folder.parent / "new.sqlite").exists()
    assert not (jobs_folder / "jobs" / ".orphaned").exists()


@pytest.mark.parametrize(
    "way", [wrong, new, deleted, replaced, read_only, truncated, a_table_dropped, of_another_tenant, of_a_newer_version]
)
def test_a_refused_command_says_so_in_a_sentence(jobs_folder, way):
    url = way(jobs_folder)
    before = listing(jobs_folder)
    ended = command(jobs_folder, **({"KISSGS_DATABASE_URL": url} if url else {}))
    assert (ended.returncode, ended.stdout) == (2, "")
    (line,) = ended.stderr.splitlines()
    assert line.startswith("kissgs-serve: ")
    assert "KISSGS_" in line or "job database" in line
    assert listing(jobs_folder).items() >= before.items()


def test_a_database_that_is_locked(jobs_folder):
    before = listing(jobs_folder)
    with contextlib.closing(sqlite3.connect(jobs_folder / "jobs.sqlite")) as other:
        other.execute("PRAGMA locking_mode=EXCLUSIVE")
        other.execute("BEGIN EXCLUSIVE")
        begun = time.monotonic()
        ended = command(jobs_folder)
        assert time.monotonic() - begun < 20
    (line,) = ended.stderr.splitlines()
    assert (ended.returncode, "locked; another program holds it" in line) == (2, True)
    assert listing(jobs_folder).items() >= before.items()
    with service(jobs_folder) as context:
        assert len(context.store.ids()) == 120


def test_a_folder_that_is_read_only(jobs_folder):
    if os.geteuid() == 0:
        bind = f"(mount --bind '{jobs_folder}' '{jobs_folder}' && mount -o remount,ro,bind '{jobs_folder}') 2>/dev/null"
        if os.system(bind) != 0:
            pytest.skip("mounting a folder needs leave to mount")
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
def test_bytes_that_are_flipped(jobs_folder, seed):
    """Wherever they lie: the service starts and knows all jobs, or says in a sentence that it cannot."""
    import random

    dice = random.Random(seed)
    path = jobs_folder / "jobs.sqlite"
    content = bytearray(path.read_bytes())
    for _ in range(dice.choice([1, 20, 500])):
        content[dice.randrange(len(content))] ^= 1 << dice.randrange(8)
    path.write_bytes(content)
    before = {name: data for name, data in listing(jobs_folder).items() if name.parts[0] == "jobs"}
    said = ""
    try:
        with service(jobs_folder):
            pass
    except SettingsError as error:
        said = str(error)
    assert "\n" not in said
    after = [name.parent.name for name in listing(jobs_folder) if name.parts[0] == "jobs"]
    assert sorted(after) == sorted(name.parent.name for name in before)


def test_a_journal_is_kept_for_the_database_it_belongs_to(sample_folder, tmp_path):
    """A service was killed; what it wrote last is in the journal only, and a refused start must not put that away."""
    with service(tmp_path / "mine") as context:
        finish_a_job(context)
        shutil.copytree(tmp_path / "mine", tmp_path / "killed")
    with service(tmp_path / "theirs") as context:
        finish_a_job(context)
    shutil.copy(tmp_path / "theirs" / "identity", tmp_path / "killed" / "identity")
    before = listing(tmp_path / "killed")
    assert {"jobs.sqlite-wal", "jobs.sqlite"} <= {str(name) for name in before}
    ended = command(tmp_path / "killed")
    assert "another data folder" in ended.stderr
    after = listing(tmp_path / "killed")
    for name in ("jobs.sqlite", "jobs.sqlite-wal"):
        assert after[Path(name)] == before[Path(name)]


@pytest.mark.parametrize("name", ["identity", "folder", "schema", "time"])
@pytest.mark.parametrize("value", ["'text'", "x'00ff'", "1e999", "-1", "0.5"])
def test_facts_of_the_database_that_are_no_numbers(jobs_folder, name, value):
    database(jobs_folder, f"INSERT OR REPLACE INTO meta VALUES ('{name}', {value})")
    if name == "time" and value in ("-1", "0.5"):
        with service(jobs_folder):
            return
    with pytest.raises(SettingsError) as told:
        opened(jobs_folder)
    assert "\n" not in str(told.value)
    if name != "schema" or value not in ("-1", "0.5"):
        assert f"damaged: its table meta holds no usable {name}" in str(told.value)


def test_what_is_set_aside_needs_a_folder(jobs_folder):
    (jobs_folder / "jobs" / ".orphaned").write_text("mine")
    (jobs_folder / "jobs" / ("0" * 32)).mkdir()
    before = listing(jobs_folder)
    ended = command(jobs_folder)
    assert (ended.returncode, ended.stdout) == (2, "")
    (line,) = ended.stderr.splitlines()
    assert line.endswith("/jobs/.orphaned is not a folder; move it away")
    assert listing(jobs_folder).items() >= before.items()
