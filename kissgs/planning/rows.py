"""Rows of attributes that are made block by block, so that no whole copy of a scene is needed."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol, TypeVar, runtime_checkable

import numpy as np

from kissgs.core.array_types import Int, Int32, Shaped, UInt64
from kissgs.core.resources import Workers

R = TypeVar("R")

BLOCK = 1 << 14
"""Number of rows of a block: its float64 values stay in the processor's cache."""


@runtime_checkable
class Rows(Protocol):
    """Array, or what gives the rows of one when asked: ``values[first:last]`` is ``(last - first, C)``."""

    def __len__(self) -> int:
        """Return the number of rows."""

    def __getitem__(self, rows: slice, /) -> np.ndarray:
        """Return some rows."""


@dataclass(frozen=True, slots=True, eq=False)
class Computed:
    """Rows that a function computes."""

    count: int
    of: Callable[[slice], np.ndarray]

    def __len__(self) -> int:
        return self.count

    def __getitem__(self, rows: slice) -> np.ndarray:
        return self.of(rows)


def selected(array: Shaped[np.ndarray, "N C"], index: Int[np.ndarray, " M"]) -> Computed:
    """Return the rows of ``array`` at ``index``, in that order."""
    return Computed(len(index), lambda rows: array.take(index[rows], axis=0))


def for_each_block(
    count: int, work: Callable[[slice], R], pool: Workers | None = None, *, block: int = BLOCK
) -> list[R]:
    """Call ``work`` for the slices that cover ``count`` rows; return its results in their order."""
    slices = [slice(first, min(first + block, count)) for first in range(0, count, block)]
    return [work(rows) for rows in slices] if pool is None else pool.map(work, slices)


def row_range(values: Rows, pool: Workers | None = None) -> tuple[np.ndarray, np.ndarray]:
    """Return the smallest and the largest value of each column, of at least one row."""

    def ends(rows: slice) -> tuple[np.ndarray, np.ndarray]:
        columns = values[rows].T  # NumPy is slow at the ends of short rows
        return np.array([column.min() for column in columns]), np.array([column.max() for column in columns])

    found = for_each_block(len(values), ends, pool)
    return np.min([low for low, _ in found], axis=0), np.max([high for _, high in found], axis=0)


def sorted_order(keys: UInt64[np.ndarray, " N"], bits: int = 64) -> Int32[np.ndarray, " N"]:
    """Sort ``keys``, below 2^``bits``, in place; return the permutation that does, stably."""
    from kissgs.planning import order_kernels

    order, scratch = np.empty(len(keys), np.int32), np.empty(len(keys), np.int32)
    order_kernels.sort_keys(keys, order, np.empty_like(keys), scratch, 2 * -(-bits // 24))
    return order
