"""Ends of an item's process. Oracle: messages of libraries when memory is exhausted, and ends by signals."""

import errno
import io
import signal
import subprocess
import sys

import pytest
from helpers.running import MB, item

import kissgs
from kissgs.cli.compress_scenes import with_memory
from kissgs.runners import Resources, WorkItem
from kissgs.runners.contract import refusal_of
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
