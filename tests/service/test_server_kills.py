"""Jobs when the server is killed; oracle: the result of the job without faults."""

import contextlib
import random
import shutil
import signal
import time

import pytest
from helpers.running import is_alive, wait_until
from helpers.service import SLOW, SMALL, Service, scene_bytes

import kissgs

BIG = scene_bytes(20_000, 3)
MEDIUM = scene_bytes(6_000, 2)
EXPECTED = kissgs.compress(SMALL, settings=kissgs.Settings(preset="fast")).to_zip()


@pytest.mark.quick(0)
def test_the_server_is_killed_while_a_job_is_queued(start):
    service = start()
    running, waiting = service.submit(BIG, SLOW), service.submit()
    service.running(running)
    service.kill(signal.SIGKILL)
    service.restart()
    service.http.post(f"/v1/jobs/{running['id']}/cancel")
    assert service.only_result(waiting) == EXPECTED


def test_the_server_is_killed_while_a_job_runs(start):
    service = start()
    job = service.submit(MEDIUM)
    service.running(job)
    (child,) = service.children()
    service.kill(signal.SIGKILL)
    wait_until(lambda: not is_alive(child))  # the job's process does not outlive the service
    service.restart()
    status = service.ended(job)
    assert (status["state"], status["starts"]) == ("succeeded", 2)
    assert service.only_result(job) == kissgs.compress(MEDIUM, settings=kissgs.Settings(preset="fast")).to_zip()


@pytest.mark.quick(0)
def test_the_server_is_killed_during_an_upload(start):
    service = start()
    with service.raw(b"POST /v1/jobs HTTP/1.1\r\nHost: localhost\r\nContent-Length: 9000000\r\n\r\n" + BIG[:2_000_000]):
        end = time.monotonic() + 10
        while not list((service.folder / "incoming").iterdir()) and time.monotonic() < end:
            time.sleep(0.02)
        assert list((service.folder / "incoming").iterdir())
        service.kill(signal.SIGKILL)
    service.restart()
    assert service.leftovers() == []
    assert service.http.get("/v1/jobs").json() == {"jobs": []}


@pytest.mark.parametrize("seed", range(2))
@pytest.mark.quick(0)
def test_the_server_is_killed_at_any_time(start, seed):
    """The job succeeds although the server is killed several times."""
    service = start(job_starts=1000)
    rng = random.Random(seed)
    job = service.submit()
    for _ in range(6):
        time.sleep(rng.uniform(0.0, 2.5))
        service.kill(signal.SIGKILL)
        service.restart()
    assert service.only_result(job) == EXPECTED


@pytest.mark.quick(0)
def test_the_server_is_killed_while_the_result_is_written(start):
    service = start()
    job = service.submit(MEDIUM)
    end = time.monotonic() + 60
    while not list((service.folder / "jobs").glob("*/work-*/result")) and time.monotonic() < end:
        time.sleep(0.001)
    service.kill(signal.SIGKILL)
    service.restart()
    assert service.only_result(job) == kissgs.compress(MEDIUM, settings=kissgs.Settings(preset="fast")).to_zip()


@pytest.mark.quick(0)
def test_a_job_that_crashes_the_server_fails_after_its_last_start(start):
    service = start(job_starts=2)
    job = service.submit(BIG, SLOW)
    for _ in range(2):
        service.running(job)
        service.kill(signal.SIGKILL)
        service.restart()
    status = service.ended(job)
    assert (status["state"], status["problem"]["code"]) == ("failed", "crashed")
    assert "2 times" in status["problem"]["detail"]


@pytest.mark.quick(0)
def test_a_complete_result_is_recovered(tmp_path):
    """The server is killed after the result is in its final folder, but before this is recorded."""
    with Service(tmp_path / "data") as service:
        job = service.ended(service.submit())
        service.kill(signal.SIGKILL)
        rewind(service, job, "running")
        service.restart()
        status = service.status(job)
        assert (status["state"], status["starts"]) == ("succeeded", 1)
        assert service.only_result(job) == EXPECTED


@pytest.mark.quick(0)
def test_an_incomplete_result_is_not_recovered(tmp_path):
    with Service(tmp_path / "data") as service:
        job = service.ended(service.submit())
        service.kill(signal.SIGKILL)
        folder = service.folder / "jobs" / job["id"]
        (folder / "work-0123").mkdir()
        (folder / "result").rename(folder / "work-0123" / "result")
        (folder / "work-0123" / "result" / "scene.zip").write_bytes(b"PK half")
        rewind(service, job, "running")
        service.restart()
        assert service.only_result(job) == EXPECTED
        assert service.status(job)["starts"] == 2


@pytest.mark.quick(0)
def test_a_missing_upload_fails_its_job(tmp_path):
    with Service(tmp_path / "data") as service:
        job = service.ended(service.submit())
        service.kill(signal.SIGKILL)
        rewind(service, job, "queued")
        (service.folder / "jobs" / job["id"] / "scene.ply").unlink()
        shutil.rmtree(service.folder / "jobs" / job["id"] / "result")
        (service.folder / "jobs" / ("0" * 32)).mkdir()  # belongs to no job
        service.restart()
        status = service.status(job)
        assert (status["state"], status["problem"]["code"]) == ("failed", "internal")
        assert [path.name for path in (service.folder / "jobs").iterdir()] == [".orphaned"]
        assert [path.name for path in (service.folder / "jobs" / ".orphaned").iterdir()] == ["0" * 32]
        ready = service.http.get("/readyz")
        assert (ready.status_code, ready.json()["ready"]) == (200, True)
        assert ready.json()["checks"]["orphaned"].endswith(
            "folders without a job in jobs/.orphaned of the data folder: 1"
        )
        assert f"were moved to {service.folder}/jobs/.orphaned: 1\n" in service.log.read_text()


def rewind(service, job, state):
    """Reset a job in the database of a stopped service to a state before its end."""
    import sqlite3

    with contextlib.closing(sqlite3.connect(service.folder / "jobs.sqlite")) as database, database:
        database.execute(
            "UPDATE jobs SET state = ?, result = NULL, finished_at = NULL, expires_at = NULL WHERE id = ?",
            (state, job["id"]),
        )
