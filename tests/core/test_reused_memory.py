"""Memory that is used again. Oracle: no two arrays in use overlap, and NumPy's own shapes and types."""

import itertools
import threading

import numpy as np
import pytest

from kissgs.core import reused_memory as memory
from kissgs.core.reused_memory import SMALLEST, empty, reused_memory


def address(array):
    return array.__array_interface__["data"][0]


@pytest.mark.parametrize("shape", [0, 5, (0, 3), (SMALLEST,), (SMALLEST // 2, 3)])
@pytest.mark.parametrize("dtype", [np.float32, np.int64, np.uint8])
def test_arrays_have_the_shape_and_type(shape, dtype):
    with reused_memory():
        for _ in range(2):
            found = empty(shape, dtype)
            assert found.shape == np.empty(shape).shape
            assert found.dtype == dtype
            assert found.flags.c_contiguous
            assert found.flags.writeable
            assert address(found) % 16 == 0


def test_the_memory_of_an_array_is_used_again_once_it_is_gone():
    with reused_memory():
        first = empty(SMALLEST, np.float32)
        place = address(first)
        del first
        assert address(empty(SMALLEST - 7, np.float32)) == place
        assert address(empty((2, SMALLEST // 2), np.int32)) == place


def test_arrays_in_use_never_overlap():
    rng, used = np.random.default_rng(0), []
    with reused_memory():
        for _ in range(300):
            if used and rng.random() < 0.5:
                used.pop(rng.integers(len(used)))
            used.append(empty(int(rng.integers(SMALLEST, 3 * SMALLEST)), np.uint8)[5:])  # a view keeps it
            used[-1][[0, -1]] = 1
            ranges = sorted((address(array), address(array) + array.nbytes) for array in used)
            assert all(end <= begin for (_, end), (begin, _) in itertools.pairwise(ranges))
            del used[8:]


def test_a_growing_array_does_not_leave_blocks_behind():
    with reused_memory():
        for number in range(1, 20):
            empty(number * SMALLEST, np.uint8)
        assert len(memory._current.get()._blocks) <= 1


def test_memory_is_kept_within_the_context_of_one_thread_only():
    seen = []
    with reused_memory():
        with reused_memory():
            place = address(empty(SMALLEST, np.uint8))
        assert address(empty(SMALLEST, np.uint8)) == place  # the inner context is part of the outer one
        thread = threading.Thread(target=lambda: seen.append(memory._current.get()))
        thread.start()
        thread.join()
    assert seen == [None]
    assert memory._current.get() is None
