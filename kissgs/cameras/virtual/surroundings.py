"""``surrounding_cameras``: cameras anywhere in and around a scene, for what a capture does not show.

They preserve what is seen from beside, behind and above the cameras of a capture, from afar and from within.
"""

from __future__ import annotations

import numpy as np

from kissgs.cameras.virtual.close_ups import camera_facing, random_direction
from kissgs.cameras.virtual.scene_bounds import opacity, scene_bounds
from kissgs.core.splats import Splats
from kissgs.rendering.camera import Camera
from kissgs.rendering.local_scale import local_scale

NEAREST, FARTHEST = 16.0, 3.0
"""Smallest distance from the Gaussian in the centre, local scales (:func:`~kissgs.rendering.local_scale.local_scale`)
but at most a radius of the scene, and the largest one, radii."""

ACROSS = 3
"""One in this many cameras stands beside another Gaussian, and looks across the scene."""

MAX_BESIDE = 8.0
"""Largest distance of such a camera from the Gaussian beside it, local scales; the smallest one is a local scale."""


def surrounding_cameras(splats: Splats, *, side: int, count: int, seed: int = 0) -> list[Camera]:
    """Return cameras for square images, each with a random Gaussian in the centre, from any distance.

    Gaussians are drawn in proportion to their opacity, distances log-uniformly, directions uniformly.

    Args:
        splats: the scene, finite.
        side: of the images, pixels.
        count: number of cameras; without any visible Gaussian, the result is empty.
        seed: random seed; equal seeds give equal cameras.
    """
    weights = opacity(splats)
    if not weights.sum() > 0:
        return []
    rng = np.random.default_rng(seed)
    scales, radius = local_scale(splats), scene_bounds(splats).radius
    drawn = rng.choice(len(splats), (count, 2), p=weights / weights.sum())
    cameras = []
    for n, (looked_at, beside) in enumerate(drawn):
        target, direction = splats.means[looked_at].astype(np.float64), random_direction(rng)
        if n % ACROSS == 0:
            offset = direction * _log_uniform(rng, float(scales[beside]), MAX_BESIDE * float(scales[beside]))
            direction = splats.means[beside].astype(np.float64) + offset - target
            distance = max(float(np.linalg.norm(direction)), 1e-9)
            direction /= distance
        else:
            nearest = min(NEAREST * float(scales[looked_at]), radius)
            distance = _log_uniform(rng, nearest, FARTHEST * radius)
        cameras.append(camera_facing(target, direction, distance, side))
    return cameras


def _log_uniform(rng: np.random.Generator, low: float, high: float) -> float:
    return float(np.exp(rng.uniform(np.log(low), np.log(high))))
