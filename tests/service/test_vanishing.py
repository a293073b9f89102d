"""A job database that is removed, replaced or damaged while the service runs; oracle: its responses and the files on
the disk."""

import contextlib
import os
import shutil
import signal
import sqlite3
import threading
import time
from functools import partial

import pytest
from helpers.data_folders import add_a_row as add
from helpers.data_folders import database as execute
from helpers.running import wait_until
from helpers.service import SLOW, SMALL, Service, problem, read_response, scene_bytes

from service.core.models import State
from service.storage import database
from service.storage.database import DatabaseReplacedError
from service.storage.job_records import Store

HEAD = b"POST /v1/jobs HTTP/1.1\r\nHost: localhost\r\nContent-Length: %d\r\n\r\n"


def files(folder):
    return sorted(folder.glob("jobs.sqlite*"))


def remove(folder, pattern="jobs.sqlite*"):
    for path in folder.glob(pattern):
        path.unlink()


def replace(folder):
    copy = folder / "copy"
    shutil.copy(folder / "jobs.sqlite", copy)
    copy.replace(folder / "jobs.sqlite")


def overwrite(folder):
    with (folder / "jobs.sqlite").open("r+b") as file:
        size = file.seek(0, os.SEEK_END)
        for position in range(100, size, 4096):
            file.seek(position)
            file.write(b"\xff" * 400)


def truncate(folder, size=0):
    os.truncate(folder / "jobs.sqlite", size)


CHANGES = {
    "removed": (remove, "jobs.sqlite was removed"),
    "the data folder removed": (shutil.rmtree, "jobs.sqlite was removed"),
    "the journal removed": (partial(remove, pattern="*-wal"), "jobs.sqlite-wal was removed"),
    "replaced by a copy": (replace, "jobs.sqlite was replaced"),
    **{
        statement: (lambda folder, statement=statement: execute(folder, statement), reason)
        for statement, reason in (
            ("UPDATE meta SET value = 7 WHERE name = 'identity'", "replaced by another database"),
            ("DROP TABLE events", "no such table: events"),
            ("ALTER TABLE jobs DROP COLUMN note", "no such column: jobs.note"),
        )
    },
    "emptied": (truncate, "empty"),
}


@pytest.mark.parametrize("kind", CHANGES)
def test_changes_are_detected_before_an_upload_is_read(start, kind):
    service = start()
    change, reason = CHANGES[kind]
    execute(service.folder, "PRAGMA wal_checkpoint(TRUNCATE)")
    change(service.folder)
    ready = service.http.get("/readyz")
    assert (ready.status_code, ready.json()["ready"]) == (503, False)
    assert reason in ready.json()["checks"]["database"]
    with service.raw(HEAD % 500_000) as connection:  # not a byte of the scene
        answer = read_response(connection)
    assert answer.startswith(b"HTTP/1.1 503")
    assert b'"code":"database"' in answer
    assert b"retry-after: " in answer.lower()
    refused = service.http.post("/v1/compress", content=SMALL)
    assert problem(refused, 503, "database")["retryable"]
    assert service.http.get("/livez").status_code == 200
    assert not service.folder.exists() or service.leftovers() == []


@pytest.mark.parametrize(
    "damage", [overwrite, partial(truncate, size=5 * 4096 + 100)], ids=["overwritten", "truncated"]
)
def test_damage_in_any_page_is_detected(tmp_path, damage):
    """The damaged pages have rows that no request reads."""
    store = Store(tmp_path / "jobs.sqlite", time.time)
    execute(tmp_path, *[f"INSERT INTO meta VALUES ('{number:032}', 1.0)" for number in range(3000)])
    execute(tmp_path, "PRAGMA wal_checkpoint(TRUNCATE)")
    assert store.monitor.health_problem() is None
    damage(tmp_path)
    wait_until(lambda: store.monitor.health_problem() is not None, 300)
    assert "damaged" in store.monitor.health_problem() or "malformed" in store.monitor.health_problem()


def test_an_upload_during_the_removal_is_not_accepted(start):
    service = start()
    with service.raw(HEAD % len(SMALL) + SMALL[:-10]) as connection:
        service.wait_for_uploads(1)
        remove(service.folder)
        connection.sendall(SMALL[-10:])
        answer = read_response(connection)
    assert answer.startswith(b"HTTP/1.1 503"), answer
    assert b'"code":"database"' in answer
    assert service.leftovers() == []
    assert list((service.folder / "jobs").iterdir()) == []


@pytest.mark.quick(0)
def test_no_accepted_job_is_lost(start_process):
    """Jobs accepted with 202 keep their uploads if the database is removed during submissions, and a restart without
    the database is refused."""
    service = start_process(KISSGS_MAX_QUEUE=1000)
    service.running(service.submit(scene_bytes(20_000, 3), SLOW))
    accepted, refused = [], []

    def submit():
        while not refused:
            answer = service.http.post("/v1/jobs", content=SMALL)
            (accepted if answer.status_code == 202 else refused).append(answer)

    threads = [threading.Thread(target=submit) for _ in range(4)]
    for thread in threads:
        thread.start()
    time.sleep(1.5)
    kept = [path.with_name(f"kept-{path.name}") for path in files(service.folder)]
    for path, link in zip(files(service.folder), kept, strict=True):
        os.link(path, link)
    remove(service.folder)
    for thread in threads:
        thread.join(30)
    for answer in refused:
        problem(answer, 503, "database")
    assert len(accepted) > 4
    stored = {path.name for path in (service.folder / "jobs").iterdir()}
    assert stored >= {answer.json()["id"] for answer in accepted}
    time.sleep(1.5)
    running = service.http.get("/v1/jobs", params={"state": "running"}).json()["jobs"]
    assert len(running) == 1  # none was started after the removal
    assert "no job is started: jobs.sqlite was removed" in service.log.read_text() or service.children()
    service.kill(signal.SIGKILL)
    with pytest.raises(AssertionError, match="is new and has none of them; restore"):
        service.restart()
    assert {path.name for path in (service.folder / "jobs").iterdir()} == stored
    for link in kept:
        link.rename(link.with_name(link.name.removeprefix("kept-")))
    service.restart()
    known = {job["id"]: job for job in all_jobs(service)}
    assert known.keys() >= stored
    written = [job for job_id, job in known.items() if job_id not in stored]  # just before the removal was detected
    assert len(written) <= len(refused)
    assert all(job["state"] == "failed" and "upload is no longer" in job["problem"]["detail"] for job in written)


def all_jobs(service):
    cursor = {}
    while True:
        page = service.http.get("/v1/jobs", params={"limit": 100, **cursor}).json()
        yield from page["jobs"]
        if "next" not in page:
            return
        cursor = {"cursor": page["next"]}


@pytest.mark.quick(0)
def test_a_restored_database(start):
    """After the database is moved away and back, the running job is recorded and the queued one succeeds."""
    service = start(processes=True)
    running, waiting = service.submit(scene_bytes(6_000, 2)), service.submit()
    service.running(running)
    away = service.folder / "away"
    away.mkdir()
    for path in files(service.folder):
        path.rename(away / path.name)
    assert service.http.get("/readyz").status_code == 503
    wait_until(lambda: not service.children(), 300)
    time.sleep(1.5)
    assert service.status(running)["state"] == "running"
    assert service.status(waiting)["state"] == "queued"
    assert service.log.read_text().count("was removed while the service runs") < 5
    problem(service.http.post(f"/v1/jobs/{waiting['id']}/cancel"), 503, "database")
    problem(service.http.delete(f"/v1/jobs/{waiting['id']}"), 503, "database")
    assert (service.folder / "jobs" / waiting["id"] / "scene.ply").exists()
    for path in away.iterdir():
        path.rename(service.folder / path.name)
    assert service.ended(running)["state"] == service.ended(waiting)["state"] == "succeeded"
    assert service.http.get("/readyz").status_code == 200
    assert service.leftovers() == []


@pytest.mark.quick(0)
def test_files_of_a_replacement_stay_unchanged(tmp_path):
    """A backup with its own journal replaces the database while that is open."""
    with Service(tmp_path / "data") as service:
        service.ended(service.submit())
        backup = tmp_path / "backup"
        backup.mkdir()
        for path in files(service.folder):
            shutil.copy(path, backup / path.name)
        remove(service.folder)
        for path in files(backup):
            if not path.name.endswith("-shm"):
                shutil.copy(path, service.folder / path.name)
        before = {path.name: path.read_bytes() for path in files(service.folder)}
        assert "replaced" in service.http.get("/readyz").json()["checks"]["database"]
        service.stop()
        assert {path.name: path.read_bytes() for path in files(service.folder)} == before
        service.restart()
        assert [job["state"] for job in service.http.get("/v1/jobs").json()["jobs"]] == ["succeeded"]


@pytest.mark.quick(0)
def test_a_locked_database(start):
    service = start()
    with contextlib.closing(sqlite3.connect(service.folder / "jobs.sqlite", isolation_level=None)) as other:
        other.execute("BEGIN IMMEDIATE")
        begun = time.monotonic()
        ready = service.http.get("/readyz")
        assert "locked" in ready.json()["checks"]["database"]
        problem(service.http.post("/v1/jobs", content=SMALL), 503, "database")
        locked = time.monotonic() - begun
        begun = time.monotonic()
        assert service.http.get("/livez").status_code == 200  # a request without the database does not wait for it
        assert time.monotonic() - begun < locked
        other.execute("ROLLBACK")
    assert service.ended(service.submit())["state"] == "succeeded"
    wait_until(lambda: service.http.get("/readyz").status_code == 200)  # a result may be two seconds old


def test_a_read_only_database(tmp_path, monkeypatch):
    def read_only(file):
        return sqlite3.connect(f"file:{file}?mode=ro", uri=True, isolation_level=None, check_same_thread=False)

    monkeypatch.setattr(database, "_open", read_only)
    store = Store(tmp_path / "jobs.sqlite", time.time)
    assert "readonly" in store.monitor.health_problem()
    store.close()


def test_nothing_is_started_or_written_after_the_removal(tmp_path):
    store = Store(tmp_path / "jobs.sqlite", time.time)
    waiting, running = add(store), add(store)
    remove(tmp_path)
    for change in (
        store.claim,
        store.heartbeat,
        partial(add, store),
        partial(store.forget, waiting.number),
        partial(store.update, waiting.number, reclaimable_bytes=1),
        partial(store.progress, running.number, "order", 0.5),
        partial(store.move, running.number, State.RUNNING),
    ):
        with pytest.raises(
            DatabaseReplacedError, match=r"jobs\.sqlite was removed while the service runs; put it back"
        ):
            change()
    assert files(tmp_path) == []  # no new one was created
    assert store.counts()[State.QUEUED] == 2
    store.close()
    assert files(tmp_path) == []


def test_a_transaction_during_the_removal_fails(tmp_path, monkeypatch):
    store = Store(tmp_path / "jobs.sqlite", time.time)
    monkeypatch.setattr("service.storage.job_records._add_event", lambda *arguments: remove(tmp_path))
    with pytest.raises(DatabaseReplacedError):
        add(store)
    store.close()
