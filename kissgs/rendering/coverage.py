"""Coverage: how well the best camera has seen each Gaussian, by visibility and resolution."""

from __future__ import annotations

import numpy as np

from kissgs.core.array_types import Float, Float64
from kissgs.core.splats import Splats
from kissgs.rendering.camera import Camera
from kissgs.rendering.constants import NEAR
from kissgs.rendering.local_scale import local_scale

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
        self._means = splats.means
        self._scale = local_scale(splats)
        self._sizes = np.exp(np.sort(splats.scales, axis=1)[:, 1:].astype(np.float64))
        self._squared_opacity = (1 / (1 + np.exp(-splats.opacities.astype(np.float64)))) ** 2
        self.share = np.zeros(len(splats))
        """``(N,)`` coverage from 0, seen by no camera or only from far away, to 1, seen from nearby."""

    @property
    def close_up(self) -> Float64[np.ndarray, " N"]:
        """``(N,)`` mean squared alpha, 0 to 1, of each Gaussian in an unobstructed image that its surroundings fill."""
        near = np.maximum(np.minimum(self._scale, ISOLATED * self._sizes[:, 0]), self._scale / MAX_APPROACH)
        area = np.pi * self._sizes[:, 0] * self._sizes[:, 1] / near**2
        return self._squared_opacity * np.minimum(area, 1)

    def add(self, camera: Camera, seen: Float[np.ndarray, " N"], finer: float = 1.0) -> None:
        """Update the coverage by one rendered image.

        Args:
            camera: camera of the image.
            seen: ``(N,)`` sum over pixels of (alpha T)², T being the transmittance in front of the Gaussian.
            finer: ratio of the resolution of the image that this one is a thumbnail of to its own.
        """
        distance = np.linalg.norm(self._means - camera.position, axis=1)
        pixels = np.sqrt(camera.K[0, 0] * camera.K[1, 1]) / np.maximum(distance, NEAR)
        area = np.pi * (self._sizes[:, 0] * pixels) * (self._sizes[:, 1] * pixels) + 1  # of a squared Gaussian
        shown = self._squared_opacity * np.minimum(area, camera.width * camera.height)
        visible = np.minimum(seen / np.maximum(VISIBLE * shown, 1e-300), 1)
        resolved = np.minimum(finer * self._scale * pixels / RESOLVED, 1) ** 2
        np.maximum(self.share, visible * resolved, out=self.share)
