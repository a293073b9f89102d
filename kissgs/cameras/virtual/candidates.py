"""Cameras that are worth a try."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from kissgs.cameras.virtual.scene_bounds import Point, SceneBounds, opacity, weighted_median
from kissgs.core.array_types import Float64
from kissgs.core.splats import Splats
from kissgs.rendering.camera import Camera, look_at
from kissgs.rendering.constants import NEAR

FIELD_OF_VIEW = np.radians(60)
"""Of the longer side; about that of a phone."""

AZIMUTHS = 16
RADII = (0.7, 1.1, 1.7, 2.6)
"""Of the orbits, in radii of the scene's middle."""

WAYS_TO_LOOK = 8
"""From each place inside."""

CLOSE_UPS = 4
"""Of an object that stands alone, every fourth view is from half as far."""


def ground(up: Point) -> tuple[Point, Point]:
    """Two level directions."""
    first = np.cross(up, np.eye(3)[np.abs(up).argmin()])
    first /= np.linalg.norm(first)
    return first, np.cross(up, first)


def directions(up: Point, elevations: tuple[float, ...], azimuths: int) -> Iterator[Point]:
    """Unit vectors at these angles above the ground, degrees."""
    east, north = ground(up)
    for elevation in np.radians(elevations):
        for azimuth in np.arange(azimuths) * (2 * np.pi / azimuths):
            level = np.cos(azimuth) * east + np.sin(azimuth) * north
            yield np.cos(elevation) * level + np.sin(elevation) * up


def orbit(scene: SceneBounds, size: tuple[int, int]) -> Iterator[Camera]:
    """Looking at the middle from all sides, the nearest first."""
    width, height = size
    for radius in RADII:
        for direction in directions(scene.up, (-5, 12, 35), AZIMUTHS):
            place = scene.centre + radius * scene.radius * direction
            yield look_at(place, scene.centre, scene.up, fov=FIELD_OF_VIEW, width=width, height=height)


def inside(scene: SceneBounds, size: tuple[int, int]) -> Iterator[Camera]:
    """From places about the middle, looking around."""
    width, height = size
    east, north = ground(scene.up)
    for rise in (0.0, 0.4):
        for right, ahead in ((0, 0), (0.5, 0), (-0.5, 0), (0, 0.5), (0, -0.5)):
            place = scene.centre + scene.radius * (rise * scene.up + right * east + ahead * north)
            for direction in directions(scene.up, (-6,), WAYS_TO_LOOK):
                yield look_at(place, place + direction, scene.up, fov=FIELD_OF_VIEW, width=width, height=height)


def around(splats: Splats, scene: SceneBounds, size: tuple[int, int]) -> Iterator[Camera]:
    """Cameras around what stands alone: it fills the picture and is not cut off; and some close-ups."""
    weights = opacity(splats)
    means = splats.means.astype(np.float64)
    for number, direction in enumerate(directions(scene.up, (-10, 12, 35, 60), AZIMUTHS)):
        camera = _framed(means, weights, scene, direction, size)
        if number % CLOSE_UPS == CLOSE_UPS - 1:
            place = scene.centre + 0.5 * (camera.position - scene.centre)
            camera = look_at(place, scene.centre, scene.up, fov=FIELD_OF_VIEW, width=size[0], height=size[1])
        yield camera


def _framed(
    means: Float64[np.ndarray, "N 3"],
    weights: Float64[np.ndarray, " N"],
    scene: SceneBounds,
    direction: Point,
    size: tuple[int, int],
) -> Camera:
    """From ``direction``, so that 98 % along each axis of the picture are in it, with some air around."""
    width, height = size
    looking = look_at(scene.centre + direction, scene.centre, scene.up, fov=FIELD_OF_VIEW, width=width, height=height)
    right, down, _ = looking.viewmat[:3, :3]
    middle, half = scene.centre.copy(), []
    for axis in (right, down, direction):
        along = (means - scene.centre) @ axis
        low, high = (weighted_median(along, weights, share) for share in (0.01, 0.99))
        middle += 0.5 * (low + high) * axis
        half.append(max(0.5 * (high - low), 0.5 * scene.radius))
    sides = np.array([width, height]) / (2 * looking.K[0, 0])
    distance = max(1.15 * float((np.array(half[:2]) / sides).max()), 2 * NEAR) + half[2]
    place = middle + distance * direction
    return look_at(place, middle, scene.up, fov=FIELD_OF_VIEW, width=width, height=height)


def turned(camera: Camera) -> Camera:
    """At the same place, looking the other way."""
    viewmat = np.diag([-1.0, 1, -1, 1]) @ camera.viewmat
    return Camera(viewmat, camera.K, camera.width, camera.height)
