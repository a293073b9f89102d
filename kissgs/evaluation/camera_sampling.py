"""What all cameras that judge have in common: lenses, backgrounds, and how near they come."""

from __future__ import annotations

import numpy as np

from kissgs.core.array_types import Float64
from kissgs.rendering.camera import Camera, look_at
from kissgs.rendering.constants import NEAR

BACKGROUNDS = (0.0, 0.5, 1.0)
"""Black, grey and white, in turn: what is lost of a dark scene does not show on black."""

FIELDS_OF_VIEW = np.radians((50.0, 90.0))
"""Angles along the longer side."""

NEAREST = 5 * NEAR
"""World units: cameras do not go nearer, for what is nearer than NEAR is not drawn; they take a longer lens instead."""

PATIENCE = 12
"""Cameras that are drawn for a view, at most."""

THUMBNAIL = 64
"""Pixels of the longer side of the pictures that tell whether there is anything to see."""

UP = np.array([0.0, -1.0, 0.0])

Point = Float64[np.ndarray, "3"]


def direction(rng: np.random.Generator) -> Point:
    """A direction, any as likely as any other."""
    vector = rng.standard_normal(3)
    return np.asarray(vector / max(float(np.linalg.norm(vector)), 1e-9))


def aim(place: Point, target: Point, fov: float, size: tuple[int, int]) -> Camera:
    """A camera there, or no nearer than :data:`NEAREST` with as much in its picture; ``fov`` in radians."""
    distance = float(np.linalg.norm(place - target))
    if distance < NEAREST:
        away = (place - target) / distance if distance > 0 else -UP
        place = target + NEAREST * away
        fov = max(2 * float(np.arctan(np.tan(fov / 2) * distance / NEAREST)), 1e-9)
    return look_at(place, target, UP, fov=fov, width=size[0], height=size[1])
