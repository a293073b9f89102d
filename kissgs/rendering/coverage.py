"""Coverage: how well the best camera has seen each Gaussian, by visibility and resolution."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from kissgs.core.array_types import Float32
from kissgs.core.sensitivity import BLOCK
from kissgs.core.splats import Splats
from kissgs.core.threads import Workers
from kissgs.rendering.constants import DILATION, NEAR
from kissgs.rendering.local_scale import local_scale

if TYPE_CHECKING:
    from kissgs.rendering.cpu.frame import Frame

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
