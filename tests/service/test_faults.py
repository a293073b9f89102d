"""Jobs whose processes are killed or stopped, or whose resources run out; oracle: the result without faults."""

import contextlib
import os
import signal
import threading
import time

import pytest
from helpers.data_folders import finish_a_job, opened
from helpers.data_folders import service as opened_service
from helpers.running import is_alive, wait_until
from helpers.service import FAST, SLOW, Service, ServiceProcess, problem, scene_bytes
from sqlalchemy.exc import OperationalError

from service.core.models import State
from service.core.settings import SettingsError
from service.http.server import config_of
from service.storage.job_files import RESERVE_BYTES

BIG = scene_bytes(20_000, 3)
MEDIUM = scene_bytes(6_000, 2)


@pytest.fixture
def tiny_disk(tmp_path):
    """File system of 3 MB."""
    folder = tmp_path / "tiny"
    folder.mkdir()
    if os.geteuid() != 0 or os.system(f"mount -t tmpfs -o size=3m tmpfs '{folder}' 2>/dev/null") != 0:
        pytest.skip("mounting a small file system is not permitted")
    yield folder
    os.system(f"umount -l '{folder}'")


def test_a_disk_that_fills_up_during_an_upload(tiny_disk, local):
    with Service(tiny_disk / "data") as service:
        service.log = tiny_disk.parent / "log"
        for body in (BIG, iter([BIG[:2_000_000], BIG[2_000_000:]])):
            answer = service.http.post("/v1/jobs", content=body, params={"options": FAST})
            problem(answer, 507, "disk-full")
            assert service.leftovers() == []
        assert service.only_result(service.submit()) == local.to_zip()


@pytest.mark.quick(0)
def test_a_disk_that_fills_up_during_a_job(tiny_disk, local):
    with Service(tiny_disk / "data", processes=True) as service:
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
        assert service.only_result(service.submit()) == local.to_zip()


def fill(folder):
    with (folder / "filler").open("ab", buffering=0) as file:
        for size in (4096, 1):
            with contextlib.suppress(OSError):
                while file.write(bytes(size)):
                    pass


def test_a_full_disk_does_not_prevent_deletion(tiny_disk):
    """Deletion once failed, although the message advised it. The space is that of the files, and then the reserve."""
    with Service(tiny_disk / "data") as service:
        service.log = tiny_disk.parent / "log"
        ended, running = service.ended(service.submit()), service.hold()
        waiting = [service.submit(scene_bytes(10, 0)) for _ in range(2)]
        for job in (ended, *waiting, running):
            fill(tiny_disk)
            assert service.http.delete(job["links"]["self"]).status_code == 204
        (tiny_disk / "filler").unlink()
        assert service.ended(service.submit())["state"] == "succeeded"


@pytest.mark.quick(0)
def test_a_full_disk_prevents_no_start(tiny_disk):
    """It once did, with a job waiting."""
    service = ServiceProcess(tiny_disk / "data")
    service.log = tiny_disk.parent / "log"
    with service:
        running = service.running(service.submit(MEDIUM, SLOW))
        others = [service.submit(scene_bytes(10, 0)) for _ in range(2)]
        fill(tiny_disk)
        service.kill(signal.SIGKILL)
        fill(tiny_disk)
        service.restart()
        assert service.status(running)["state"] in ("queued", "running")
        for job in (running, others[0]):
            assert service.http.delete(job["links"]["self"]).status_code == 204
        (tiny_disk / "filler").unlink()
        assert service.ended(others[1])["state"] == "succeeded"


def test_a_full_disk_without_a_reserve_says_how_much_to_free(tiny_disk):
    """A reserve that was used up by a former start, or removed by hand; oracle: the service starts with that space."""
    with Service(tiny_disk / "data") as service:
        ended = service.ended(service.submit())
        service.stop()  # which leaves no journal, whose space the start would use
        (tiny_disk / "data" / "reserve").unlink()
        fill(tiny_disk)
        with pytest.raises(SettingsError, match=f"full; free {RESERVE_BYTES:,} bytes there$"):
            opened(tiny_disk / "data")
        os.truncate(tiny_disk / "filler", (tiny_disk / "filler").stat().st_size - RESERVE_BYTES)
        service.restart()
        fill(tiny_disk)
        assert service.http.delete(ended["links"]["self"]).status_code == 204


@pytest.mark.parametrize("needed", ["jobs", "reserve", "nothing that there is"])
def test_the_record_of_a_deletion_finds_space(tmp_path, monkeypatch, needed):
    """Only removed files or the reserve give the space that a record takes on a full disk."""
    with opened_service(tmp_path / "data") as context:
        job_id = finish_a_job(context)
        job, move = context.store.get(job_id), context.store.move

        def full(*arguments, **values):
            paths = {"jobs": context.storage.jobs / job_id, "reserve": tmp_path / "data" / "reserve"}
            if paths.get(needed, tmp_path).exists():
                raise OperationalError("", {}, Exception("database or disk is full"))
            return move(*arguments, **values)

        monkeypatch.setattr(context.store, "move", full)
        may_fail = pytest.raises(OperationalError) if needed not in ("jobs", "reserve") else contextlib.nullcontext()
        with may_fail:
            context.completion.expire(job.number, job_id)
        assert (context.store.get(job_id).state == State.EXPIRED) == (needed in ("jobs", "reserve"))
        assert not (context.storage.jobs / job_id).exists()


def test_a_short_job_ends_before_the_service_stops(start_process):
    service = start_process()
    job = service.submit(MEDIUM)
    service.running(job)
    assert service.kill(signal.SIGTERM) == 0
    assert service.log.read_text().count("Ctrl-C again ends them now") == 1
    service.restart()
    status = service.status(job)
    assert (status["state"], status["starts"]) == ("succeeded", 1)


@pytest.mark.quick(0)
def test_a_long_job_is_requeued_when_the_service_stops(start):
    service = start(processes=True, drain_seconds=0.5)
    job = service.submit(BIG, SLOW)
    service.running(job)
    (child,) = service.children()
    lines = []

    def listen():
        with contextlib.suppress(Exception), service.http.stream("GET", job["links"]["events"]) as answer:
            lines.extend(answer.iter_lines())

    listener = threading.Thread(target=listen)
    listener.start()
    wait_until(lambda: lines)
    begun = time.monotonic()
    service.interrupt()
    service.join()
    assert time.monotonic() - begun < config_of(None).timeout_graceful_shutdown  # as the open stream would delay it
    listener.join(60)
    assert not listener.is_alive()
    wait_until(lambda: not is_alive(child))
    service.restart()
    service.running(job)
    assert service.status(job)["starts"] == 1  # an orderly stop does not count as a start
    assert len(service.http.get("/v1/jobs").json()["jobs"]) == 1
