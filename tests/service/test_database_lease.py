"""Two services on one database, with data folders of their own; oracle: what the first one's jobs come to."""

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
from service.storage.job_store import Store


@pytest.fixture(params=["sqlite", "postgresql"])
def url(request, tmp_path):
    if request.param == "sqlite":
        return f"sqlite:///{tmp_path / 'jobs.sqlite'}"
    return request.getfixturevalue("postgresql")


@pytest.fixture
def elsewhere(monkeypatch):
    """``elsewhere(n)``: from now on this process is another one, on machine ``n``."""

    def move(number):
        monkeypatch.setattr(database_lease, "_machine", lambda: number)

    return move


def facts(url):
    store = Store(url, time.time)
    found = {name: store.fact(name) for name in ("owner", "owner-process", "owner-machine")}
    store.close()
    return found


def test_a_copied_folder_on_the_same_database(tmp_path, url):
    """Its marks are copied with it. The second service used to fail all jobs of the first."""
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
def test_the_next_start_waits_for_nobody(tmp_path, url, number):
    with Service(tmp_path / "data", KISSGS_DATABASE_URL=url) as it:
        job = it.ended(it.submit())
        it.kill(number)
        assert (facts(url)["owner"] is None) == (number == signal.SIGTERM)
        begun = time.monotonic()
        it.restart()
        assert time.monotonic() - begun < 10
        assert it.status(job)["state"] == "succeeded"
        assert "another service" not in it.log.read_text()


@pytest.mark.usefixtures("no_variables")
def test_one_that_crashed_elsewhere_is_waited_for(tmp_path, url, elsewhere, monkeypatch, caplog):
    monkeypatch.setattr(database_lease, "TAKEOVER_SECONDS", 1.0)
    elsewhere(1)
    first = opened(tmp_path / "data", url)
    add_a_job(first)
    first.storage.close()
    elsewhere(2)
    begun = time.monotonic()
    with service(tmp_path / "data", url) as context:
        assert 1 <= time.monotonic() - begun < 5
        assert context.store.counts()[State.QUEUED] == 1
        assert "waiting 1 s for a sign of its life" in caplog.text
        assert "there was none" in caplog.text
        with pytest.raises(
            DatabaseReplacedError, match="another service has taken it over"
        ):  # it did not crash after all
            first.store.claim()
        assert "another service has taken it over" in first.store.health_problem()
        first.store.close()
        context.store.heartbeat()
        assert context.store.health_problem() is None
    assert facts(url)["owner"] is None


@pytest.mark.usefixtures("no_variables")
@pytest.mark.parametrize("ends", ["lives", "stops"])
def test_one_that_lives_elsewhere(tmp_path, url, elsewhere, ends):
    elsewhere(1)
    first = opened(tmp_path / "data", url)
    job = add_a_job(first)
    shutil.copytree(tmp_path / "data", tmp_path / "copy", ignore=shutil.ignore_patterns("lock"))
    elsewhere(2)
    show = first.store.heartbeat if ends == "lives" else first.store.close
    timer = threading.Timer(1.0, show)
    timer.start()
    begun = time.monotonic()
    if ends == "lives":
        with pytest.raises(SettingsError, match="on another machine or in another container") as told:
            opened(tmp_path / "copy", url)
        assert "\n" not in str(told.value)
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


def test_one_whose_place_was_taken_says_so(tmp_path, url):
    """It was stopped for a while, as a machine may be. It starts no more jobs and records none."""
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
        assert facts(url)["owner"] == 7  # what is another's stays


CLAIMING = """
import sys, time
from service.storage.job_store import Store
store = Store(sys.argv[1], time.time)
print("ready", flush=True)
sys.stdin.readline()
try:
    store.acquire_database()
    print("mine", flush=True)
except Exception as error:
    print(error, flush=True)
while store._watch.owner is not None:
    time.sleep(0.1)
    store.heartbeat()
"""


def test_many_that_start_at_once(url):
    """One of them gets it."""
    store = Store(url, time.time)
    store.belong_to(1, 2)
    store.close()
    arguments = [sys.executable, "-c", CLAIMING, url]
    pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "env": {**os.environ, "PYTHONPATH": str(ROOT)}}
    started = [subprocess.Popen(arguments, text=True, **pipes) for _ in range(4)]
    try:
        assert [process.stdout.readline() for process in started] == ["ready\n"] * 4
        for process in started:
            process.stdin.write("go\n")
            process.stdin.flush()
        said = sorted(process.stdout.readline() for process in started)
    finally:
        for process in started:
            process.kill()
            process.communicate()
    assert said[3] == "mine\n"
    assert all("another service" in text for text in said[:3])


@pytest.mark.parametrize("process", [0, -1, 2.0**40, 1e300])
def test_process_numbers_that_are_none(process):
    assert database_lease._is_free({"owner": 5.0, "owner-process": process, "owner-machine": database_lease._machine()})


def test_a_process_that_may_run():
    rows = {"owner": 5.0, "owner-process": float(os.getppid()), "owner-machine": database_lease._machine()}
    assert not database_lease._is_free(rows)
    assert not database_lease._is_free({**rows, "owner-machine": 1.0, "owner-process": 2.0**22})
    assert database_lease._is_free(
        {**rows, "owner-process": float(os.getpid())}
    )  # we are it, after a restart of a container
