"""Jobs when processes are killed or resources run out; oracle: the result of the job without faults."""

import asyncio
import contextlib
import os
import random
import shutil
import signal
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest
from helpers.service import FAST, SLOW, SMALL, Service, problem, scene_bytes

import kissgs

BIG = scene_bytes(20_000, 3)
MEDIUM = scene_bytes(6_000, 2)
EXPECTED = kissgs.compress(SMALL, settings=kissgs.Settings(preset="fast")).to_zip()


def has_ended(pid, seconds=5):
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        with contextlib.suppress(OSError):
            if Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()[0] != "Z":
                time.sleep(0.02)
                continue
        return True
    return False


def result_of(service, job):
    """Return the container of a job, which must succeed and leave no temporary files."""
    status = service.ended(job, seconds=120)
    assert status["state"] == "succeeded", status
    content = service.http.get(status["links"]["result"]).content
    assert service.leftovers() == []
    return content


@pytest.mark.quick(0)
def test_the_server_is_killed_while_a_job_is_queued(start):
    service = start()
    running, waiting = service.submit(BIG, SLOW), service.submit()
    service.running(running)
    service.kill(signal.SIGKILL)
    service.restart()
    service.http.post(f"/v1/jobs/{running['id']}/cancel")
    assert result_of(service, waiting) == EXPECTED


def test_the_server_is_killed_while_a_job_runs(start):
    service = start()
    job = service.submit(MEDIUM)
    service.running(job)
    (child,) = service.children()
    service.kill(signal.SIGKILL)
    assert has_ended(child), "the job's process outlived the service"
    service.restart()
    status = service.ended(job)
    assert (status["state"], status["starts"]) == ("succeeded", 2)
    assert result_of(service, job) == kissgs.compress(MEDIUM, settings=kissgs.Settings(preset="fast")).to_zip()


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
    service = start(KISSGS_JOB_STARTS=1000)
    rng = random.Random(seed)
    job = service.submit()
    for _ in range(6):
        time.sleep(rng.uniform(0.0, 2.5))
        service.kill(signal.SIGKILL)
        service.restart()
    assert result_of(service, job) == EXPECTED


@pytest.mark.quick(0)
def test_a_job_that_crashes_the_server_fails_after_its_last_start(start):
    service = start(KISSGS_JOB_STARTS=2)
    job = service.submit(BIG, SLOW)
    for _ in range(2):
        service.running(job)
        service.kill(signal.SIGKILL)
        service.restart()
    status = service.ended(job)
    assert (status["state"], status["problem"]["code"]) == ("failed", "crashed")
    assert "2 times" in status["problem"]["detail"]


def test_a_complete_result_is_recovered(tmp_path):
    """The server is killed after the result is in its final folder, but before this is recorded."""
    with Service(tmp_path / "data") as service:
        job = service.ended(service.submit())
        service.kill(signal.SIGKILL)
        rewind(service, job, "running")
        service.restart()
        status = service.status(job)
        assert (status["state"], status["starts"]) == ("succeeded", 1)
        assert result_of(service, job) == EXPECTED


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
        assert result_of(service, job) == EXPECTED
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


@pytest.mark.quick(0)
def test_the_server_is_killed_while_the_result_is_written(start):
    service = start()
    job = service.submit(MEDIUM)
    end = time.monotonic() + 60
    while not list((service.folder / "jobs").glob("*/work-*/result")) and time.monotonic() < end:
        time.sleep(0.001)
    service.kill(signal.SIGKILL)
    service.restart()
    assert result_of(service, job) == kissgs.compress(MEDIUM, settings=kissgs.Settings(preset="fast")).to_zip()


@pytest.mark.quick(0)
def test_jobs_in_postgresql_survive(start, postgresql):
    service = start(KISSGS_DATABASE_URL=postgresql)
    done, running, waiting = service.ended(service.submit()), service.submit(MEDIUM), service.submit()
    service.running(running)
    service.kill(signal.SIGKILL)
    service.restart()
    assert result_of(service, waiting) == result_of(service, done) == EXPECTED
    assert service.status(running)["starts"] == 2
    listed = service.http.get("/v1/jobs").json()["jobs"]
    assert [job["id"] for job in listed] == [job["id"] for job in (waiting, running, done)]
    assert service.http.get("/readyz").status_code == 200


def rewind(service, job, state):
    """Reset a job in the database of a stopped service to a state before its end."""
    import sqlite3

    with contextlib.closing(sqlite3.connect(service.folder / "jobs.sqlite")) as database, database:
        database.execute(
            "UPDATE jobs SET state = ?, result = NULL, finished_at = NULL, expires_at = NULL WHERE id = ?",
            (state, job["id"]),
        )


def test_the_job_process_is_killed_once(start):
    service = start()
    job = service.submit(MEDIUM)
    service.running(job)
    os.kill(service.children()[0], signal.SIGKILL)
    status = service.ended(job)
    assert (status["state"], status["starts"]) == ("succeeded", 2)
    assert service.leftovers() == []


@pytest.mark.quick(0)
def test_the_job_process_is_killed_twice(start):
    service = start()
    job, next_one = service.submit(BIG, SLOW), service.submit()
    for start_number in (1, 2):
        while service.running(job)["starts"] != start_number:
            time.sleep(0.02)
        os.kill(service.children()[0], signal.SIGKILL)
    status = service.ended(job)
    assert (status["state"], status["starts"]) == ("failed", 2)
    assert (status["problem"]["code"], status["problem"]["retryable"]) == ("crashed", True)
    assert "SIGKILL" in status["problem"]["detail"]
    assert result_of(service, next_one) == EXPECTED


@pytest.mark.quick(0)
def test_a_job_beyond_the_memory_limit(start):
    service = start(KISSGS_JOB_MEMORY="256MiB")
    job = service.ended(service.submit(scene_bytes(120_000, 3), '{"preset": "balanced"}'), seconds=120)
    assert (job["state"], job["starts"]) == ("failed", 1)
    assert job["problem"]["code"] == "memory-limit"
    assert not job["problem"]["retryable"]
    assert "fewer Gaussians" in job["problem"]["detail"]
    assert service.http.get("/readyz").status_code == 200


@pytest.mark.quick(0)
def test_a_job_beyond_the_time_limit(start):
    service = start(KISSGS_JOB_SECONDS=1.5)
    job, next_one = service.submit(BIG, SLOW), service.submit()
    status = service.ended(job)
    assert (status["state"], status["problem"]["code"]) == ("failed", "time-limit")
    assert "1.5 s" in status["problem"]["detail"]
    assert service.ended(next_one)["state"] in ("succeeded", "failed")  # 1.5 s may be too short for it, too
    assert service.children() == []


@pytest.fixture
def tiny_disk(tmp_path):
    """File system of 3 MB."""
    folder = tmp_path / "tiny"
    folder.mkdir()
    if os.geteuid() != 0 or os.system(f"mount -t tmpfs -o size=3m tmpfs '{folder}' 2>/dev/null") != 0:
        pytest.skip("mounting a small file system is not permitted")
    yield folder
    os.system(f"umount -l '{folder}'")


def test_a_disk_that_fills_up_during_an_upload(tiny_disk):
    with Service(tiny_disk / "data") as service:
        service.log = tiny_disk.parent / "log"
        for body in (BIG, iter([BIG[:2_000_000], BIG[2_000_000:]])):
            answer = service.http.post("/v1/jobs", content=body, params={"options": FAST})
            problem(answer, 507, "disk-full")
            assert service.leftovers() == []
        assert result_of(service, service.submit()) == EXPECTED


@pytest.mark.quick(0)
def test_a_disk_that_fills_up_during_a_job(tiny_disk):
    with Service(tiny_disk / "data") as service:
        job = service.submit(MEDIUM)
        service.running(job)
        filler = tiny_disk / "filler"
        with filler.open("wb", buffering=0) as file, contextlib.suppress(OSError):
            while True:
                file.write(bytes(4096))
        time.sleep(3)
        filler.unlink()  # while the disk is full, not even the failure can be recorded
        status = service.ended(job)
        assert status["state"] in ("failed", "succeeded")
        if status["state"] == "failed":
            assert (status["problem"]["code"], status["problem"]["retryable"]) == ("output", True)
        assert result_of(service, service.submit()) == EXPECTED


def test_a_short_job_ends_before_the_service_stops(start):
    service = start()
    job = service.submit(MEDIUM)
    service.running(job)
    assert service.kill(signal.SIGTERM) == 0
    assert service.log.read_text().count("Ctrl-C again ends them now") == 1
    service.restart()
    status = service.status(job)
    assert (status["state"], status["starts"]) == ("succeeded", 1)


@pytest.mark.quick(0)
def test_a_long_job_is_requeued_when_the_service_stops(start):
    service = start(KISSGS_DRAIN_SECONDS=0.5)
    job = service.submit(BIG, SLOW)
    service.running(job)
    (child,) = service.children()
    lines = []

    def listen():
        with contextlib.suppress(Exception), service.http.stream("GET", job["links"]["events"]) as answer:
            lines.extend(answer.iter_lines())

    listener = threading.Thread(target=listen)
    listener.start()
    time.sleep(0.3)
    begun = time.monotonic()
    assert service.kill(signal.SIGTERM) == 0
    assert time.monotonic() - begun < 5  # the open stream does not delay it
    listener.join(5)
    assert not listener.is_alive()
    assert has_ended(child)
    service.restart()
    service.running(job)
    assert service.status(job)["starts"] == 1  # an orderly stop does not count as a start
    seen = service.http.get("/v1/jobs").json()
    assert len(seen["jobs"]) == 1


@pytest.mark.quick(0)
def test_many_simultaneous_jobs(start):
    """No job of 200 is lost or runs twice, and the server's memory hardly grows."""
    service = start(KISSGS_MAX_QUEUE=500, KISSGS_MAX_UPLOADS=32, KISSGS_WORKERS=2, KISSGS_JOB_THREADS=1)
    scenes = [scene_bytes(20, 0, seed=i) for i in range(200)]
    result_of(service, service.submit(scenes[0]))
    before = service.memory()

    def send(i):
        for _ in range(100):
            answer = service.http.post("/v1/jobs", content=scenes[i], params={"options": FAST, "name": str(i)})
            if answer.status_code == 202:
                return answer.json()
            problem(answer, 429, "too-many-uploads")
            time.sleep(0.2)
        raise AssertionError("never accepted")

    with ThreadPoolExecutor(50) as pool:
        jobs = list(pool.map(send, range(200)))
    assert len({job["id"] for job in jobs}) == 200
    assert service.memory() - before < 64 << 20
    for i in random.Random(0).sample(range(200), 190):
        service.http.post(f"/v1/jobs/{jobs[i]['id']}/cancel")
    states = [service.ended(job, seconds=120) for job in jobs]
    assert {status["state"] for status in states} <= {"succeeded", "cancelled"}
    assert sum(status["state"] == "succeeded" for status in states) >= 10
    for i, status in enumerate(states):
        assert status["name"] == str(i)
        assert status["starts"] <= 1
        if status["state"] == "succeeded":
            expected = kissgs.compress(scenes[i], settings=kissgs.Settings(preset="fast")).to_zip()
            assert service.http.get(status["links"]["result"]).content == expected
    assert service.leftovers() == []


def test_simultaneous_requests_with_one_idempotency_key(start):
    service = start()
    with ThreadPoolExecutor(8) as pool:
        jobs = list(pool.map(lambda _: service.submit(MEDIUM, **{"Idempotency-Key": "same"}), range(8)))
    assert len({job["id"] for job in jobs}) == 1
    assert len(service.http.get("/v1/jobs").json()["jobs"]) == 1
    assert service.ended(jobs[0])["state"] == "succeeded"
    assert len(list((service.folder / "jobs").iterdir())) == 1
    assert service.leftovers() == []


@pytest.mark.quick(0)
def test_expiry(start):
    service = start(KISSGS_KEEP_SECONDS=3, KISSGS_SWEEP_SECONDS=0.2)
    job = service.ended(service.submit())
    assert result_of(service, job) == EXPECTED
    end = time.monotonic() + 20
    while service.status(job)["state"] != "expired":
        assert time.monotonic() < end
        time.sleep(0.1)
    problem(service.http.get(f"/v1/jobs/{job['id']}/result"), 410, "gone")
    while (service.folder / "jobs" / job["id"]).exists():  # removed after this is recorded
        assert time.monotonic() < end
        time.sleep(0.02)
    assert list((service.folder / "jobs").iterdir()) == []
    while service.http.get(f"/v1/jobs/{job['id']}").status_code != 404:  # deleted after as long again
        assert time.monotonic() < end
        time.sleep(0.1)


def test_uploads_can_be_removed_after_success(start):
    service = start(KISSGS_KEEP_UPLOADS="false")
    job = service.ended(service.submit())
    assert "source" not in job["links"]
    assert not (service.folder / "jobs" / job["id"] / "scene.ply").exists()


def test_two_services_cannot_share_a_folder(start, tmp_path):
    service = start()
    with pytest.raises(AssertionError, match="another service is using"):
        Service(service.folder).start()
    assert service.http.get("/livez").status_code == 200


def test_clock_jumps(tmp_path, monkeypatch):
    """A jump of the clock by a year neither expires jobs early nor makes durations negative."""
    from service.core.models import State
    from service.core.settings import ServiceSettings
    from service.http.app import build
    from service.jobs.expiry import ExpiryTask

    monkeypatch.setenv("KISSGS_DATA_DIR", str(tmp_path / "data"))
    context = build(ServiceSettings.from_environment())
    upload = context.storage.new_upload()
    upload.write_bytes(SMALL)
    job = make_job(upload, context)
    real = time.time
    for jump in (365 * 86400, -365 * 86400):
        monkeypatch.setattr(time, "time", lambda jump=jump: real() + jump)
        asyncio.run(run_one(context))
        ExpiryTask(context, 0.0).sweep()
        found = context.store.get(job.id)
        assert found.state == State.SUCCEEDED
        assert 0 <= found.finished_at - found.started_at < 60
        assert 0 <= found.started_at - found.created_at < 60
    context.store.close()
    context.storage.close()
    restarted = build(ServiceSettings.from_environment())  # a year back: the time continues
    assert 0 <= restarted.clock() - found.finished_at < 60
    restarted.storage.close()


def make_job(upload, context):
    import uuid

    from service.core.models import Job

    job = Job(
        id=uuid.uuid4().hex,
        owner="",
        name="scene",
        options={"preset": "fast", "evaluate": False},
        preset="fast",
        evaluate=False,
        gaussians=300,
        sh_degree=1,
        upload_bytes=len(SMALL),
        upload_sha256="0" * 64,
        fingerprint="0",
        disk_bytes=0,
    )
    context.storage.adopt(upload, job.id)
    return context.admission.add(job)


async def run_one(context):
    context.worker.start()
    for _ in range(600):
        await asyncio.sleep(0.05)
        if not context.store.counts()["queued"] and not context.store.counts()["running"]:
            break
    context.worker.draining = True
    await context.worker.drain()
    context.worker.draining = False
