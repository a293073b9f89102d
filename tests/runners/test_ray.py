"""Losses on a Ray cluster. Oracle: files that items write, and the ends of processes that are killed here."""

import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest
from helpers.ray_cluster import kill_tree, tree
from helpers.running import is_alive, item, outcome_of, pid_in, wait_until

from kissgs.core.errors import RunnerError
from kissgs.runners import open_runner
from kissgs.runners import ray_runner as ray_runner_module

DRIVER = """
import sys
from helpers.running import item
from kissgs.runners import open_runner
runner = open_runner("ray", sys.argv[1])
handle = runner.submit(item("write_slowly", starts=sys.argv[2], output=sys.argv[3], text="text"))
print(handle.outcome.result())
"""


def test_an_item_whose_node_is_killed_runs_elsewhere(whole_cluster, ray_runner, tmp_path):
    starts, output, notes = tmp_path / "starts", tmp_path / "output", []
    work = item("write_slowly", starts=str(starts), output=str(output), text="the same bytes")
    handle = ray_runner.submit(work, lambda stage, fraction, note: notes.append(note))
    first = pid_in(starts)
    wait_until(lambda: notes == ["first"])
    (node,) = [node for node in whole_cluster.nodes if first in tree(node.pid)]
    kill_tree(node)
    outcome = handle.outcome.result(120)
    assert (outcome.kind, outcome.starts) == ("done", 2)
    assert notes == ["first", "again"]
    assert output.read_text() == "the same bytes"
    assert len(starts.read_text().splitlines()) == 2
    assert sorted(path.name for path in tmp_path.iterdir()) == ["output", "starts"]


@pytest.mark.quick(0)
def test_an_item_that_loses_all_of_its_nodes_is_lost(whole_cluster, ray_runner, tmp_path):
    work = item("write_slowly", starts=str(tmp_path / "starts"), output=str(tmp_path / "output"), text="", retries=0)
    handle = ray_runner.submit(work)
    first = pid_in(tmp_path / "starts")
    kill_tree(next(node for node in whole_cluster.nodes if first in tree(node.pid)))
    outcome = handle.outcome.result(120)
    assert (outcome.kind, outcome.code, outcome.starts) == ("lost", "node-lost", 1)
    assert "was lost" in outcome.message


def test_a_killed_worker_of_ray_takes_its_item_along(whole_cluster, ray_runner, tmp_path):
    starts, output = tmp_path / "starts", tmp_path / "output"
    handle = ray_runner.submit(item("write_slowly", starts=str(starts), output=str(output), text="x"))
    first = pid_in(starts)
    os.kill(int(Path(f"/proc/{first}/stat").read_text().rpartition(")")[2].split()[1]), signal.SIGKILL)
    outcome = handle.outcome.result(120)
    assert (outcome.kind, outcome.starts) == ("done", 2)
    assert not is_alive(first)


def test_items_end_with_whoever_submitted_them_and_run_again(ray_cluster, ray_runner, tmp_path):
    starts, output = tmp_path / "starts", tmp_path / "output"
    command = [sys.executable, "-c", DRIVER, ray_cluster.address, starts, output]
    with subprocess.Popen(command, stdout=subprocess.PIPE) as killed:
        first = pid_in(starts)
        killed.kill()
    wait_until(lambda: not is_alive(first), seconds=30)
    wait_until(lambda: ray_runner.stats().cpus == 2)
    again = subprocess.run(command, capture_output=True, text=True, check=True, timeout=120)
    assert "kind='done'" in again.stdout
    assert output.read_text() == "text"
    assert len(starts.read_text().splitlines()) == 2


def test_a_lost_connection_is_an_outcome_and_is_made_again(ray_cluster, tmp_path, monkeypatch):
    monkeypatch.setattr(ray_runner_module, "RECONNECT_SECONDS", 0.5)
    runner = open_runner("ray", ray_cluster.address)
    try:
        handle = runner.submit(item("count", numbers=1, seconds_between=600, pid=str(tmp_path / "pid")))
        pid = pid_in(tmp_path / "pid")
        runner._driver.kill()
        outcome = handle.outcome.result(30)
        assert (outcome.kind, outcome.code) == ("lost", "cluster-unreachable")
        wait_until(lambda: not is_alive(pid), seconds=30)
        wait_until(lambda: runner.health_problem() is None)
        assert outcome_of(runner, item("count", numbers=1)).kind == "done"
    finally:
        runner.close()
    assert runner.health_problem() == "the runner is closed"


def test_closing_ends_all_items(ray_cluster, tmp_path):
    runner = open_runner("ray", ray_cluster.address)
    running = runner.submit(item("count", numbers=1, seconds_between=600, pid=str(tmp_path / "pid")))
    pid = pid_in(tmp_path / "pid")
    waiting = [runner.submit(item("count", numbers=1, seconds_between=600)) for _ in range(3)]
    runner.close()
    assert {handle.outcome.result(0).kind for handle in [running, *waiting]} == {"cancelled"}
    wait_until(lambda: not is_alive(pid), seconds=5)


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
        open_runner("ray", address)
    assert expected in str(raised.value)


@pytest.mark.quick(0)  # Ray tries for 20 s
def test_a_cluster_with_another_token(ray_cluster, monkeypatch):
    monkeypatch.setenv("RAY_AUTH_TOKEN", "0" * 64)
    with pytest.raises(RunnerError, match="have its token"):
        open_runner("ray", ray_cluster.address)


def test_ray_is_not_installed(monkeypatch):
    monkeypatch.setattr(ray_runner_module, "find_spec", lambda name: None)
    with pytest.raises(RunnerError, match=r"pip install 'kissgs\[ray\]'"):
        open_runner("ray")


def test_a_node_with_another_version(ray_cluster):
    from kissgs.runners.ray_driver import function_for_nodes

    (event,) = function_for_nodes()(item("count", numbers=1).as_dict(), "0.0.0", None)
    assert (event["outcome"]["kind"], event["outcome"]["code"]) == ("error", "node-unusable")
    assert "this machine 0.0.0; install one version" in event["outcome"]["message"]
