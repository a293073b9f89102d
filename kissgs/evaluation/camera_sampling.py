"""Settings and helpers of all evaluation cameras: fields of view, backgrounds, smallest distance."""

from __future__ import annotations

import numpy as np

from kissgs.core.array_types import Float64
from kissgs.rendering.camera import Camera, look_at
from kissgs.rendering.constants import NEAR

BACKGROUNDS = (0.0, 0.5, 1.0)
"""Grey levels of the views' backgrounds, in turn: on black, missing parts of a dark scene would not show."""

FIELDS_OF_VIEW = np.radians((50.0, 90.0))
"""Smallest and largest field of view along the longer side of the image, radians."""

MIN_DISTANCE = 5 * NEAR
"""Smallest distance of a camera to its target, world units. Gaussians nearer than ``NEAR`` are not drawn; a camera that
would be closer gets a narrower field of view instead."""

MAX_DRAWS = 12
"""Largest number of cameras drawn for one view until one is accepted."""

THUMBNAIL = 64
"""Longer side of the thumbnails that decide whether a camera is accepted, pixels."""

UP = np.array([0.0, -1.0, 0.0])
"""Up vector of all evaluation cameras."""

Point = Float64[np.ndarray, "3"]


def random_direction(rng: np.random.Generator) -> Point:
    """Return a unit vector, uniformly distributed over the sphere."""
    vector = rng.standard_normal(3)
    return np.asarray(vector / max(float(np.linalg.norm(vector)), 1e-9))


def camera_at(position: Point, target: Point, fov: float, size: tuple[int, int]) -> Camera:
    """Return a camera at ``position`` that looks at ``target``.

    If that is nearer than :data:`MIN_DISTANCE`, the camera moves back and its field of view shrinks, so that the image
    shows the same section.

    Args:
        position: of the camera, world units.
        target: point in the middle of the image, world units.
        fov: field of view along the longer side, radians.
        size: width and height of the image, pixels.
    """
    distance = float(np.linalg.norm(position - target))
    if distance < MIN_DISTANCE:
        away = (position - target) / distance if distance > 0 else -UP
        position = target + MIN_DISTANCE * away
        fov = max(2 * float(np.arctan(np.tan(fov / 2) * distance / MIN_DISTANCE)), 1e-9)
    return look_at(position, target, UP, fov=fov, width=size[0], height=size[1])
