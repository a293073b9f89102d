"""Oracle: the page faults that Linux counts, one or more for every new piece of memory."""

import sys

import numpy as np
import pytest

from kissgs.core import free_memory
from kissgs.core.free_memory import keep_free_memory, return_free_memory

SIZE, TIMES = 40 << 20, 10


def page_faults(work):
    import resource

    before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
    work()
    return resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before


def use_arrays(times):
    for _ in range(times):
        np.empty(SIZE, np.uint8).fill(1)


@pytest.mark.skipif(
    not sys.platform.startswith("linux") or free_memory._libc_function("gnu_get_libc_version") is None,
    reason="this C library is not glibc",
)
def test_the_memory_of_large_arrays_is_used_again_within_the_block_only():
    with keep_free_memory():
        use_arrays(1)
        with keep_free_memory():
            use_arrays(1)
        kept = page_faults(lambda: use_arrays(TIMES))  # the inner block is part of the outer one
    usual = page_faults(lambda: use_arrays(TIMES))
    assert usual >= TIMES
    assert kept < usual / 4


def test_the_options_are_those_of_the_outermost_block(monkeypatch):
    found = []
    monkeypatch.setattr(free_memory, "_set_thresholds", lambda *thresholds: found.append(thresholds))
    large = (free_memory.LARGEST_TRIM, free_memory.LARGEST_MMAP)
    usual = (free_memory.USUAL_TRIM, free_memory.USUAL_MMAP)

    def fail():
        with keep_free_memory():
            with keep_free_memory():
                pass
            assert found == [large]
            raise KeyError

    with pytest.raises(KeyError):
        fail()
    assert found == [large, usual]


def test_other_c_libraries_are_left_alone(monkeypatch):
    monkeypatch.setattr(free_memory, "_libc_function", lambda name: None)
    with keep_free_memory():
        return_free_memory()
