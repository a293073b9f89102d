"""Compiled sorting of keys, for :mod:`kissgs.planning.layout`."""

from __future__ import annotations

import numpy as np

from kissgs.core.array_types import Int32, UInt64
from kissgs.core.numba_kernels import compiled


@compiled("void(uint64[::1], int32[::1], uint64[::1], int32[::1], int64)")
def sort_keys(
    keys: UInt64[np.ndarray, " N"],
    order: Int32[np.ndarray, " N"],
    other_keys: UInt64[np.ndarray, " N"],
    other_order: Int32[np.ndarray, " N"],
    passes: int,
) -> None:
    """Sort ``keys`` stably by their lowest 12 · ``passes`` bits, and write the permutation to ``order``, by radix sort.

    ``passes`` is even, so that the result ends in ``keys`` and ``order``; the others are scratch.
    """
    count = keys.shape[0]
    counts = np.zeros((passes, 4096), np.int64)
    for n in range(count):
        order[n] = n
        key = keys[n]
        for digit in range(passes):
            counts[digit, (key >> np.uint64(12 * digit)) & np.uint64(4095)] += 1
    for digit in range(passes):
        total = 0
        for value in range(4096):
            total, counts[digit, value] = total + counts[digit, value], total
        here, there = (keys, other_keys) if digit % 2 == 0 else (other_keys, keys)
        old, new = (order, other_order) if digit % 2 == 0 else (other_order, order)
        shift = np.uint64(12 * digit)
        for n in range(count):
            value = (here[n] >> shift) & np.uint64(4095)
            place = counts[digit, value]
            counts[digit, value] = place + 1
            there[place] = here[n]
            new[place] = old[n]
