"""Compiled sorting of keys, for :mod:`kissgs.planning.layout`."""

from __future__ import annotations

import numpy as np

from kissgs.core.numba_kernels import compiled


@compiled("void(uint64[::1], int32[::1], uint64[::1], int32[::1], int64)")
def sort_keys(
    keys: np.ndarray, order: np.ndarray, other_keys: np.ndarray, other_order: np.ndarray, passes: int
) -> None:
    """Sort ``keys`` stably by their lowest 12 · ``passes`` bits, by radix sort, and write the permutation to ``order``.

    Args:
        keys: ``(N,)``; sorted.
        order: ``(N,)``; written.
        other_keys: ``(N,)`` scratch.
        other_order: ``(N,)`` scratch.
        passes: number of digits of 12 bits; even, so that the result ends in ``keys`` and ``order``.
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
