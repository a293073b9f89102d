"""Measures what a change of each stored value costs in pictures: exactly, with one pass per picture."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from kissgs._typing import Float32, Float64
from kissgs.importance import Importance
from kissgs.parallel import Workers
from kissgs.progress import Progress, silent
from kissgs.rendering.camera import Camera
from kissgs.rendering.semantics import NEAR
from kissgs.splats import Splats

LARGEST = 1e25
"""Of a cost: beyond it stand Gaussians so large that squares overflow, and sums of costs would be infinite."""


@dataclass(frozen=True, slots=True, eq=False)
class Watch:
    """Where a scene is looked at from, and how much each picture counts.

    Attributes:
        cameras: at the size to render.
        weights: of each, positive; they need not sum to 1.
        background: ``(3,)`` red, green, blue.
    """

    cameras: Sequence[Camera]
    weights: Sequence[float]
    background: Float32[np.ndarray, "3"]

    def per_pixel(self) -> list[float]:
        """Weights of the squared error of one channel of one pixel, so that a weighted sum is a mean."""
        total = float(sum(self.weights))
        pixels = [3 * camera.width * camera.height for camera in self.cameras]
        return [weight / total / count for weight, count in zip(self.weights, pixels, strict=True)]


def measure_importance(
    splats: Splats, watch: Watch, *, hedge: float = 0.0, threads: int = 0, progress: Progress = silent
) -> Importance:
    """Look at a scene from all of ``watch`` and see what every small change would cost there.

    Costs are those of the first derivative: J ᵀ J of the pictures, its blocks per Gaussian, without sampling. Left out
    are what a move does to a footprint's shape and to the colour seen from there, and changes of which Gaussian is in
    front: all small beside a move's effect on its own.

    Args:
        splats: finite (:func:`kissgs.clean`).
        watch: at least one camera.
        hedge: share of a guess to add for cameras that are not among them (:meth:`kissgs.Importance.hedged`).
        threads: 0 means one per processor; the result does not depend on it.
        progress: receives the stage ``"importance"``.

    Raises:
        UnsupportedError: a picture would take too much memory.
    """
    from kissgs.rendering.cpu.frame import add_sensitivities, draw

    found = Importance.none(len(splats), splats.sh_degree)
    with Workers(threads) as pool:
        for done, (camera, weight) in enumerate(zip(watch.cameras, watch.per_pixel(), strict=True)):
            progress("importance", done / len(watch.cameras))
            add_sensitivities(draw(splats, camera, watch.background, pool), weight, found, pool)
    for values in (found.places, found.shapes, found.colors, found.directions):
        np.nan_to_num(values, copy=False, nan=0.0, posinf=LARGEST, neginf=-LARGEST)
    seen = found.colors > 0
    found.directions[seen] /= found.colors[seen, None]
    progress("importance", 1.0)
    return found.hedged(splats, _exposed(splats, watch), hedge)


def _exposed(splats: Splats, watch: Watch) -> Float64[np.ndarray, " N"]:
    """Mean of (alpha)² in the pictures, if nothing were before each Gaussian and all were in the picture."""
    size = np.exp(np.sort(splats.scales, axis=1)[:, 1:].astype(np.float64))
    opacity = 1 / (1 + np.exp(-splats.opacities.astype(np.float64)))
    total = np.zeros(len(splats))
    for camera, weight in zip(watch.cameras, watch.per_pixel(), strict=True):
        distance = np.linalg.norm(splats.means - camera.position, axis=1)
        pixels = np.sqrt(camera.K[0, 0] * camera.K[1, 1]) / np.maximum(distance, NEAR)
        area = np.pi * (size[:, 0] * pixels) * (size[:, 1] * pixels)  # of a squared Gaussian
        total += weight * np.minimum(area + 1, camera.width * camera.height)
    return opacity**2 * total
