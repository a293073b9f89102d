"""Cameras close to single Gaussians, wherever these lie: they see what views of whole objects are too far away to see.

A pruned scene gets holes where no camera was near, behind and between what the others see.
"""

from __future__ import annotations

import numpy as np

from kissgs.cameras.virtual.scene_bounds import opacity
from kissgs.core.splats import Splats
from kissgs.rendering.camera import Camera, look_at
from kissgs.rendering.constants import NEAR
from kissgs.rendering.local_scale import local_scale

FIELD_OF_VIEW = np.radians(70)
"""Angle along both sides, unless the camera would stand too near."""

OCTAVES = 3.0
"""Distances are from one local scale (:func:`~kissgs.rendering.local_scale.local_scale`) to so many octaves more."""

NEAREST = 5 * NEAR
"""World units: a camera nearer than this would look past what it is aimed at, and takes a longer lens instead."""

UP = np.array([0.0, -1.0, 0.0])
"""Any direction would do: it only turns the pictures."""


def close_ups(splats: Splats, *, side: int, count: int, seed: int = 0) -> list[Camera]:
    """Cameras for square pictures, each aimed at a Gaussian from any direction; the opaque are chosen more often.

    Args:
        splats: finite.
        side: of the pictures, pixels.
        count: how many; none where no Gaussian can be seen.
        seed: another one, other cameras.
    """
    chances = opacity(splats)
    if not chances.sum() > 0:
        return []
    rng = np.random.default_rng(seed)
    scales = local_scale(splats)
    found = []
    for target in rng.choice(len(splats), count, p=chances / chances.sum()):
        distance = scales[target] * 2 ** rng.uniform(0, OCTAVES)
        away = max(distance, NEAREST)
        fov = 2 * np.arctan(np.tan(FIELD_OF_VIEW / 2) * distance / away)
        direction = rng.standard_normal(3)
        direction /= max(float(np.linalg.norm(direction)), 1e-9)
        middle = splats.means[target].astype(np.float64)
        found.append(look_at(middle + away * direction, middle, UP, fov=float(fov), width=side, height=side))
    return found
