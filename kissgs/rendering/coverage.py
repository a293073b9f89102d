"""Coverage: how well the best camera has seen each Gaussian; local scale: the distance between Gaussians."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from kissgs.core.array_types import Float32
from kissgs.core.resources import Workers
from kissgs.core.sensitivity import BLOCK
from kissgs.core.splats import Splats
from kissgs.rendering.constants import DILATION, NEAR
from kissgs.rendering.cpu.tiles import each_part, even

if TYPE_CHECKING:
    from kissgs.rendering.cpu.frame import Frame


# Local scale: the distance between Gaussians around each one, from which its surroundings fill an image.

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


# Coverage: how well the best camera has seen each Gaussian, by visibility and resolution.

VISIBLE = 0.003
"""Share of a Gaussian's squared alpha in an image from which on it counts as seen; with less than a twentieth of its
opacity unobstructed, it is hidden."""

RESOLVED = 3.0
"""Length in the image of the distance to the 128th neighbour from which on a Gaussian counts as resolved, pixels."""

ISOLATED, MAX_APPROACH = 16.0, 3.0
"""A Gaussian whose neighbours are more than :data:`ISOLATED` times its size away counts as an object of its own, which
is viewed from up to :data:`MAX_APPROACH` times nearer."""


class Coverage:
    """The best coverage of each Gaussian over the images added so far.

    Args:
        splats: a finite scene.
    """

    def __init__(self, splats: Splats) -> None:
        self._splats = splats
        self._scale = local_scale(splats)
        self.share: Float32[np.ndarray, " N"] = np.zeros(len(splats), np.float32)
        """``(N,)`` coverage from 0, seen by no camera or only from far away, to 1, seen from nearby."""

    @property
    def close_up(self) -> Float32[np.ndarray, " N"]:
        """``(N,)`` mean squared alpha, 0 to 1, of each Gaussian in an unobstructed image that its surroundings fill."""
        found = np.empty(len(self._scale), np.float32)
        for first in range(0, len(found), BLOCK):
            rows = slice(first, first + BLOCK)
            logs = np.sort(self._splats.scales[rows], axis=1)[:, 1:].astype(np.float64)
            scale = self._scale[rows].astype(np.float64)
            near = np.maximum(np.minimum(scale, ISOLATED * np.exp(logs[:, 0])), scale / MAX_APPROACH)
            area = np.pi * np.exp(logs.sum(axis=1)) / near**2
            opacity = 1 / (1 + np.exp(-self._splats.opacities[rows].astype(np.float64)))
            found[rows] = opacity**2 * np.minimum(area, 1)
        return found

    def add(self, frame: Frame, seen: Float32[np.ndarray, " N"], pool: Workers, finer: float = 1.0) -> None:
        """Update the coverage by one rendered image.

        Args:
            frame: the image.
            seen: sum over pixels of (alpha T)², T being the transmittance in front of the Gaussian, by row of the
                frame's footprints.
            pool: threads.
            finer: ratio of the resolution of the image that this one is a thumbnail of to its own.
        """
        from kissgs.rendering.cpu.coverage import raise_coverage

        splats, camera = frame.splats, frame.camera
        limits = np.array([NEAR, VISIBLE, RESOLVED / finer, camera.dilation / DILATION, splats.antialiased])

        def part(rows: tuple[int, int]) -> None:
            raise_coverage(
                splats.means,
                splats.scales,
                splats.opacities,
                self._scale,
                frame.footprints.visible,
                *rows,
                seen,
                camera.position,
                float(np.sqrt(camera.K[0, 0] * camera.K[1, 1])),
                camera.width * camera.height,
                limits,
                self.share,
            )

        pool.map(part, frame.footprints.parts)
