"""Conformance of all runners. Oracle: files and times that the items' functions write, and the table of processes."""

import os
import time

import pytest
from helpers.ray_cluster import NODE_MEMORY
from helpers.running import MB, is_alive, item, outcome_of, pid_in, wait_until

import kissgs
from kissgs.runners import Resources, WorkItem, error_of


def test_an_item_gives_its_result_and_its_progress_in_order(runner, tmp_path):
    events = []
    handle = runner.submit(item("count", numbers=5, folder=str(tmp_path)), lambda *event: events.append(event))
    outcome = handle.outcome.result(120)
    assert (outcome.kind, outcome.starts) == ("done", 1)
    assert outcome.result == {"numbers": 5, "folder": str(tmp_path)}
    assert events == [(f"stage {n}", n / 5, f"note {n}") for n in range(5)]
    assert (runner.stats().waiting, runner.stats().running) == (0, 0)


def test_an_expected_error_has_its_class_code_and_sentence(runner):
    outcome = outcome_of(runner, item("refuse"))
    assert (outcome.kind, outcome.code, outcome.starts) == ("error", "invalid-scene", 1)
    error = error_of(outcome)
    assert type(error) is kissgs.InvalidSceneError
    assert str(error) == "this is no scene"


def test_a_bug_is_internal_and_its_traceback_kept(runner):
    outcome = outcome_of(runner, item("fail"))
    assert (outcome.kind, outcome.code) == ("error", "internal")
    assert "LookupError: a bug" in outcome.log
    assert "LookupError" not in outcome.message


def test_a_function_that_does_not_exist_is_internal(runner):
    assert outcome_of(runner, WorkItem("helpers.runner_items:no_such_function")).code == "internal"


def test_a_crash_ends_that_item_alone(runner):
    other = runner.submit(item("count", numbers=3, seconds_between=0.3))
    outcome = outcome_of(runner, item("crash"))
    assert (outcome.kind, outcome.code, outcome.starts) == ("crashed", "crashed", 1)
    assert "SIGSEGV" in outcome.message
    assert isinstance(error_of(outcome), kissgs.RunnerError)
    assert error_of(outcome).code == "crashed"
    assert other.outcome.result(120).kind == "done"


def test_the_memory_limit_ends_that_item_alone(runner):
    outcome = outcome_of(runner, item("allocate", bytes=800 * MB, memory_limit=400 * MB))
    assert (outcome.kind, outcome.code) == ("error", "memory-limit")
    assert "0.4 GB" in outcome.message
    assert outcome_of(runner, item("allocate", bytes=100 * MB, memory_limit=400 * MB)).kind == "done"


def test_the_time_limit_counts_from_the_start_of_the_process(runner, tmp_path):
    outcome = outcome_of(runner, item("count", numbers=1, seconds_between=600, pid=str(tmp_path / "pid"), seconds=1.5))
    assert (outcome.kind, outcome.code) == ("error", "time-limit")
    assert "1.5 s" in outcome.message
    assert not is_alive(pid_in(tmp_path / "pid"))


def test_a_waiting_item_is_cancelled_before_it_starts(runner, tmp_path):
    busy = [runner.submit(item("count", numbers=1, seconds_between=600)) for _ in range(2)]
    wait_until(lambda: runner.stats().running == 2)
    waiting = runner.submit(item("count", numbers=1, pid=str(tmp_path / "pid")))
    assert runner.stats().waiting == 1
    runner.cancel(waiting.id)
    assert waiting.outcome.result(30).kind == "cancelled"
    for handle in busy:
        runner.cancel(handle.id)
    assert [handle.outcome.result(30).kind for handle in busy] == ["cancelled"] * 2
    assert outcome_of(runner, item("count", numbers=1)).kind == "done"
    assert not (tmp_path / "pid").exists()


def test_a_running_item_is_cancelled_with_its_process(runner, tmp_path):
    events = []
    work = item("count", numbers=1000, seconds_between=0.05, pid=str(tmp_path / "pid"))
    handle = runner.submit(work, lambda *event: events.append(event))
    wait_until(lambda: events)
    runner.cancel(handle.id)
    assert handle.outcome.result(30).kind == "cancelled"
    count = len(events)
    wait_until(lambda: not is_alive(pid_in(tmp_path / "pid")), seconds=5)
    assert len(events) == count
    runner.cancel(handle.id)  # once more: nothing happens
    assert outcome_of(runner, item("count", numbers=1)).kind == "done"


def overlap(folder):
    """Return the largest number of items of ``record`` that ran at one time."""
    spans = [tuple(map(float, path.read_text().split())) for path in folder.iterdir()]
    return max(sum(start <= moment < end for start, end in spans) for moment, _ in spans)


@pytest.mark.parametrize(
    ("request_of_each", "at_once"),
    [
        (lambda nodes: Resources(1), lambda nodes: 2),
        (lambda nodes: Resources(0.25, int(0.6 * NODE_MEMORY)), lambda nodes: nodes),
    ],
    ids=["processors", "memory"],
)
def test_no_more_items_run_than_their_requests_allow(runner, tmp_path, request_of_each, at_once):
    nodes = len(runner.stats().nodes)
    work = item("record", request_of_each(nodes), times=str(tmp_path), seconds_between=0.4)
    handles = [runner.submit(work) for _ in range(5)]
    assert [handle.outcome.result(120).kind for handle in handles] == ["done"] * 5
    assert len(list(tmp_path.iterdir())) == 5
    assert overlap(tmp_path) == at_once(nodes)


@pytest.mark.parametrize("large", [Resources(64), Resources(1, 1 << 40), Resources(1, 0, 1)])
def test_an_item_that_fits_nowhere_is_refused_beforehand_and_waits(runner, large):
    assert str(large) in runner.refusal(large)
    assert runner.refusal(Resources(1, 100 * MB)) is None
    handle = runner.submit(item("count", large, numbers=1))
    time.sleep(0.3)
    assert not handle.outcome.done()
    assert runner.stats().waiting == 1
    runner.cancel(handle.id)
    assert handle.outcome.result(30).kind == "cancelled"


def test_secrets_of_a_service_are_not_for_items(runner, monkeypatch):
    monkeypatch.setenv("KISSGS_KEYS", "secret")
    assert outcome_of(runner, item("environment")).result["names"] == []


def test_a_healthy_runner_has_no_problem(runner):
    assert runner.health_problem() is None


def test_an_item_is_small_json(runner):
    work = item("count", Resources(0.5, 7, 0.1), numbers=1, seconds=3.0, memory_limit=400 * MB)
    assert WorkItem.from_dict(work.as_dict()) == work
    assert os.getpid() != 0
