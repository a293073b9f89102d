"""Candidate cameras: on orbits around a scene, inside it, or framing an object that stands alone."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from kissgs.cameras.virtual.scene_bounds import SceneBounds, Vec3, opacity, weighted_quantiles
from kissgs.core.array_types import Float64
from kissgs.core.splats import Splats
from kissgs.rendering.camera import Camera, look_at
from kissgs.rendering.constants import NEAR

FIELD_OF_VIEW = np.radians(60)
"""Angle of view along the longer side, radians; roughly that of a phone."""

AZIMUTHS = 16
"""Number of azimuths on each orbit."""

ORBIT_RADII = (0.7, 1.1, 1.7, 2.6)
"""Radii of the orbits, in radii of the scene."""

ORBIT_ELEVATIONS = (-5, 12, 35)
"""Elevations of the orbits as seen from the centre, degrees."""

OBJECT_ELEVATIONS = (-10, 12, 35, 60)
"""Elevations of the cameras around an object, degrees."""

INSIDE_DIRECTIONS = 8
"""Number of viewing directions from each position inside the scene."""

CLOSE_UP_INTERVAL = 4
"""One in this many cameras around an object is at half the distance."""


def horizontal_axes(up: Vec3) -> tuple[Vec3, Vec3]:
    """Return two horizontal unit vectors, orthogonal to each other and to the unit vector ``up``; ``(3,)`` each."""
    first = np.cross(up, np.eye(3)[np.abs(up).argmin()])
    first /= np.linalg.norm(first)
    return first, np.cross(up, first)


def directions(up: Vec3, elevations: tuple[float, ...], azimuths: int) -> Iterator[Vec3]:
    """Yield ``(3,)`` float64 unit vectors at evenly spaced azimuths.

    Args:
        up: ``(3,)`` unit vector.
        elevations: angles above the horizontal plane, degrees.
        azimuths: number of azimuths for each elevation.
    """
    east, north = horizontal_axes(up)
    for elevation in np.radians(elevations):
        for azimuth in np.arange(azimuths) * (2 * np.pi / azimuths):
            horizontal = np.cos(azimuth) * east + np.sin(azimuth) * north
            yield np.cos(elevation) * horizontal + np.sin(elevation) * up


def orbit_cameras(bounds: SceneBounds, size: tuple[int, int]) -> Iterator[Camera]:
    """Yield cameras that look at the centre from all sides, nearest first; ``size`` is (width, height), pixels."""
    width, height = size
    for radius in ORBIT_RADII:
        for direction in directions(bounds.up, ORBIT_ELEVATIONS, AZIMUTHS):
            position = bounds.centre + radius * bounds.radius * direction
            yield look_at(position, bounds.centre, bounds.up, fov=FIELD_OF_VIEW, width=width, height=height)


def inside_cameras(bounds: SceneBounds, size: tuple[int, int]) -> Iterator[Camera]:
    """Yield cameras near the centre, in all horizontal directions; ``size`` is (width, height), pixels.

    Cameras at the same position follow each other, :data:`INSIDE_DIRECTIONS` of them.
    """
    width, height = size
    east, north = horizontal_axes(bounds.up)
    for rise in (0.0, 0.4):
        for right, ahead in ((0, 0), (0.5, 0), (-0.5, 0), (0, 0.5), (0, -0.5)):
            position = bounds.centre + bounds.radius * (rise * bounds.up + right * east + ahead * north)
            for direction in directions(bounds.up, (-6,), INSIDE_DIRECTIONS):
                yield look_at(position, position + direction, bounds.up, fov=FIELD_OF_VIEW, width=width, height=height)


def object_cameras(splats: Splats, bounds: SceneBounds, size: tuple[int, int]) -> Iterator[Camera]:
    """Yield cameras around an object that stands alone.

    Most frame the whole object; one in :data:`CLOSE_UP_INTERVAL` is at half the distance.

    Args:
        splats: the scene, finite.
        bounds: bounds of the object.
        size: (width, height) of the images, pixels.
    """
    weights = opacity(splats)
    means = splats.means.astype(np.float64)
    width, height = size
    for number, direction in enumerate(directions(bounds.up, OBJECT_ELEVATIONS, AZIMUTHS)):
        camera = _framing_camera(means, weights, bounds, direction, size)
        if number % CLOSE_UP_INTERVAL == CLOSE_UP_INTERVAL - 1:
            position = bounds.centre + 0.5 * (camera.position - bounds.centre)
            camera = look_at(position, bounds.centre, bounds.up, fov=FIELD_OF_VIEW, width=width, height=height)
        yield camera


def _framing_camera(
    means: Float64[np.ndarray, "N 3"],
    weights: Float64[np.ndarray, " N"],
    bounds: SceneBounds,
    direction: Vec3,
    size: tuple[int, int],
) -> Camera:
    """Return a camera in ``direction`` that frames 98 % of the weight along each image axis, with a 15 % margin."""
    width, height = size
    towards = look_at(
        bounds.centre + direction, bounds.centre, bounds.up, fov=FIELD_OF_VIEW, width=width, height=height
    )
    right, down, _ = towards.viewmat[:3, :3]
    target, half_extents = bounds.centre.copy(), []
    for axis in (right, down, direction):
        along = (means - bounds.centre) @ axis
        low, high = weighted_quantiles(along, weights, (0.01, 0.99))
        target += 0.5 * (low + high) * axis
        half_extents.append(max(0.5 * (high - low), 0.5 * bounds.radius))
    slopes = np.array([width, height]) / (2 * towards.K[0, 0])  # tangents of half the angles of view
    distance = max(1.15 * float((np.array(half_extents[:2]) / slopes).max()), 2 * NEAR) + half_extents[2]
    position = target + distance * direction
    return look_at(position, target, bounds.up, fov=FIELD_OF_VIEW, width=width, height=height)


def reversed_camera(camera: Camera) -> Camera:
    """Return the camera at the same position that looks in the opposite direction."""
    viewmat = np.diag([-1.0, 1, -1, 1]) @ camera.viewmat
    return Camera(viewmat, camera.K, camera.width, camera.height)
