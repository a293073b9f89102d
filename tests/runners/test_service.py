"""Conformance of the service with all runners. Oracle: the library's bytes, and the table of processes."""

import contextlib
import json
import os
import signal
from pathlib import Path

import pytest
from helpers.ray_cluster import NODE_MEMORY
from helpers.running import is_alive, processors, wait_until
from helpers.service import FAST, SLOW, SMALL, Service, ServiceProcess, events, scene_bytes

import kissgs
from service.core.settings import ServiceSettings, SettingsError
from service.http.app import create_app


class RayService(ServiceProcess):
    """A service and a cluster of nodes with one processor each, which see no data folder but those that are shared."""

    workers = 2

    def __init__(self, folder, cluster, **settings):
        self.cluster = cluster
        fixed = {
            "KISSGS_RUNNER": cluster.address,
            "KISSGS_WORKERS": self.workers,
            "KISSGS_JOB_MEMORY": NODE_MEMORY,
            "KISSGS_JOB_THREADS": 1,
        }
        super().__init__(folder, **{**fixed, **settings})

    def children(self):
        """Return the ids of the processes of all jobs; decoding, which stays with the service, is not counted."""
        return self.cluster.items()

    def leftovers(self):
        """Return the paths of what no job should have left, in the data folder and on nodes."""
        return [*super().leftovers(), *self.cluster.left_by_items()]


MEDIUM = scene_bytes(4000, 2)
ON_THIS_MACHINE = {"KISSGS_JOB_MEMORY": NODE_MEMORY, "KISSGS_WORKERS": 2, "KISSGS_JOB_THREADS": 1}


def compressed(scene):
    return kissgs.compress(scene, settings=kissgs.Settings(preset="fast")).to_zip()


@pytest.fixture(scope="module")
def on_the_cluster(ray_cluster, ray_runner):
    """Settings of a service whose jobs run on the cluster, once it has both nodes."""
    wait_until(lambda: processors(ray_runner) == 2)
    return {**ON_THIS_MACHINE, "KISSGS_RUNNER": ray_cluster.address}


@pytest.fixture(scope="module", params=["local", "ray", "ray without a shared folder"])
def service(request, tmp_path_factory):
    """A service with each runner, on a cluster with and without a folder that all nodes see."""
    folder = tmp_path_factory.mktemp("data")
    if request.param == "local":
        made = ServiceProcess(folder / "a", **ON_THIS_MACHINE)
    else:
        request.getfixturevalue("on_the_cluster")
        made = RayService(folder / "a", request.getfixturevalue("ray_cluster"))
    if request.param == "ray":
        (folder / "shared").touch()
    with made as it:
        yield it


def result_of(service, job):
    status = service.ended(job)
    assert status["state"] == "succeeded", status
    return service.http.get(status["links"]["result"]).content


def wait_until_nothing_is_left(service):
    """Wait until no job has left anything; what a killed one left, the next item that starts on its node removes."""

    def look():
        if service.leftovers():
            for job in [service.submit(SMALL) for _ in range(2)]:  # one for each node
                result_of(service, job)
        return not service.leftovers()

    wait_until(look)


def processes_of(service, *jobs):
    """Wait for the processes of running jobs, the only ones of the service; return their ids."""

    def look():
        if isinstance(service, RayService):
            return service.children()
        found = []
        for link in Path("/proc").glob("[0-9]*/cwd"):
            with contextlib.suppress(OSError):
                folder = str(link.readlink())
                if any(job["id"] in folder for job in jobs) and is_alive(link.parent.name):
                    found.append(int(link.parent.name))
        return found

    for job in jobs:
        wait_until(lambda job=job: service.status(job)["state"] == "running")
    wait_until(lambda: len(look()) == len(jobs))
    return look()


@pytest.mark.quick(1)
def test_jobs_have_the_bytes_of_the_library_and_report_every_stage(service):
    jobs = [service.submit(SMALL), service.submit(MEDIUM), service.submit(SMALL)]
    with service.http.stream("GET", jobs[1]["links"]["events"]) as answer:
        found = events(answer.read().decode())
    stages = [data["stage"] for _, kind, data in found if kind == "progress"]
    assert [result_of(service, job) for job in jobs] == [compressed(scene) for scene in (SMALL, MEDIUM, SMALL)]
    assert [data["state"] for _, kind, data in found if kind == "state"] == ["queued", "running", "succeeded"]
    assert stages[0] == "read"
    assert stages.index("order") < stages.index("images")
    assert [service.status(job)["starts"] for job in jobs] == [1, 1, 1]
    decoded = service.http.get(service.status(jobs[0])["links"]["decoded"])
    assert (decoded.status_code, decoded.content[:4]) == (200, b"ply\n")
    assert service.leftovers() == []
    assert service.http.get("/readyz").status_code == 200


@pytest.mark.quick(1)
def test_an_expected_error_is_that_of_the_library_without_paths(service, tmp_path):
    """Headers are checked on arrival; that a file is cut short is found by the job."""
    kissgs.save(kissgs.sample_scene(300, sh_degree=1), tmp_path / "a.spz")
    content = (tmp_path / "a.spz").read_bytes()[:-60]
    answer = service.http.post("/v1/jobs", files={"file": ("a.spz", content)}, data={"options": FAST})
    status = service.ended(answer.json())
    assert (status["state"], status["problem"]["code"]) == ("failed", "invalid-scene")
    assert "is cut short" in status["problem"]["detail"]
    assert str(service.folder) not in status["problem"]["detail"]


@pytest.mark.quick(1)
def test_a_waiting_and_a_running_job_are_cancelled(service):
    running = [service.submit(MEDIUM, SLOW) for _ in range(2)]
    pids = processes_of(service, *running)
    waiting = service.submit(MEDIUM, SLOW)
    for job in (waiting, *running):
        assert service.http.delete(f"/v1/jobs/{job['id']}").status_code in (200, 204)
        assert job["id"] not in service.stored()
    wait_until(lambda: not any(map(is_alive, pids)), seconds=5)
    assert result_of(service, service.submit()) == compressed(SMALL)


@pytest.mark.quick(1)
def test_a_job_whose_process_is_killed_is_started_once_more(service):
    job = service.submit(MEDIUM, FAST)
    os.kill(*processes_of(service, job), signal.SIGKILL)
    assert result_of(service, job) == compressed(MEDIUM)
    assert service.status(job)["starts"] == 2
    wait_until_nothing_is_left(service)


@pytest.mark.quick(1)
@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGTERM])
def test_a_service_that_ends_runs_its_jobs_again(service, number):
    job = service.submit(MEDIUM, FAST)
    (pid,) = processes_of(service, job)
    service.kill(number)
    wait_until(lambda: not is_alive(pid), seconds=30)
    service.restart()
    assert result_of(service, job) == compressed(MEDIUM)
    wait_until_nothing_is_left(service)


@pytest.mark.quick(0)
@pytest.mark.parametrize("runner", ["local", "ray"])
def test_the_limits_of_jobs(request, tmp_path, runner):
    settings = ON_THIS_MACHINE if runner == "local" else request.getfixturevalue("on_the_cluster")
    with ServiceProcess(tmp_path / "a", **{**settings, "KISSGS_JOB_MEMORY": "256MiB"}) as service:
        problem = service.ended(service.submit(scene_bytes(200_000, 3), json.dumps({"preset": "balanced"})))["problem"]
        assert problem["code"] == "memory-limit"
        assert "fewer Gaussians" in problem["detail"]
    with ServiceProcess(tmp_path / "b", **{**settings, "KISSGS_JOB_SECONDS": 1.5}) as service:
        problem = service.ended(service.submit(scene_bytes(20_000, 3), SLOW))["problem"]
        assert problem["code"] == "time-limit"
        assert "1.5 s" in problem["detail"]


@pytest.mark.quick(0)
def test_a_job_whose_node_is_killed_runs_elsewhere(whole_cluster, tmp_path):
    with RayService(tmp_path / "data", whole_cluster) as service:
        job = service.submit(MEDIUM, FAST)
        (pid,) = processes_of(service, job)
        whole_cluster.kill_node_of(pid)
        assert result_of(service, job) == compressed(MEDIUM)
        assert service.status(job)["starts"] == 2
        assert service.leftovers() == []


def test_no_job_starts_without_a_node_that_is_large_enough(on_the_cluster, whole_cluster, tmp_path):
    with Service(tmp_path / "data", **{**on_the_cluster, "KISSGS_JOB_MEMORY": "2GB"}) as service:
        job = service.submit()
        ready = service.http.get("/readyz")
        assert ready.status_code == 503
        expected = "no node has 1 CPUs and 2 GB of memory; the largest has 1 CPUs and 1 GB of memory"
        assert ready.json()["checks"]["worker"] == expected
        assert service.status(job)["state"] == "queued"
        wait_until(lambda: f"no job is started: {expected}" in service.log.read_text())


def test_a_cluster_that_cannot_be_reached_is_a_problem_of_the_settings(tmp_path):
    pytest.importorskip("ray")
    with pytest.raises(SettingsError, match=r"no Ray cluster answers at 127\.0\.0\.1:1"):
        create_app(ServiceSettings(runner="127.0.0.1:1", data_dir=tmp_path / "data"))
