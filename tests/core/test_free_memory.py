"""Oracle: the page faults that Linux counts, one or more for every new piece of memory."""

import subprocess
import sys

import pytest

from kissgs.core import resources as free_memory
from kissgs.core.resources import keep_free_memory, return_free_memory

LARGE_ARRAYS = """
import resource
import numpy as np
from kissgs.core.resources import keep_free_memory

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
