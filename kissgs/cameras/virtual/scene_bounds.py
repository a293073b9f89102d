"""``scene_bounds``: centre, radius and up direction of a scene, estimated from its Gaussians alone."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from kissgs.core.array_types import Float64
from kissgs.core.splats import Splats

Vec3 = Float64[np.ndarray, "3"]
"""``(3,)`` float64, a point or a direction in world space."""

UP_AXES = (np.array([0.0, -1.0, 0.0]), np.array([0.0, 0.0, 1.0]))
"""Up directions of scene files: COLMAP's y points roughly down, nerfstudio's z up. The first is the default."""


@dataclass(frozen=True, slots=True)
class SceneBounds:
    """Position, size and orientation of a scene's densest part.

    Attributes:
        centre: ``(3,)`` float64, centre of the densest part, world units.
        radius: distance from the centre within which half of the opacity of that part lies, world units.
        up: ``(3,)`` float64 unit vector.
    """

    centre: Vec3
    radius: float
    up: Vec3


def scene_bounds(splats: Splats, start: tuple[Vec3, float] | None = None) -> SceneBounds:
    """Estimate centre, radius and up direction of a scene.

    Gaussians count by their opacity, so that floaters and sky have little influence. A capture has most Gaussians where
    its photographs point. The centre is a mode of that density, found by mean shift from the weighted median of the
    positions; the bandwidth is the current radius.

    Args:
        splats: the scene, finite. Without any opacity, the result is the unit sphere around the origin.
        start: centre, ``(3,)``, and radius from which mean shift starts instead, world units.
    """
    means = splats.means.astype(np.float64)
    weights = opacity(splats)
    if not weights.sum() > 0:
        return SceneBounds(np.zeros(3), 1.0, UP_AXES[0])
    centre = np.array([weighted_quantile(axis, weights) for axis in means.T]) if start is None else start[0]
    distance = np.linalg.norm(means - centre, axis=1)
    gaussian_size = float(np.exp(np.median(splats.scales.max(axis=1)).astype(np.float64)))
    min_radius = max(2 * gaussian_size, 1e-5 * float(np.abs(centre).max()), 1e-9)  # float32 positions are no finer
    radius = max(weighted_quantile(distance, weights) if start is None else start[1], min_radius)
    for _ in range(30):
        kernel = weights * np.exp(-0.5 * (distance / radius) ** 2)
        new_centre = kernel @ means / kernel.sum()
        distance = np.linalg.norm(means - new_centre, axis=1)
        near = distance < 2.5 * radius
        new_radius = max(weighted_quantile(distance[near], weights[near]), min_radius) if near.any() else radius
        moved = np.linalg.norm(new_centre - centre)
        converged = moved < 0.01 * radius and abs(new_radius - radius) < 0.01 * radius
        centre, radius = new_centre, new_radius
        if converged:
            break
    return SceneBounds(centre, radius, _up(splats, weights * (distance < 3 * radius), means - centre))


def opacity(splats: Splats) -> Float64[np.ndarray, " N"]:
    """Return opacities after the sigmoid, ``(N,)`` float64, 0 to 1."""
    return 1 / (1 + np.exp(-splats.opacities.astype(np.float64)))


def weighted_quantile(
    values: Float64[np.ndarray, " n"], weights: Float64[np.ndarray, " n"], quantile: float = 0.5
) -> float:
    """Return the value at which the fraction ``quantile`` of the weight is reached; by default, the weighted median.

    Args:
        values: ``(n,)`` float64. Without any, the result is 0.
        weights: ``(n,)`` float64, 0 or more.
        quantile: 0 to 1.
    """
    return weighted_quantiles(values, weights, (quantile,))[0]


def weighted_quantiles(
    values: Float64[np.ndarray, " n"], weights: Float64[np.ndarray, " n"], quantiles: Sequence[float]
) -> list[float]:
    """Return the values at which several fractions of the weight are reached, see :func:`weighted_quantile`."""
    if not len(values):
        return [0.0] * len(quantiles)
    order = np.argsort(values, kind="stable")
    cumulative = np.cumsum(weights[order])
    places = np.searchsorted(cumulative, np.asarray(quantiles) * cumulative[-1])
    return [float(value) for value in values[order[np.minimum(places, len(values) - 1)]]]


def _up(splats: Splats, weights: Float64[np.ndarray, " N"], offsets: Float64[np.ndarray, "N 3"]) -> Vec3:
    """Return the up direction: the normal of the ground, or the axis that files use if there is no ground.

    The short axes of flat Gaussians are surface normals; most of them near one file axis select that axis. The sign
    follows from the skew of heights: objects stand on the ground, so that density falls off upwards.

    Args:
        splats: the scene.
        weights: ``(N,)`` float64, 0 or more; 0 for Gaussians that do not count.
        offsets: ``(N, 3)`` float64, positions relative to the centre.
    """
    axis = UP_AXES[0]
    if not weights.any():
        return axis
    log_scales = np.sort(splats.scales.astype(np.float64), axis=1)
    area = np.exp(log_scales[:, 1] + log_scales[:, 2])
    flatness = np.clip(log_scales[:, 1] - log_scales[:, 0], 0, 1)
    flat_weights = flatness * np.minimum(area, np.quantile(area, 0.95)) * weights
    normals = _short_axes(splats)
    level = [float(flat_weights @ (np.abs(normals @ each) > np.cos(np.radians(15)))) for each in UP_AXES]
    if level[1] > 2 * level[0] + 0.1 * flat_weights.sum():
        axis = UP_AXES[1]
    axis = _ground_normal(axis, normals, flat_weights)
    heights = offsets @ axis
    mean = weights @ heights / weights.sum()
    deviation = np.sqrt(weights @ (heights - mean) ** 2 / weights.sum())
    skew = weights @ ((heights - mean) / max(deviation, 1e-30)) ** 3 / weights.sum()
    return -axis if skew < -0.3 else axis


def _ground_normal(axis: Vec3, normals: Float64[np.ndarray, "N 3"], weights: Float64[np.ndarray, " N"]) -> Vec3:
    """Return the mean normal near ``axis``, or ``axis`` if less than 35 % of the weight has a normal within 30° of it.

    The cone narrows in three steps, so that walls and slopes do not tilt the result.
    """
    for degrees, min_share in ((30, 0.35), (15, 0.0), (8, 0.0)):
        cosines = normals @ axis
        near = (np.abs(cosines) > np.cos(np.radians(degrees))) * weights
        if near.sum() <= min_share * weights.sum() or not near.any():
            return axis
        mean = (near * np.sign(cosines)) @ normals
        axis = mean / np.linalg.norm(mean)
    return axis


def _short_axes(splats: Splats) -> Float64[np.ndarray, "N 3"]:
    """Return the direction of each Gaussian's smallest scale, ``(N, 3)`` float64 unit vectors."""
    w, x, y, z = splats.quats.astype(np.float64).T
    columns = np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y + w * z), 2 * (x * z - w * y)],
            [2 * (x * y - w * z), 1 - 2 * (x * x + z * z), 2 * (y * z + w * x)],
            [2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)],
        ]
    )
    shortest = splats.scales.argmin(axis=1)
    return np.asarray(columns[shortest, :, np.arange(len(splats))])
