"""Workers; oracle: threadpoolctl's own account of BLAS, and what the standard library says of processors."""

import os
import threading

import pytest
from threadpoolctl import threadpool_info

from kissgs.core.resources import Workers, blas_workers


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
