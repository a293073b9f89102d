"""How much of what each Gaussian could show the rendered images have shown, and from how near."""

from __future__ import annotations

import numpy as np

from kissgs.core.array_types import Float, Float64
from kissgs.core.splats import Splats
from kissgs.rendering.camera import Camera
from kissgs.rendering.constants import NEAR
from kissgs.rendering.local_scale import local_scale

VISIBLE = 0.003
"""A Gaussian has been looked at once so much of its squared alpha came through to an image: with less than a twentieth
of its opacity in front of everything else, it is hidden from there."""

RESOLVED = 3.0
"""Pixels that the distance to the 128th neighbour must span for the surroundings to be seen in detail."""


ISOLATED, NEARER = 16.0, 3.0
"""A Gaussian farther than so many of its sizes from its neighbours is taken to be looked at by itself, from so many
times nearer at most."""


class Coverage:
    """Keeps, for each Gaussian, the best view that any image has given of it.

    Args:
        splats: finite.
    """

    def __init__(self, splats: Splats) -> None:
        self._means = splats.means
        self._scale = local_scale(splats)
        self._sizes = np.exp(np.sort(splats.scales, axis=1)[:, 1:].astype(np.float64))
        self._squared_opacity = (1 / (1 + np.exp(-splats.opacities.astype(np.float64)))) ** 2
        self.share = np.zeros(len(splats))
        """``(N,)`` from 0, seen by no camera or from far away only, to 1, looked at from nearby."""

    @property
    def close_up(self) -> Float64[np.ndarray, " N"]:
        """``(N,)`` squared alpha over an image in which the surroundings of each Gaussian fill the frame and nothing is
        in front of it, as a share of that image, from 0 to 1."""
        near = np.maximum(np.minimum(self._scale, ISOLATED * self._sizes[:, 0]), self._scale / NEARER)
        area = np.pi * self._sizes[:, 0] * self._sizes[:, 1] / near**2
        return self._squared_opacity * np.minimum(area, 1)

    def add(self, camera: Camera, seen: Float[np.ndarray, " N"], finer: float = 1.0) -> None:
        """Take account of one image.

        Args:
            camera: it was rendered from.
            seen: ``(N,)`` sum over its pixels of (alpha T)², T being the transmittance of what is in front.
            finer: how many times more pixels the image has, in each direction, for which it stands.
        """
        distance = np.linalg.norm(self._means - camera.position, axis=1)
        pixels = np.sqrt(camera.K[0, 0] * camera.K[1, 1]) / np.maximum(distance, NEAR)
        area = np.pi * (self._sizes[:, 0] * pixels) * (self._sizes[:, 1] * pixels) + 1  # of a squared Gaussian
        shown = self._squared_opacity * np.minimum(area, camera.width * camera.height)
        visible = np.minimum(seen / np.maximum(VISIBLE * shown, 1e-300), 1)
        resolved = np.minimum(finer * self._scale * pixels / RESOLVED, 1) ** 2
        np.maximum(self.share, visible * resolved, out=self.share)
