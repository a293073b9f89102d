"""Arrange vectors on a square grid by their principal axes, so that neighbours are similar.

The first axis decides the band of rows, the second the block of columns in it, and inside a block the third the row and
the fourth the column. Four sorts take milliseconds where PLAS (:mod:`kissgs.planning.plas`), which moves vectors until
neighbours are as similar as possible, takes seconds.
"""

from __future__ import annotations

import numpy as np

from kissgs.core.array_types import Float32, Int

BLOCK = 8
"""Side of a block, cells; sides of codebooks are multiples of it."""


def principal_axes(vectors: Float32[np.ndarray, "N D"], number: int) -> Float32[np.ndarray, "N axes"]:
    """Return the coordinates of the vectors along the ``number`` axes, or all, of their largest variances."""
    centred = vectors - vectors.mean(axis=0, dtype=np.float64)
    axes = np.linalg.eigh(centred.T @ centred)[1][:, ::-1][:, :number]
    return (centred @ axes).astype(np.float32)


def axes_order(coordinates: Float32[np.ndarray, "cells axes"]) -> Int[np.ndarray, " cells"]:
    """Arrange ``S*S`` vectors on an S × S grid.

    Args:
        coordinates: coordinates along their principal axes, largest variance first; S is a multiple of 8. Axes that are
            missing do not move anything.

    Returns:
        For each cell, row-major, the index of its vector.
    """
    cells = len(coordinates)
    side = round(cells**0.5)
    order = np.arange(cells)[None]
    for axis, group in enumerate((cells, BLOCK * side, BLOCK * BLOCK, BLOCK)):
        order = order.reshape(-1, group)
        if axis < coordinates.shape[1]:
            ranks = np.argsort(coordinates[order, axis], axis=1, kind="stable")
            order = np.take_along_axis(order, ranks, axis=1)
    blocks = order.reshape(side // BLOCK, side // BLOCK, BLOCK, BLOCK)
    return blocks.transpose(0, 2, 1, 3).reshape(-1)
