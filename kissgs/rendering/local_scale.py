"""Local scale: the distance between Gaussians around each one, from which its surroundings fill an image."""

from __future__ import annotations

import numpy as np

from kissgs.core.array_types import Float32
from kissgs.core.splats import Splats
from kissgs.core.threads import Workers
from kissgs.rendering.cpu.lists import each_part, even

LEAF = 512
"""Largest number of Gaussians in a leaf of the tree, among which neighbours are searched."""

NEIGHBOURS = 4
"""The local scale is the distance within which 1 / NEIGHBOURS of the leaf's Gaussians lie."""

SAMPLED = 4
"""Stride of the leaf's Gaussians to which distances are measured."""

GAP = 0.2
"""Share of the distance expected on a surface of uniform density: if the nearest half, quarter or eighth of the
neighbours is nearer than that, the object has no more Gaussians, and their distance is used."""


def local_scale(splats: Splats, *, threads: int = 0) -> Float32[np.ndarray, " N"]:
    """Return the distance from each Gaussian to about its 128th neighbour, ``(N,)``, world units, positive.

    Distances are measured within the leaves of a k-d tree of equal counts, which adapts to parts of any size. For an
    object of fewer Gaussians, the distance is extrapolated as if its surface continued. The result is at least the
    Gaussian's own size.

    Args:
        splats: a finite scene.
        threads: number of threads; 0 means one per processor. The result does not depend on it.
    """
    from kissgs.rendering.cpu.neighbours import leaf_scales, split_into_leaves

    count = len(splats)
    columns = np.ascontiguousarray(splats.means.T)
    order, edges = np.arange(count, dtype=np.int32), np.empty(4 * count // LEAF + 2, np.int64)
    leaves = split_into_leaves(columns, LEAF, order, edges)
    found = np.empty(count, np.float32)
    with Workers(threads) as pool:
        each_part(
            lambda first, last: leaf_scales(columns, order, edges, first, last, SAMPLED, NEIGHBOURS, GAP, found),
            even(leaves, pool),
            pool,
        )
    sizes = np.exp(np.median(splats.scales, axis=1))
    least = np.maximum(1e-6 * np.abs(splats.means).max(axis=1, initial=0), 1e-12)  # about float32's resolution
    return np.maximum(np.maximum(found, sizes), least).astype(np.float32)
