"""Order of the Gaussians in the grid: row-major along a 3D Hilbert curve, or sorted by PLAS.

WebP predicts a pixel from its left and upper neighbours and repeats earlier runs; with a one-dimensional curve through
space, planes are smaller than with any two-dimensional arrangement that was measured. The grid is described in
docs/reference/format.md.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from math import isqrt

import numpy as np

from kissgs.core.array_types import Bool, Float32, Int, Int32, Integer, UInt16
from kissgs.core.errors import UnsupportedError
from kissgs.core.limits import MAX_GRID_SIDE
from kissgs.core.threads import Workers
from kissgs.planning.plas import plas
from kissgs.planning.quantize import quantize_means
from kissgs.planning.rows import for_each_block, selected, sorted_order
from kissgs.settings import EncodeSettings

PLAS_HIGH, PLAS_LOW = 1.0, 0.2
"""Weights of the high and the low position bytes in PLAS, as in the paper's public encoder."""

CURVE_BITS = 48
"""Bits of a position along the Hilbert curve."""


@dataclass(frozen=True, slots=True)
class Grid:
    """Cells of the grid and their Gaussians, row-major.

    Attributes:
        side: G, cells per axis.
        cells: ``(G*G,)`` index in the scene of each cell's Gaussian; padding repeats a Gaussian.
        mask: ``(G*G,)`` true for cells with a Gaussian, false for padding.
        cell_to_gaussian: ``(G*G,)`` for each cell, the rank of its Gaussian among the cells with ``mask``.
    """

    side: int
    cells: Int[np.ndarray, " cells"]
    mask: Bool[np.ndarray, " cells"]
    cell_to_gaussian: Int[np.ndarray, " cells"]

    def with_padding_last(self) -> Grid:
        """Move the last Gaussians into the padding before them, so that all padding is at the end."""
        count = int(self.mask.sum())
        holes = np.flatnonzero(~self.mask[:count])
        if len(holes) == 0:
            return self
        cells, index = self.cells.copy(), np.arange(len(self.cells), dtype=np.int32)
        cells[holes] = cells[count + np.flatnonzero(self.mask[count:])]
        cells[count:] = cells[count - 1]
        return Grid(self.side, cells, index < count, np.minimum(index, count - 1))


def layout_grid(
    means: Float32[np.ndarray, "N 3"],
    kept: Int[np.ndarray, " M"],
    bits: int,
    settings: EncodeSettings,
    pool: Workers,
    report: Callable[[float], None],
    classes: Integer[np.ndarray, " M"] | None = None,
    groups: UInt16[np.ndarray, " N"] | None = None,
) -> Grid:
    """Assign a cell to every Gaussian of ``kept``.

    With ``classes`` and the Hilbert order, the Gaussians of class 0 come first, then those of class 1 and so on, each
    class along its own curve. With ``groups``, all this is done for group 0, then for group 1 and so on.

    Raises:
        UnsupportedError: more Gaussians than one image can hold.
    """
    side = grid_side(len(kept))
    if len(kept) == 0:
        nothing = np.zeros(side * side, dtype=np.int32)
        return Grid(side, nothing, nothing.astype(bool), nothing)
    levels = quantize_means(selected(means, kept), bits=bits, pool=pool).levels
    if settings.order != "plas":
        order = hilbert_order(levels, _with_groups(classes, groups, kept), pool)
        order = np.concatenate([order, np.repeat(order[-1:], side * side - len(order))])
        mask = np.arange(side * side) < len(kept)
    else:
        order, mask = _plas_order(levels, side, settings, pool, report)
    del levels
    rank = np.empty(len(kept), dtype=np.int32)
    rank[order[mask]] = np.arange(len(kept), dtype=np.int32)
    return Grid(side, kept.astype(np.int32, copy=False).take(order), mask, rank[order])


def _with_groups(
    classes: Integer[np.ndarray, " M"] | None, groups: UInt16[np.ndarray, " N"] | None, kept: Int[np.ndarray, " M"]
) -> Integer[np.ndarray, " M"] | None:
    """Return classes such that the groups follow one another, and the classes within each."""
    if groups is None:
        return classes
    own = groups[kept]
    return own if classes is None else own * np.uint16(classes.max(initial=0) + 1) + classes


def _plas_order(
    levels: UInt16[np.ndarray, "M 3"],
    side: int,
    settings: EncodeSettings,
    pool: Workers,
    report: Callable[[float], None],
) -> tuple[Int[np.ndarray, " cells"], Bool[np.ndarray, " cells"]]:
    """Return order and mask of the cells sorted by PLAS on both position bytes, padding included."""
    count = len(levels)
    rng = np.random.Generator(np.random.PCG64(settings.seed))
    padding = rng.integers(0, count, side * side - count)
    index = np.concatenate([np.arange(count), padding]).astype(np.int32)
    radius = settings.plas_start_radius
    start = rng.permutation(side * side) if radius is None else hilbert_order(levels[index])
    index = index[start]
    high, low = (_standardized(part) for part in (levels[index] >> 8, levels[index] & 255))
    items = np.concatenate([PLAS_HIGH * high, PLAS_LOW * low], axis=1).astype(np.float32)
    placed = plas(items, pool, seed=settings.seed, decay=settings.plas_radius_decay, start_radius=radius, report=report)
    return index[placed], start[placed] < count


def _standardized(values: np.ndarray) -> np.ndarray:
    """Scale to zero mean and unit deviation over all channels together."""
    deviation = values.std()
    return (values - values.mean()) / (deviation if deviation > 0 else 1)


def grid_side(count: int) -> int:
    """Return the side of the square grid for ``count`` Gaussians: the smallest multiple of 8 that fits, at least 8.

    Raises:
        UnsupportedError: more Gaussians than one image can hold.
    """
    side = isqrt(max(count, 1) - 1) + 1
    side = -(-side // 8) * 8
    if side > MAX_GRID_SIDE:
        raise UnsupportedError(
            f"{count} Gaussians do not fit into one container; at most {MAX_GRID_SIDE**2} do: split the scene"
        )
    return side


def hilbert_order(
    levels: UInt16[np.ndarray, "N 3"], classes: Integer[np.ndarray, " N"] | None = None, pool: Workers | None = None
) -> Int32[np.ndarray, " N"]:
    """Return the order in which a 3D Hilbert curve visits the positions, the smallest class first.

    Args:
        levels: 16-bit positions.
        classes: class of each Gaussian, below 2^16; None if all are in one.
        pool: threads; None for the calling one.

    Returns:
        Indices of the Gaussians along the curve; Gaussians of equal position keep their order.
    """
    from kissgs.planning import kernels

    count = len(levels)
    keys = np.empty(count, np.uint64)

    def work(rows: slice) -> None:
        kernels.hilbert_keys(np.ascontiguousarray(levels[rows]), keys[rows])
        if classes is not None:
            keys[rows] |= classes[rows].astype(np.uint64) << np.uint64(CURVE_BITS)

    for_each_block(count, work, pool)
    return sorted_order(keys, CURVE_BITS if classes is None else 64)
