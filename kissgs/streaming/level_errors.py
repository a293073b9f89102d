"""``level_errors``: how much the coarser levels of a leaf differ from its finest, measured in rendered images.

The leaf is drawn alone. Other Gaussians in front of it could only hide differences.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from kissgs.core.array_types import Float64
from kissgs.core.splats import Splats
from kissgs.rendering.camera import Camera, look_at
from kissgs.rendering.rasterizer import render

SIZE = 128
"""Width and height of the images, pixels; the leaf fills them."""

DIRECTIONS = np.array([[1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0], [0, 0, 1], [0, 0, -1]], np.float64)
"""Directions from which a leaf is seen."""

DISTANCE = 4.0
"""Distance of the cameras, in radii of the leaf."""

INSIDE = 0.9
"""Share of a leaf's Gaussians within its radius: a few may be far away."""

BACKGROUND = (0.5, 0.5, 0.5)


def level_errors(levels: Sequence[Splats]) -> list[float]:
    """Return the root mean square error of each level, in units of the range of colours; that of the finest is 0.

    No level has a smaller error than a finer one, so that a smaller error never asks for a coarser level.

    Args:
        levels: the leaf's Gaussians in each level, the finest first, clean.
    """
    squared = np.zeros(len(levels))
    for camera in _cameras(levels[0]):
        images = [np.clip(render(level, camera, background=BACKGROUND, threads=1)[0], 0, 1) for level in levels]
        squared += [float(np.mean((image - images[0]) ** 2)) for image in images]
    errors = np.sqrt(squared / len(DIRECTIONS))
    return [round(float(error), 5) for error in np.maximum.accumulate(np.nan_to_num(errors, nan=1.0))]


def _cameras(leaf: Splats) -> list[Camera]:
    means = leaf.means.astype(np.float64)
    centre = np.median(means, axis=0)
    radius = _radius(means - centre, leaf)
    fov, up = 2 * np.arctan(1 / DISTANCE), np.array([0.1, 1.0, 0.2])
    return [
        look_at(centre + DISTANCE * radius * direction, centre, up, fov=fov, width=SIZE, height=SIZE)
        for direction in DIRECTIONS
    ]


def _radius(offsets: Float64[np.ndarray, "N 3"], leaf: Splats) -> float:
    """Return the radius of the ball around the centre that holds most of the leaf, or its median Gaussian."""
    size = float(np.exp(np.median(leaf.scales.max(axis=1).astype(np.float64))))
    return max(float(np.quantile(np.linalg.norm(offsets, axis=1), INSIDE)), 2 * size)
