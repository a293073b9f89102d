"""PLAS: arrange vectors on a square grid so that neighbours are similar.

Parallel Linear Assignment Sorting (Morgenstern et al., "Compact 3D Scene Representation via Self-Organizing Gaussian
Grids", ECCV 2024). The grid is low-pass filtered; random groups of four items inside blocks are permuted to be as close
as possible to the filtered grid; this repeats with ever smaller filter radii.

Differences from the public implementation: the cheapest of the 24 permutations is applied as such (not inverted); each
block stops once it has converged; the filter is a box, which approximates the wide, truncated Gaussian used there.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from kissgs.core.array_types import Float32, Int32
from kissgs.core.threads import Workers

MIN_BLOCK = 8
MIN_CONFIGURATIONS = 4
CHANNELS_PER_TASK = 4


def plas(
    items: Float32[np.ndarray, "cells C"],
    pool: Workers,
    *,
    seed: int,
    decay: float = 0.95,
    threshold: float = 1e-4,
    start_radius: int | None = None,
    report: Callable[[float], None] = lambda fraction: None,
) -> Int32[np.ndarray, " cells"]:
    """Arrange ``S*S`` vectors on an S × S grid.

    Args:
        items: vectors in their initial arrangement, row-major; S is a multiple of 8. Squared distances are minimised,
            so scale and weight the channels before.
        pool: threads for the blocks; the result does not depend on their number.
        seed: seed of all random choices.
        decay: factor from one filter radius to the next; smaller is faster and slightly less smooth.
        threshold: relative improvement of a pass below which a block counts as converged.
        start_radius: first filter radius, cells; by default half the grid, which does not preserve the initial
            arrangement. A small radius preserves a good one, such as a space-filling curve, and takes less time.
        report: receives the fraction done, 0 to 1.

    Returns:
        For each cell, row-major, the index of its item.
    """
    side = round(len(items) ** 0.5)
    placed = np.arange(len(items), dtype=np.int32)
    rng = np.random.Generator(np.random.PCG64(seed))
    radii = _radii(start_radius or side // 2 - 1, decay)
    for step, radius in enumerate(radii):
        report(step / len(radii))
        width = min(side - 1, 2 * radius + 1)
        target = box_blur(items[placed].reshape(side, side, -1), width // 2, pool).reshape(len(items), -1)
        size = max(min(width + 1, side) // 2 * 2, MIN_BLOCK)
        configuration = 0
        while True:
            gained = _improve(items, placed, target, side, size, rng, threshold, pool)
            configuration += 1
            if configuration >= MIN_CONFIGURATIONS and gained <= 0:
                break
            if configuration >= 3 * MIN_CONFIGURATIONS:
                break
    return placed


def _radii(start: int, decay: float) -> list[int]:
    radii, radius = [max(start, 1)], float(start)
    while (radius := radius * decay) >= 1:
        radii.append(int(radius))
    return radii


def _improve(
    items: np.ndarray,
    placed: np.ndarray,
    target: np.ndarray,
    side: int,
    size: int,
    rng: np.random.Generator,
    threshold: float,
    pool: Workers,
) -> float:
    """Sort every block of one randomly shifted tiling to convergence; modify ``placed``, return the improvement."""
    from kissgs.planning import kernels

    down, right = rng.integers(0, size, 2)
    seed = np.uint64(rng.integers(0, 2**63))
    blocks = (side // size) ** 2
    edges = np.linspace(0, blocks, min(blocks, 4 * pool.threads) + 1).astype(np.int64)

    def work(task: int) -> float:
        tiling = np.array([side, down, right, size, edges[task], edges[task + 1]], dtype=np.int64)
        return float(kernels.plas_blocks(items, placed, target, tiling, seed, threshold))

    return sum(pool.map(work, range(len(edges) - 1)))


def box_blur(image: Float32[np.ndarray, "H W C"], radius: int, pool: Workers) -> Float32[np.ndarray, "H W C"]:
    """Average squares of ``2*radius + 1`` cells, wrapping around horizontally and mirrored vertically."""
    from kissgs.planning import kernels

    def work(first: int) -> np.ndarray:
        part = np.ascontiguousarray(image[:, :, first : first + CHANNELS_PER_TASK])
        rows, blurred = np.empty_like(part), np.empty_like(part)
        kernels.box_blur_rows(part, radius, rows, np.empty((1, part.shape[2])))
        kernels.box_blur_columns(rows, radius, blurred, np.empty((part.shape[1], part.shape[2])))
        return blurred

    parts = pool.map(work, range(0, image.shape[2], CHANNELS_PER_TASK))
    return np.concatenate(parts, axis=2)
