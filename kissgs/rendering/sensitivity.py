"""Measures what a change of each stored value costs in pictures: exactly, with one pass per picture."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from kissgs.core.array_types import Float32
from kissgs.core.errors import InvalidViewsError
from kissgs.core.progress import Progress, silent
from kissgs.core.sensitivity import LARGEST, OPACITY, ROTATION, SCALES, Sensitivity
from kissgs.core.splats import Splats
from kissgs.core.threads import Workers
from kissgs.rendering.camera import Camera
from kissgs.rendering.coverage import Coverage


@dataclass(frozen=True, slots=True, eq=False)
class WeightedCameras:
    """Where a scene is looked at from, and how much each picture counts.

    Attributes:
        cameras: at the size to render.
        weights: of each, positive; they need not sum to 1.
        background: ``(3,)`` red, green, blue.
        spread: standard deviation of each channel of the background: how little is known of it.
        captured: how many of the cameras, the first ones, are a capture's.

    Raises:
        InvalidViewsError: no camera; not as many weights as cameras; a weight or the spread is negative or not finite.
    """

    cameras: Sequence[Camera]
    weights: Sequence[float]
    background: Float32[np.ndarray, "3"]
    spread: float = 0.25
    captured: int = 0

    def __post_init__(self) -> None:
        if not self.cameras or len(self.cameras) != len(self.weights):
            raise InvalidViewsError(
                f"a scene is watched by one camera or more with a weight each, not by {len(self.cameras)} cameras with "
                f"{len(self.weights)} weights"
            )
        if not all(0 < weight < math.inf for weight in self.weights) or not 0 <= self.spread < math.inf:
            raise InvalidViewsError("weights of cameras must be positive and finite, and the spread not negative")

    def per_pixel(self) -> list[float]:
        """Weights of the squared error of one channel of one pixel, so that a weighted sum is a mean."""
        total = float(sum(self.weights))
        pixels = [3 * camera.width * camera.height for camera in self.cameras]
        return [weight / total / count for weight, count in zip(self.weights, pixels, strict=True)]


def measure_sensitivity(
    splats: Splats,
    watch: WeightedCameras,
    *,
    view_uncertainty: float = 0.0,
    threads: int = 0,
    progress: Progress = silent,
) -> Sensitivity:
    """Look at a scene from all of ``watch`` and see what every small change would cost there.

    Costs are those of the first derivative: J ᵀ J of the pictures, its blocks per Gaussian, without sampling. Left out
    are what a move does to a footprint's shape and to the colour seen from there, and changes of which Gaussian is in
    front: all small beside a move's effect on its own.

    Args:
        splats: finite (:func:`kissgs.clean`).
        watch: at least one camera.
        view_uncertainty: from 0 to 1, how far to move towards a prior for cameras that are not among them
            (:meth:`kissgs.Sensitivity.with_prior`).
        threads: 0 means one per processor; the result does not depend on it.
        progress: receives the stage ``"sensitivity"``.

    Raises:
        UnsupportedError: a picture would take too much memory.
    """
    from kissgs.rendering.cpu.frame import add_sensitivities, draw

    found = Sensitivity.none(len(splats), splats.sh_degree)
    coverage, captured = Coverage(splats), np.zeros(len(splats))
    with Workers(threads) as pool:
        for done, (camera, weight) in enumerate(zip(watch.cameras, watch.per_pixel(), strict=True)):
            progress("sensitivity", done / len(watch.cameras))
            before = found.color_weight.copy()
            add_sensitivities(draw(splats, camera, watch.background, pool), weight, watch.spread, found, pool)
            coverage.add(camera, np.maximum(found.color_weight - before, 0) / weight)
            if done < watch.captured:
                captured = coverage.share.copy()
    _bound(found.position_hessian, (0, 3, 5))
    _bound(found.shape_hessian, OPACITY + SCALES + ROTATION)
    np.nan_to_num(found.color_weight, copy=False, nan=LARGEST, posinf=LARGEST)
    np.nan_to_num(found.mean_sh_basis, copy=False, nan=0.0, posinf=0.0, neginf=0.0)
    seen = found.color_weight > 0
    found.mean_sh_basis[seen] /= found.color_weight[seen, None]
    found.captured[:] = (
        captured if view_uncertainty else 1.0
    )  # where nothing is hedged, these cameras are all that matters
    progress("sensitivity", 1.0)
    return found.with_prior(splats, coverage.close_up, coverage.share, view_uncertainty)


def _bound(forms: Float32[np.ndarray, "N n"], diagonal: tuple[int, ...]) -> None:
    """Where a form overflows, keep its diagonal, at most as large as can be."""
    wild = ~(np.abs(forms) <= LARGEST).all(axis=1)
    kept = np.nan_to_num(forms[wild][:, diagonal], nan=LARGEST)
    forms[wild] = 0
    forms[np.ix_(wild, diagonal)] = np.minimum(kept, LARGEST)
