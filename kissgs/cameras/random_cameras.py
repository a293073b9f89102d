"""Geometry of cameras that are drawn at random, of the encoder's and of the evaluation's."""

from __future__ import annotations

import numpy as np

from kissgs.core.array_types import Float64
from kissgs.rendering.camera import Camera, look_at
from kissgs.rendering.constants import NEAR

Vec3 = Float64[np.ndarray, "3"]
"""``(3,)`` float64, a point or a direction in world space."""

UP = np.array([0.0, -1.0, 0.0])
"""Up direction in the images of cameras whose roll does not matter."""

MIN_DISTANCE = 5 * NEAR
"""Smallest distance of a camera to its target, world units. Nearer, the near plane would cut the target off; such a
camera stands at this distance with a longer lens, which shows the same part of the scene."""

MIN_FIELD_OF_VIEW = 1e-9
"""Smallest angle of view of such a lens, radians."""


def random_direction(rng: np.random.Generator) -> Vec3:
    """Return a unit vector, uniformly distributed over the sphere."""
    direction = rng.standard_normal(3)
    return np.asarray(direction / max(float(np.linalg.norm(direction)), 1e-9))


def log_uniform(rng: np.random.Generator, low: float, high: float) -> float:
    """Return a number whose logarithm is uniformly distributed."""
    return float(np.exp(rng.uniform(np.log(low), np.log(high))))


def camera_facing(target: Vec3, direction: Vec3, distance: float, fov: float, size: tuple[int, int]) -> Camera:
    """Return a camera with ``target`` in the centre of its image, seen from ``direction``.

    ``fov`` in radians along the longer side of an image of ``size``, (width, height).
    """
    possible = max(distance, MIN_DISTANCE)
    narrow = max(2 * float(np.arctan(np.tan(fov / 2) * distance / possible)), MIN_FIELD_OF_VIEW)
    return look_at(target + possible * direction, target, UP, fov=narrow, width=size[0], height=size[1])


def camera_at(position: Vec3, target: Vec3, fov: float, size: tuple[int, int]) -> Camera:
    """Return a camera at ``position``, or farther away with a longer lens, that looks at ``target``."""
    distance = float(np.linalg.norm(position - target))
    if distance >= MIN_DISTANCE:
        return look_at(position, target, UP, fov=fov, width=size[0], height=size[1])
    return camera_facing(target, (position - target) / distance if distance > 0 else -UP, distance, fov, size)
