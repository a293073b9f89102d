"""Measurement of the sensitivity of a scene, exactly to first order, with one backward pass per image."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from kissgs.core.array_types import Float32
from kissgs.core.errors import InvalidViewsError
from kissgs.core.free_memory import return_free_memory
from kissgs.core.progress import Progress, silent
from kissgs.core.sensitivity import BLOCK, LARGEST, OPACITY, ROTATION, SCALES, Sensitivity
from kissgs.core.splats import Splats
from kissgs.core.threads import Workers
from kissgs.rendering.camera import Camera
from kissgs.rendering.coverage import Coverage

HIDDEN = 0.003
"""Transmittance from which on what is behind counts as hidden: a change there has a hundred-thousandth of the squared
error that it has in the open."""


@dataclass(frozen=True, slots=True, eq=False)
class WeightedCameras:
    """Cameras from which sensitivity is measured, with the weights of their images.

    Attributes:
        cameras: one or more, with the sizes of the images to render.
        weights: one for each camera, positive; they need not sum to 1.
        background: ``(3,)`` mean of the background, RGB from 0 to 1.
        spread: standard deviation of each channel of the background, which is unknown in general.
        captured: number of cameras of a capture, which come first.

    Raises:
        InvalidViewsError: no camera; another number of weights than of cameras; a weight that is not positive and
            finite; a spread that is negative or not finite.
    """

    cameras: Sequence[Camera]
    weights: Sequence[float]
    background: Float32[np.ndarray, "3"]
    spread: float = 0.25
    captured: int = 0

    def __post_init__(self) -> None:
        if not self.cameras or len(self.cameras) != len(self.weights):
            raise InvalidViewsError(
                f"sensitivity needs at least one camera and a weight for each, not {len(self.cameras)} cameras with "
                f"{len(self.weights)} weights"
            )
        if not all(0 < weight < math.inf for weight in self.weights) or not 0 <= self.spread < math.inf:
            raise InvalidViewsError(
                "weights of cameras must be positive and finite, and the spread finite and not negative"
            )

    def per_pixel(self) -> list[float]:
        """Return the weight of a single value of each image, such that the weighted sum of squared errors is a mean."""
        total = float(sum(self.weights))
        pixels = [3 * camera.width * camera.height for camera in self.cameras]
        return [weight / total / count for weight, count in zip(self.weights, pixels, strict=True)]


def measure_sensitivity(
    splats: Splats,
    cameras: WeightedCameras,
    *,
    view_uncertainty: float = 0.0,
    threads: int = 0,
    progress: Progress = silent,
) -> Sensitivity:
    """Measure the sensitivity of a scene: the Gauss-Newton Hessian of the squared image error, a block per Gaussian.

    The Hessian is J ᵀ J with J the derivative of the images, without sampling. Of a change of position, J omits the
    small effects on the footprint's shape (and so on the opacity's compensation in an antialiased scene), on the
    view-dependent colour and on the depth order. A Gaussian behind a
    transmittance of :data:`HIDDEN` counts as unseen in that pixel.

    Args:
        splats: a finite scene (:func:`kissgs.clean`).
        cameras: cameras and weights of the images.
        view_uncertainty: from 0 to 1, how strongly to shrink towards the prior for other cameras
            (:meth:`kissgs.Sensitivity.with_prior`).
        threads: number of threads; 0 means one per processor. The result does not depend on it.
        progress: receives the stage "sensitivity".

    Raises:
        UnsupportedError: an image would take too much memory.
    """
    from kissgs.rendering.cpu.frame import add_sensitivities, draw, for_kernels
    from kissgs.rendering.cpu.lists import each_part, even
    from kissgs.rendering.cpu.sensitivity import moments_to_hessians

    splats = for_kernels(splats)
    coverage = Coverage(splats)
    found = Sensitivity.none(len(splats), splats.sh_degree, captured=cameras.captured > 0)
    if not view_uncertainty:
        found.captured[:] = 1  # no other cameras count
    with Workers(threads) as pool:
        for done, (camera, weight) in enumerate(zip(cameras.cameras, cameras.per_pixel(), strict=True)):
            progress("sensitivity", done / len(cameras.cameras))
            frame = draw(splats, camera, cameras.background, pool, HIDDEN)
            coverage.add(frame, add_sensitivities(frame, weight, cameras.spread, found, pool), pool)
            if view_uncertainty and done + 1 == cameras.captured:
                found.captured[:] = coverage.share
            del frame  # before the next one is made
        each_part(
            lambda a, b: moments_to_hessians(splats.scales, splats.opacities, a, b, found.shape_hessian),
            even(len(splats), pool),
            pool,
        )
    _bound(found.position_hessian, (0, 1, 2))
    _bound(found.shape_hessian, OPACITY + SCALES + ROTATION)
    np.nan_to_num(found.color_weight, copy=False, nan=LARGEST, posinf=LARGEST)
    for harmonics in (found.mean_harmonics, found.higher_harmonics):
        np.nan_to_num(harmonics, copy=False, nan=0.0, posinf=0.0, neginf=0.0)
        colors = found.color_weight[:, None]
        np.divide(harmonics, colors, out=harmonics, where=colors > 0)
    return_free_memory()
    progress("sensitivity", 1.0)
    return found.with_prior(splats, coverage.close_up, coverage.share, view_uncertainty)


def _bound(hessians: Float32[np.ndarray, "N n"], diagonal: tuple[int, ...]) -> None:
    """Replace Hessians that overflow by their diagonals, at most :data:`LARGEST`."""
    for first in range(0, len(hessians), BLOCK):
        block = hessians[first : first + BLOCK]
        overflowing = ~(np.abs(block) <= LARGEST).all(axis=1)
        if overflowing.any():
            kept = np.nan_to_num(block[overflowing][:, diagonal], nan=LARGEST)
            block[overflowing] = 0
            block[np.ix_(overflowing, diagonal)] = np.minimum(kept, LARGEST)
