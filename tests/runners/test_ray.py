"""Losses on a Ray cluster. Oracle: files that items write, and the ends of processes that are killed here."""

import os
import signal
import subprocess
import sys
import time
from dataclasses import asdict
from pathlib import Path

import pytest
from helpers.ray_cluster import NODE_MEMORY
from helpers.running import MB, is_alive, item, outcome_of, pid_in, processors, wait_until

from kissgs.core.errors import RunnerError
from kissgs.runners import Resources
from kissgs.runners import ray_runner as ray_runner_module
from kissgs.runners.ray_runner import RayRunner

DRIVER = """
import sys
from helpers.running import item
from kissgs.runners.ray_runner import RayRunner
runner = RayRunner(sys.argv[1])
runner.submit(item("write_slowly", starts=sys.argv[2], output=sys.argv[3], text="text")).result()
"""


@pytest.mark.quick(0)
def test_an_item_that_loses_all_of_its_nodes_is_lost(whole_cluster, ray_runner, tmp_path):
    work = item("write_slowly", starts=str(tmp_path / "starts"), output=str(tmp_path / "output"), text="", retries=0)
    handle = ray_runner.submit(work)
    first = pid_in(tmp_path / "starts")
    whole_cluster.kill_node_of(first)
    outcome = handle.result(120)
    assert (outcome.kind, outcome.code) == ("lost", "node-lost")
    assert "was lost" in outcome.message


@pytest.mark.quick(0)
def test_a_killed_worker_of_ray_takes_its_item_along(whole_cluster, ray_runner, tmp_path):
    starts, output = tmp_path / "starts", tmp_path / "output"
    handle = ray_runner.submit(item("write_slowly", starts=str(starts), output=str(output), text="x"))
    first = pid_in(starts)
    os.kill(int(Path(f"/proc/{first}/stat").read_text().rpartition(")")[2].split()[1]), signal.SIGKILL)
    outcome = handle.result(120)
    assert outcome.kind == "done"
    assert len(starts.read_text().splitlines()) == 2
    assert not is_alive(first)


@pytest.mark.quick(0)
def test_items_end_with_whoever_submitted_them_and_run_again(ray_cluster, ray_runner, tmp_path):
    starts, output = tmp_path / "starts", tmp_path / "output"
    with subprocess.Popen([sys.executable, "-c", DRIVER, ray_cluster.address, starts, output]) as killed:
        first = pid_in(starts)
        killed.kill()
    wait_until(lambda: not is_alive(first), seconds=30)
    wait_until(lambda: processors(ray_runner) == 2)
    again = outcome_of(ray_runner, item("write_slowly", starts=str(starts), output=str(output), text="text"))
    assert again.kind == "done"
    assert output.read_text() == "text"
    assert len(starts.read_text().splitlines()) == 2


def test_a_lost_connection_is_an_outcome_and_is_made_again_until_the_end(ray_cluster, tmp_path, monkeypatch):
    monkeypatch.setattr(ray_runner_module, "RECONNECT_SECONDS", 0.5)
    runner = RayRunner(ray_cluster.address)
    try:
        handle = runner.submit(item("count", numbers=1, seconds_between=600, pid=str(tmp_path / "pid")))
        pid = pid_in(tmp_path / "pid")
        runner._driver.kill()
        outcome = handle.result(30)
        assert (outcome.kind, outcome.code) == ("lost", "cluster-unreachable")
        wait_until(lambda: not is_alive(pid), seconds=30)
        wait_until(lambda: runner.health_problem() is None)
        assert outcome_of(runner, item("count", numbers=1)).kind == "done"
        running = runner.submit(item("count", numbers=1, seconds_between=600, pid=str(tmp_path / "last")))
        pid = pid_in(tmp_path / "last")
        waiting = [runner.submit(item("count", numbers=1, seconds_between=600)) for _ in range(3)]
    finally:
        runner.close()
    assert {handle.result(0).kind for handle in [running, *waiting]} == {"cancelled"}
    wait_until(lambda: not is_alive(pid), seconds=5)
    assert runner.health_problem() == "the runner is closed"


@pytest.mark.quick(0)
def test_a_waiting_item_is_cancelled_before_it_starts(whole_cluster, ray_runner, tmp_path):
    pids = [tmp_path / str(n) for n in range(3)]
    handles = [ray_runner.submit(item("count", numbers=1, seconds_between=600, pid=str(pid))) for pid in pids[:2]]
    wait_until(lambda: all(pid.exists() for pid in pids[:2]))
    handles.insert(0, ray_runner.submit(item("count", numbers=1, pid=str(pids[2]))))
    for handle in handles:
        ray_runner.cancel(handle)
        assert handle.result(30).kind == "cancelled"
    assert outcome_of(ray_runner, item("count", numbers=1)).kind == "done"
    assert not pids[2].exists()


@pytest.mark.quick(1)
@pytest.mark.parametrize("request_of_each", [Resources(1), Resources(0.25, int(0.6 * NODE_MEMORY))])
def test_no_more_items_run_than_their_requests_allow(whole_cluster, ray_runner, tmp_path, request_of_each):
    work = item("record", request_of_each, times=str(tmp_path), seconds_between=0.4)
    handles = [ray_runner.submit(work) for _ in range(5)]
    assert [handle.result(120).kind for handle in handles] == ["done"] * 5
    spans = [tuple(map(float, path.read_text().split())) for path in tmp_path.iterdir()]
    assert len(spans) == 5
    assert max(sum(start <= moment < end for start, end in spans) for moment, _ in spans) <= 2


def test_an_item_that_fits_nowhere_is_refused_beforehand_and_waits(whole_cluster, ray_runner):
    assert ray_runner.refusal(Resources(1, 100 * MB)) is None
    large = [Resources(64), Resources(1, 1 << 40), Resources(1, 0, 1)]
    assert all(str(each) in ray_runner.refusal(each) for each in large)
    handles = [ray_runner.submit(item("count", each, numbers=1)) for each in large]
    time.sleep(0.3)
    for handle in handles:
        assert not handle.done()
        ray_runner.cancel(handle)
        assert handle.result(30).kind == "cancelled"


@pytest.mark.quick(1)
@pytest.mark.parametrize(
    ("address", "expected"),
    [
        ("127.0.0.1:1", "no Ray cluster answers at 127.0.0.1:1: connection refused"),
        ("nowhere", "nowhere is no address of a Ray cluster; give HOST:PORT"),
        ("ray://127.0.0.1:10001", "an address for Ray's client; give HOST:PORT"),
    ],
)
def test_a_cluster_that_cannot_be_reached(ray_cluster, address, expected):
    with pytest.raises(RunnerError) as raised:
        RayRunner(address)
    assert expected in str(raised.value)


@pytest.mark.quick(0)  # Ray tries for 20 s
def test_a_cluster_with_another_token(ray_cluster, monkeypatch):
    monkeypatch.setenv("RAY_AUTH_TOKEN", "0" * 64)
    with pytest.raises(RunnerError, match="have its token"):
        RayRunner(ray_cluster.address)


def test_ray_is_not_installed(monkeypatch):
    monkeypatch.setattr(ray_runner_module, "find_spec", lambda name: None)
    with pytest.raises(RunnerError, match="pip install ray"):
        RayRunner()


def test_a_node_with_another_version(ray_cluster):
    from kissgs.runners.ray_node import run_on_node

    (event,) = run_on_node(asdict(item("count", numbers=1)), "0.0.0", None)
    assert (event["outcome"]["kind"], event["outcome"]["code"]) == ("error", "node-unusable")
    assert "this machine 0.0.0; install one version" in event["outcome"]["message"]
