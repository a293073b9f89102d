"""Morton order: Gaussians that follow one another are close to one another."""

from __future__ import annotations

import numpy as np

from kissgs.core.array_types import Float32, Int64, Shaped

_BITS = 21
"""Bits per axis: three axes fill 63 of 64 bits."""

_OUTSIDE = 1e-3
"""Share of the Gaussians at either end of an axis that is not resolved, so that outliers do not coarsen the rest."""

_SPREAD = (
    (32, 0x001F00000000FFFF),
    (16, 0x001F0000FF0000FF),
    (8, 0x100F00F00F00F00F),
    (4, 0x10C30C30C30C30C3),
    (2, 0x1249249249249249),
)


def morton_order(means: Float32[np.ndarray, "N 3"]) -> Int64[np.ndarray, " N"]:
    """Return the indices of the Gaussians in Morton order; equal places keep their order."""
    if len(means) == 0:
        return np.empty(0, np.int64)
    ends = np.quantile(means, [_OUTSIDE, 1 - _OUTSIDE], axis=0).astype(np.float64)
    extent = float((ends[1] - ends[0]).max()) or 1.0
    codes = np.zeros(len(means), np.uint64)
    for axis in range(3):
        cells = np.clip((means[:, axis].astype(np.float64) - ends[0, axis]) / extent, 0, 1) * (2**_BITS - 1)
        codes |= _spread(cells.astype(np.uint64)) << np.uint64(axis)
    return np.argsort(codes, kind="stable").astype(np.int64)


def _spread(cells: Shaped[np.ndarray, " N"]) -> Shaped[np.ndarray, " N"]:
    """Return numbers whose bits are two bits apart."""
    for shift, mask in _SPREAD:
        cells = (cells | cells << np.uint64(shift)) & np.uint64(mask)
    return cells
