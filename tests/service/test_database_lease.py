"""Two services on one database, with separate data folders; oracle: the outcomes of the first service's jobs."""

import os
import shutil
import signal
import subprocess
import sys
import threading
import time

import pytest
from helpers.data_folders import add_a_job, command, names, opened, service
from helpers.service import ROOT, SLOW, SMALL, Service, problem, scene_bytes

from service.core.models import State
from service.core.settings import SettingsError
from service.storage import database_lease
from service.storage.database_health import DatabaseReplacedError
from service.storage.job_records import Store

pytestmark = pytest.mark.quick(0)


@pytest.fixture(params=["sqlite", "postgresql"])
def url(request, tmp_path):
    if request.param == "sqlite":
        return f"sqlite:///{tmp_path / 'jobs.sqlite'}"
    return request.getfixturevalue("postgresql")


@pytest.fixture
def on_machine(monkeypatch):
    """``on_machine(n)`` lets the lease take this process for one on machine ``n``."""

    def change(number):
        monkeypatch.setattr(database_lease, "machine_number", lambda: number)

    return change


def lease_rows(url):
    store = Store(url, time.time)
    found = {name: store.meta_value(name) for name in ("owner", "owner-process", "owner-machine")}
    store.close()
    return found


@pytest.mark.quick(0)
def test_a_copied_data_folder_on_the_same_database(tmp_path, url):
    """The copy has the folder's numbers, too; the second service once marked all jobs of the first as failed."""
    with Service(tmp_path / "first", KISSGS_DATABASE_URL=url) as first:
        running = first.submit(scene_bytes(20_000, 3), SLOW)
        first.running(running)
        shutil.copytree(first.folder, tmp_path / "second")
        waiting = first.submit()
        begun = time.monotonic()
        ended = command(tmp_path / "second", KISSGS_DATABASE_URL=url)
        assert time.monotonic() - begun < 3 * database_lease.HEARTBEAT_SECONDS
        assert (ended.returncode, ended.stdout) == (2, "")
        line = ended.stderr.splitlines()[-1]
        assert f"another service (process {first.process.pid}) is using the job database; stop that one" in line
        assert "Traceback" not in ended.stderr
        assert first.status(running)["state"] == "running"
        first.http.post(f"/v1/jobs/{running['id']}/cancel")
        assert first.ended(waiting)["state"] == "succeeded"
        assert first.kill(signal.SIGTERM) == 0


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGKILL])
@pytest.mark.quick(1)
def test_a_restart_does_not_wait(tmp_path, url, number):
    with Service(tmp_path / "data", KISSGS_DATABASE_URL=url) as it:
        job = it.ended(it.submit())
        it.kill(number)
        assert (lease_rows(url)["owner"] is None) == (number == signal.SIGTERM)
        begun = time.monotonic()
        it.restart()
        assert time.monotonic() - begun < 10
        assert it.status(job)["state"] == "succeeded"
        assert "another service" not in it.log.read_text()


@pytest.mark.usefixtures("no_variables")
def test_a_start_waits_for_a_service_that_crashed_on_another_machine(tmp_path, url, on_machine, monkeypatch, caplog):
    monkeypatch.setattr(database_lease, "TAKEOVER_SECONDS", 1.0)
    on_machine(1)
    first = opened(tmp_path / "data", url)
    add_a_job(first)
    first.storage.close()
    on_machine(2)
    begun = time.monotonic()
    with service(tmp_path / "data", url) as context:
        assert 1 <= time.monotonic() - begun < 5
        assert context.store.counts()[State.QUEUED] == 1
        assert "waiting 1 s for its heartbeat" in caplog.text
        assert "there was no heartbeat" in caplog.text
        with pytest.raises(DatabaseReplacedError, match="another service has taken it over"):  # it had not crashed
            first.store.claim()
        assert "another service has taken it over" in first.store.health_problem()
        first.store.close()
        context.store.heartbeat()
        assert context.store.health_problem() is None
    assert lease_rows(url)["owner"] is None


@pytest.mark.usefixtures("no_variables")
@pytest.mark.parametrize("ends", ["lives", "stops"])
@pytest.mark.quick(1)
def test_a_service_that_runs_on_another_machine(tmp_path, url, on_machine, ends):
    on_machine(1)
    first = opened(tmp_path / "data", url)
    job = add_a_job(first)
    shutil.copytree(tmp_path / "data", tmp_path / "copy", ignore=shutil.ignore_patterns("lock"))
    on_machine(2)
    action = first.store.heartbeat if ends == "lives" else first.store.close
    timer = threading.Timer(1.0, action)
    timer.start()
    begun = time.monotonic()
    if ends == "lives":
        with pytest.raises(SettingsError, match="on another machine or in another container") as caught:
            opened(tmp_path / "copy", url)
        assert "\n" not in str(caught.value)
        assert first.store.health_problem() is None
        assert first.store.claim().id == job
        first.store.close()
    else:
        with service(tmp_path / "copy", url) as second:
            assert second.store.health_problem() is None
    assert time.monotonic() - begun < 5
    timer.join()
    first.storage.close()
    assert names(tmp_path / "copy" / "jobs") == {job}


@pytest.mark.quick(1)
def test_a_service_whose_lease_was_taken_over(tmp_path, url):
    """A service may be suspended with its machine; afterwards it neither starts nor records jobs."""
    with Service(tmp_path / "data", KISSGS_DATABASE_URL=url) as it:
        it.ended(it.submit())
        store = Store(url, time.time)
        with store._writing.begin() as session:
            session.merge(database_lease.Meta(name="owner", value=7))
        store.close()
        ready = it.http.get("/readyz")
        assert ready.status_code == 503
        assert "another service has taken it over" in ready.json()["checks"]["database"]
        problem(it.http.post("/v1/jobs", content=SMALL), 503, "database")
        assert it.kill(signal.SIGTERM) == 0
        assert lease_rows(url)["owner"] == 7  # the other service's row stays


ACQUIRE = """
import sys, time
from service.storage.job_records import Store
store = Store(sys.argv[1], time.time)
print("ready", flush=True)
sys.stdin.readline()
try:
    store.acquire_database()
    print("acquired", flush=True)
except Exception as error:
    print(error, flush=True)
while store._monitor.owner is not None:
    time.sleep(0.1)
    store.heartbeat()
"""


def test_simultaneous_starts(url):
    """Exactly one acquires the lease."""
    store = Store(url, time.time)
    store.bind_to(1, 2)
    store.close()
    arguments = [sys.executable, "-c", ACQUIRE, url]
    pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "env": {**os.environ, "PYTHONPATH": str(ROOT)}}
    started = [subprocess.Popen(arguments, text=True, **pipes) for _ in range(4)]
    try:
        assert [process.stdout.readline() for process in started] == ["ready\n"] * 4
        for process in started:
            process.stdin.write("go\n")
            process.stdin.flush()
        outputs = sorted(process.stdout.readline() for process in started)
    finally:
        for process in started:
            process.kill()
            process.communicate()
    assert outputs[3] == "acquired\n"
    assert all("another service" in text for text in outputs[:3])


@pytest.mark.parametrize("process", [0, -1, 2.0**40, 1e300])
def test_invalid_process_numbers(process):
    assert database_lease._is_free(
        {"owner": 5.0, "owner-process": process, "owner-machine": database_lease.machine_number()}
    )


def test_processes_that_may_run():
    rows = {"owner": 5.0, "owner-process": float(os.getppid()), "owner-machine": database_lease.machine_number()}
    assert not database_lease._is_free(rows)
    assert not database_lease._is_free({**rows, "owner-machine": 1.0, "owner-process": 2.0**22})
    assert database_lease._is_free(
        {**rows, "owner-process": float(os.getpid())}
    )  # this process, after a restart of a container
