"""Coverage: how well the best camera has seen each Gaussian; local scale: the distance between Gaussians."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from kissgs.core.array_types import Float32
from kissgs.core.resources import Workers
from kissgs.core.sensitivity import BLOCK
from kissgs.core.splats import Splats
from kissgs.rendering.constants import DILATION
from kissgs.rendering.cpu.tiles import each_part, even

if TYPE_CHECKING:
    from kissgs.rendering.cpu.frame import Frame

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
    """
    from kissgs.rendering.cpu.neighbours import leaf_scales, leaves_of

    means, found = np.array(splats.means, order="C"), np.empty(len(splats), np.float32)
    order, edges = leaves_of(means, LEAF)
    with Workers(threads) as pool:
        each_part(
            lambda first, last: leaf_scales(means, order, edges, first, last, SAMPLED, NEIGHBOURS, GAP, found),
            even(len(edges) - 1, pool),
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
    """The best coverage of each Gaussian over the images added so far."""

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

        ``seen``: sum over pixels of (alpha T)² by row of the frame's footprints; ``finer``: ratio of the resolution of
        the image that this one is a thumbnail of to its own.
        """
        from kissgs.rendering.cpu.coverage import raise_coverage

        limits = np.array([VISIBLE, RESOLVED / finer, frame.camera.dilation / DILATION])
        scene = frame.gaussians, frame.projection, self._scale, frame.footprints.visible
        pool.map(lambda rows: raise_coverage(*scene, *rows, seen, limits, self.share), frame.parts)
