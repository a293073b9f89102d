"""Threads, memory and deadlines. Oracles: threadpoolctl, Linux's page faults, a clock that the test sets."""

import os
import subprocess
import sys
import threading

import pytest
from threadpoolctl import threadpool_info

from kissgs.core import context as deadline
from kissgs.core import context as free_memory
from kissgs.core.context import Context, Deadline, Pace, Workers, blas_workers, keep_free_memory, return_free_memory


def blas_threads():
    return [pool["num_threads"] for pool in threadpool_info() if pool["user_api"] == "blas"]


def test_blas_gets_its_threads_back_only_from_the_last_one_to_leave():
    """Interleaved users once left BLAS at one thread for ever, or gave it more amid another's work."""
    before = blas_threads()
    first, second = blas_workers(1), blas_workers(1)
    first.__enter__()
    second.__enter__()
    first.__exit__(None, None, None)
    assert set(blas_threads()) <= {1}
    second.__exit__(None, None, None)
    assert blas_threads() == before


def test_results_come_in_the_order_of_the_items():
    seen = []
    with Workers(2) as pool:
        assert pool.map(lambda n: n * n, range(20), seen.append) == [n * n for n in range(20)]
    assert seen == [(n + 1) / 20 for n in range(20)]


def test_an_error_in_a_worker_arrives():
    with Workers(2) as pool, pytest.raises(ZeroDivisionError):
        pool.map(lambda n: 1 // n, range(3))


def test_systems_without_affinity_have_processors_too(monkeypatch):
    monkeypatch.delattr(os, "sched_getaffinity", raising=False)
    assert Workers(0).threads == (os.cpu_count() or 1)


def test_no_thread_stays():
    before = threading.active_count()
    for _ in range(20):
        with Workers(4) as pool:
            pool.map(abs, range(8))
    for thread in threading.enumerate():
        if thread.name.startswith("ThreadPoolExecutor"):
            thread.join(5)
    assert threading.active_count() <= before


LARGE_ARRAYS = """
import resource
import numpy as np
from kissgs.core.context import keep_free_memory

def page_faults():
    before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
    for _ in range(10):
        np.empty(40 << 20, np.uint8).fill(1)
    return resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before

with keep_free_memory():
    page_faults()
    with keep_free_memory():
        page_faults()
    kept = page_faults()  # the inner block is part of the outer one
print(kept, page_faults())
"""


@pytest.mark.skipif(
    not sys.platform.startswith("linux") or free_memory._libc_function("gnu_get_libc_version") is None,
    reason="this C library is not glibc",
)
def test_the_memory_of_large_arrays_is_used_again_within_the_block_only():
    # A process of its own: here, a training in another test's thread may hold a block of its own.
    done = subprocess.run(
        [sys.executable, "-c", LARGE_ARRAYS], capture_output=True, text=True, timeout=120, check=False
    )
    assert done.returncode == 0, done.stderr
    kept, usual = map(int, done.stdout.split())
    assert usual >= 10
    assert kept < usual / 4


def test_other_c_libraries_are_left_alone(monkeypatch):
    monkeypatch.setattr(free_memory, "_libc_function", lambda name: None)
    with keep_free_memory():
        return_free_memory()


@pytest.fixture
def clock(monkeypatch):
    """Return the seconds that the clock shows, in a list, to be changed."""
    now = [100.0]
    monkeypatch.setattr(deadline.time, "perf_counter", lambda: now[0])
    return now


def made(clock, pace, seconds_per_step):
    """Make steps as a training does, each as long as ``seconds_per_step`` says of its number, and count them."""
    done = 0
    pace.update(done)
    while done < pace.steps:
        clock[0] += seconds_per_step(done)
        done += 1
        pace.update(done)
    return done


def test_a_deadline_comes_nearer(clock):
    end = Deadline.after(30)
    clock[0] += 12
    assert end.seconds == pytest.approx(18)
    assert end.earlier(20).seconds == pytest.approx(-2)


def test_all_steps_are_made_where_they_fit_in(clock):
    assert made(clock, Pace(50), lambda done: 1e3) == 50
    assert made(clock, Pace(50, Deadline.after(100)), lambda done: 1.0) == 50


@pytest.mark.parametrize("seconds", [7.0, 20.0, 90.0])
def test_as_many_steps_are_made_as_fit_in(clock, seconds):
    end = Deadline.after(seconds)
    assert made(clock, Pace(1000, end), lambda done: 0.5) == pytest.approx(2 * seconds, abs=1)
    assert -0.5 <= end.seconds <= 0.5


def test_a_slow_first_step_does_not_count(clock):
    end = Deadline.after(30)
    pace, totals = Pace(1000, end), []

    def seconds_of(done):
        totals.append(pace.steps)
        return 10.0 if done == 0 else 0.5

    made(clock, pace, seconds_of)
    assert 0 <= end.seconds <= 0.5
    assert set(totals[5:-5]) <= {40, 41, 42}  # 10 s for the first, 0.5 s for each other


def test_a_machine_that_becomes_slower_ends_in_time(clock):
    end = Deadline.after(30)
    assert made(clock, Pace(1000, end), lambda done: 0.2 if done < 50 else 0.8) < 80
    assert -0.8 <= end.seconds <= 2


def test_no_step_is_made_after_the_deadline(clock):
    assert made(clock, Pace(10, Deadline.after(-1)), lambda done: 1.0) == 0
    assert made(clock, Pace(10, Deadline.after(2.5)), lambda done: 9.0) == 1


def test_parts_of_a_stage_are_reported_as_that_stage():
    events, deadline = [], Deadline(3.0)
    whole = Context(2, "cuda", lambda *event: events.append(event), deadline)
    part = whole.stage("evaluate")
    part.progress("kernels", 1.0)
    part.progress("evaluate", 0.5, "a note of another stage")
    assert events == [("evaluate", 0.0), ("evaluate", 0.5)]
    assert (part.threads, part.device, part.deadline) == (2, "cuda", deadline)
