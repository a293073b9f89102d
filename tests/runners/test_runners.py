"""Conformance of all runners. Oracle: files and times that the items' functions write, and the table of processes."""

import json
from dataclasses import asdict

import pytest
from helpers.running import MB, is_alive, item, outcome_of, pid_in, wait_until

import kissgs
from kissgs.runners import Resources, WorkItem, error_of


def test_an_item_gives_its_result_and_its_progress_in_order(runner, tmp_path):
    events = []
    handle = runner.submit(item("count", numbers=5, folder=str(tmp_path)), lambda *event: events.append(event))
    outcome = handle.outcome.result(120)
    assert (outcome.kind, outcome.result) == ("done", {"numbers": 5, "folder": str(tmp_path)})
    assert events == [(f"stage {n}", n / 5, f"note {n}") for n in range(5)]
    assert runner.health_problem() is None


def test_an_expected_error_has_its_class_code_and_sentence(runner):
    outcome = outcome_of(runner, item("refuse"))
    assert (outcome.kind, outcome.code) == ("error", "invalid-scene")
    error = error_of(outcome)
    assert type(error) is kissgs.InvalidSceneError
    assert str(error) == "this is no scene"


@pytest.mark.parametrize(("function", "expected"), [("fail", "LookupError: a bug"), ("none", "AttributeError")])
def test_a_bug_is_internal_and_its_traceback_kept(runner, function, expected):
    outcome = outcome_of(runner, item(function))
    assert (outcome.kind, outcome.code) == ("error", "internal")
    assert expected in outcome.log
    assert "Error" not in outcome.message


def test_a_crash_ends_that_item_alone(runner):
    other = runner.submit(item("count", numbers=3, seconds_between=0.3))
    outcome = outcome_of(runner, item("crash"))
    assert (outcome.kind, outcome.code) == ("crashed", "crashed")
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
    pid = tmp_path / "pid"  # missing where the process took so long to start
    assert not (pid.exists() and is_alive(pid_in(pid)))


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


def test_an_item_is_json():
    work = item("count", Resources(0.5, 7, 0.1), numbers=1, seconds=3.0, memory_limit=400 * MB, files=("a", "b"))
    assert WorkItem.from_dict(json.loads(json.dumps(asdict(work)))) == work
