"""Runners, and ends of an item's process. Oracles: files and times that items write, the table of processes,
messages of libraries when memory is exhausted."""

import errno
import io
import json
import signal
import subprocess
import sys
from dataclasses import asdict

import pytest
from helpers.running import MB, is_alive, item, outcome_of, pid_in, wait_until

import kissgs
from kissgs.cli.compress_scenes import with_memory
from kissgs.runners import Resources, WorkItem, error_of, refusal_of
from kissgs.runners.process import ItemProcess, json_lines


@pytest.mark.parametrize(
    ("status", "used", "output", "expected"),
    [
        (-signal.SIGABRT, 0.1, "LLVM ERROR: out of memory\nBuffer allocation failed", "memory-limit"),
        (-signal.SIGABRT, 0.1, "OpenBLAS error: Memory allocation still failed after 10 retries", "memory-limit"),
        (-signal.SIGABRT, 0.1, "terminate called after throwing an instance of 'std::bad_alloc'", "memory-limit"),
        (-signal.SIGABRT, 0.1, "numpy._core._exceptions._ArrayMemoryError: Unable to allocate", "memory-limit"),
        (-signal.SIGSEGV, 0.7, "Segmentation fault", "crashed"),
        (-signal.SIGSEGV, 0.9, "", "memory-limit"),
        (-signal.SIGKILL, 0.9, "", "crashed"),  # killed from outside: by the system or by a person
        (1, 0.9, "", "memory-limit"),
        (1, 0.7, "", "internal"),
    ],
)
def test_what_a_crash_is_attributed_to(status, used, output, expected):
    process = ItemProcess(item("count", memory_limit=1 << 30))
    process._peak_data = int(used * (1 << 30))
    assert process._explain(None, status, io.BytesIO(output.encode())).code == expected


LIMITED = pytest.mark.skipif(sys.platform != "linux", reason="only Linux limits the memory of a process")


@LIMITED
@pytest.mark.parametrize(
    ("message", "share", "code"),
    [
        ("can't start new thread", 0.6, "memory-limit"),
        ("error return without exception set", 0.6, "memory-limit"),
        ("libx.so: failed to map segment from shared object", 0.6, "memory-limit"),
        ("can't start new thread", 0.0, "internal"),
        ("another error", 0.3, "internal"),
    ],
)
@pytest.mark.quick(3)
def test_an_error_with_several_reasons_is_a_lack_of_memory_where_most_is_used(message, share, code):
    work = item("fail_with", message=message, bytes=int(share * 400 * MB), memory_limit=400 * MB)
    *_, outcome = ItemProcess(work).events()
    assert outcome.code == code


@LIMITED
@pytest.mark.parametrize("left", [2, 14, 30, 60])
@pytest.mark.quick(2)
def test_libraries_that_lack_memory_end_the_work(left):
    """OpenBLAS of scipy, which numba loads, waited forever."""
    work = item("load_kernels", left=left * MB, memory_limit=400 * MB, seconds=30)
    *_, outcome = ItemProcess(work).events()
    assert outcome.kind == "done" or outcome.code == "memory-limit"


def test_a_folder_that_this_machine_does_not_see(tmp_path):
    (outcome,) = ItemProcess(item("count", folder=str(tmp_path / "none"), numbers=1)).events()
    assert (outcome.kind, outcome.code) == ("error", "node-unusable")
    assert "cannot use the folder of the work: no such file" in outcome.message
    assert outcome.log == str(tmp_path / "none")


def test_a_machine_without_resources_for_a_process(monkeypatch):
    def refuse(*words, **options):
        raise BlockingIOError(errno.EAGAIN, "Resource temporarily unavailable")

    monkeypatch.setattr(subprocess, "Popen", refuse)
    (outcome,) = ItemProcess(item("count", numbers=1)).events()
    assert (outcome.kind, outcome.code) == ("lost", "not-started")
    assert "could not start a process: resource temporarily unavailable" in outcome.message


def test_a_process_killed_before_its_start():
    process = ItemProcess(item("count", numbers=1))
    process.kill()
    assert [outcome.kind for outcome in process.events()] == ["cancelled"]


def test_a_line_that_a_process_was_killed_in_is_no_event():
    assert list(json_lines(['{"a": 1}\n', '{"b": 2}\n', '{"c": '])) == [{"a": 1}, {"b": 2}]


def test_items_see_no_secrets(monkeypatch):
    for name in ("KISSGS_KEYS", "AWS_SECRET_ACCESS_KEY", "RAY_AUTH_TOKEN"):
        monkeypatch.setenv(name, "secret")
    events = list(ItemProcess(WorkItem("helpers.runner_items:variables")).events())
    assert "secret" not in events[-1].result["environment"].values()


def test_a_request_is_that_of_a_node_which_has_all_of_it():
    """The largest memory of a cluster may be that of a node without a GPU."""

    class Cluster:
        nodes = (Resources(8, 20, 1), Resources(16, 200, 0))

        def refusal(self, resources):
            return refusal_of(resources, self.nodes)

    assert with_memory(Cluster(), Resources(4, gpus=1), 120) == Resources(4, 20, 1)
    assert with_memory(Cluster(), Resources(4), 120) == Resources(4, 120, 0)
    with pytest.raises(kissgs.UnsupportedError, match="no node has 32 CPUs"):
        with_memory(Cluster(), Resources(32), 120)


def test_an_item_gives_its_result_and_its_progress_in_order(runner, tmp_path):
    events = []
    handle = runner.submit(item("count", numbers=5, folder=str(tmp_path)), lambda *event: events.append(event))
    outcome = handle.result(120)
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
    assert other.result(120).kind == "done"


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
    runner.cancel(handle)
    assert handle.result(30).kind == "cancelled"
    count = len(events)
    wait_until(lambda: not is_alive(pid_in(tmp_path / "pid")), seconds=5)
    assert len(events) == count
    runner.cancel(handle)  # once more: nothing happens
    assert outcome_of(runner, item("count", numbers=1)).kind == "done"


def test_an_item_is_json():
    work = item("count", Resources(0.5, 7, 0.1), numbers=1, seconds=3.0, memory_limit=400 * MB, files=("a", "b"))
    assert WorkItem.from_dict(json.loads(json.dumps(asdict(work)))) == work
