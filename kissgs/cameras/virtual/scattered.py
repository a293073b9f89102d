"""``scattered_cameras``: cameras anywhere in and around a scene, for what a capture does not show.

They preserve what is seen from beside, behind and above the cameras of a capture, from afar and from within.
"""

from __future__ import annotations

import numpy as np

from kissgs.cameras.virtual.close_ups import camera_facing, random_direction
from kissgs.cameras.virtual.scene_bounds import opacity, scene_bounds
from kissgs.cameras.virtual.scoring import proxy_scene
from kissgs.core.splats import Splats
from kissgs.rendering.camera import Camera
from kissgs.rendering.local_scale import local_scale

NEAREST, FARTHEST = 10.0, 3.0
"""Smallest distance from the Gaussian in the centre, local scales (:func:`~kissgs.rendering.local_scale.local_scale`)
of the proxy scene but at most a radius of the scene, and the largest one, radii."""

ACROSS = 3
"""One in this many cameras stands beside another Gaussian, and looks across the scene."""

MAX_BESIDE = 8.0
"""Largest distance of such a camera from the Gaussian beside it, local scales; the smallest one is a local scale."""


def scattered_cameras(splats: Splats, *, side: int, count: int, seed: int = 0, threads: int = 0) -> list[Camera]:
    """Return cameras for square images, each with a random Gaussian in the centre, from any distance.

    Gaussians of the proxy scene are drawn in proportion to their opacity; distances are log-uniformly distributed,
    directions uniformly.

    Args:
        splats: the scene, finite.
        side: of the images, pixels.
        count: number of cameras; without any visible Gaussian, the result is empty.
        seed: random seed; equal seeds give equal cameras.
        threads: number of threads; 0 means one per processor. The result does not depend on it.
    """
    proxy = proxy_scene(splats)
    weights = opacity(proxy)
    if not weights.sum() > 0:
        return []
    rng = np.random.default_rng(seed)
    scales, radius = local_scale(proxy, threads=threads), scene_bounds(proxy).radius
    drawn = rng.choice(len(proxy), (count, 2), p=weights / weights.sum())
    cameras = []
    for n, (looked_at, beside) in enumerate(drawn):
        target, direction = proxy.means[looked_at].astype(np.float64), random_direction(rng)
        if n % ACROSS == 0:
            offset = direction * _log_uniform(rng, float(scales[beside]), MAX_BESIDE * float(scales[beside]))
            direction = proxy.means[beside].astype(np.float64) + offset - target
            distance = max(float(np.linalg.norm(direction)), 1e-9)
            direction /= distance
        else:
            nearest = min(NEAREST * float(scales[looked_at]), radius)
            distance = _log_uniform(rng, nearest, FARTHEST * radius)
        cameras.append(camera_facing(target, direction, distance, side))
    return cameras


def _log_uniform(rng: np.random.Generator, low: float, high: float) -> float:
    return float(np.exp(rng.uniform(np.log(low), np.log(high))))
