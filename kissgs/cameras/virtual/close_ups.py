"""``close_ups``: cameras close to single Gaussians, which see what views of whole objects are too far away to resolve.

A scene that is pruned without them gets holes behind and between what other cameras see.
"""

from __future__ import annotations

import numpy as np

from kissgs.cameras.virtual.scene_bounds import Vec3, opacity
from kissgs.core.splats import Splats
from kissgs.rendering.camera import Camera, look_at
from kissgs.rendering.constants import NEAR
from kissgs.rendering.local_scale import local_scale

FIELD_OF_VIEW = np.radians(70)
"""Angle of view along both sides, radians, where no longer lens is needed."""

OCTAVES = 3.0
"""Distances are one local scale (:func:`~kissgs.rendering.local_scale.local_scale`) to this many octaves more."""

MIN_DISTANCE = 5 * NEAR
"""Smallest distance of a camera from its target, world units. Nearer, the near plane would cut the target off; such a
camera stands at this distance with a longer lens, which shows the same part of the scene."""

UP = np.array([0.0, -1.0, 0.0])
"""Up direction in the images; arbitrary, because the roll does not matter."""


def close_ups(splats: Splats, *, side: int, count: int, seed: int = 0) -> list[Camera]:
    """Return cameras for square images, each with a random Gaussian in the centre, from a random direction.

    A Gaussian is drawn in proportion to its opacity.

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
    scales = local_scale(splats)
    cameras = []
    for target in rng.choice(len(splats), count, p=weights / weights.sum()):
        distance = float(scales[target] * 2 ** rng.uniform(0, OCTAVES))
        cameras.append(camera_facing(splats.means[target].astype(np.float64), random_direction(rng), distance, side))
    return cameras


def camera_facing(target: Vec3, direction: Vec3, distance: float, side: int) -> Camera:
    """Return a camera for square images with ``target`` in the centre, seen from ``direction``.

    Args:
        target: ``(3,)`` point, world units.
        direction: ``(3,)`` unit vector from the target to the camera.
        distance: of the camera from the target, world units. Below :data:`MIN_DISTANCE`, a longer lens takes its place.
        side: of the images, pixels.
    """
    possible = max(distance, MIN_DISTANCE)
    fov = 2 * np.arctan(np.tan(FIELD_OF_VIEW / 2) * distance / possible)
    return look_at(target + possible * direction, target, UP, fov=float(fov), width=side, height=side)


def random_direction(rng: np.random.Generator) -> Vec3:
    """Return a unit vector, ``(3,)``, uniformly distributed over the sphere."""
    direction = rng.standard_normal(3)
    return np.asarray(direction / max(float(np.linalg.norm(direction)), 1e-9))
