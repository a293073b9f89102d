"""What can be told of a scene from its Gaussians alone: where its middle is, how large it is, which way is up."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from kissgs.core.array_types import Float64
from kissgs.core.splats import Splats

Point = Float64[np.ndarray, "3"]

UP_OF_FILES = (np.array([0.0, -1.0, 0.0]), np.array([0.0, 0.0, 1.0]))
"""COLMAP's worlds have y down, more or less; nerfstudio's z up. Where nothing speaks for another, it is the first."""


@dataclass(frozen=True, slots=True)
class SceneBounds:
    """Where what matters is.

    Attributes:
        centre: of the densest part.
        radius: half of what belongs to that part lies within it.
        up: unit vector.
    """

    centre: Point
    radius: float
    up: Point


def scene_bounds(splats: Splats, start: tuple[Point, float] | None = None) -> SceneBounds:
    """Middle, size and up of a scene; Gaussians count by their opacity, so floaters and sky hardly do.

    A capture's attention shows in the density of Gaussians: the middle is found by climbing it (mean shift) from the
    median, at a scale that follows what is found.

    Args:
        splats: finite.
        start: place and radius from which to climb in place of the median's.
    """
    means = splats.means.astype(np.float64)
    weights = opacity(splats)
    if not weights.sum() > 0:
        return SceneBounds(np.zeros(3), 1.0, UP_OF_FILES[0])
    centre = np.array([weighted_median(axis, weights) for axis in means.T]) if start is None else start[0]
    distance = np.linalg.norm(means - centre, axis=1)
    size = float(np.exp(np.median(splats.scales.max(axis=1)).astype(np.float64)))
    smallest = max(2 * size, 1e-5 * float(np.abs(centre).max()), 1e-9)  # float32 positions are no finer
    radius = max(weighted_median(distance, weights) if start is None else start[1], smallest)
    for _ in range(30):
        pull = weights * np.exp(-0.5 * (distance / radius) ** 2)
        moved = pull @ means / pull.sum()
        distance = np.linalg.norm(means - moved, axis=1)
        near = distance < 2.5 * radius
        shrunk = max(weighted_median(distance[near], weights[near]), smallest) if near.any() else radius
        still = np.linalg.norm(moved - centre) < 0.01 * radius and abs(shrunk - radius) < 0.01 * radius
        centre, radius = moved, shrunk
        if still:
            break
    return SceneBounds(centre, radius, _up(splats, weights * (distance < 3 * radius), means - centre))


def opacity(splats: Splats) -> Float64[np.ndarray, " N"]:
    """Opacities from 0 to 1."""
    return 1 / (1 + np.exp(-splats.opacities.astype(np.float64)))


def weighted_median(values: Float64[np.ndarray, " n"], weights: Float64[np.ndarray, " n"], share: float = 0.5) -> float:
    """The value below which ``share`` of the weight lies; 0 for no values."""
    if not len(values):
        return 0.0
    order = np.argsort(values, kind="stable")
    total = np.cumsum(weights[order])
    return float(values[order][min(np.searchsorted(total, share * total[-1]), len(values) - 1)])


def _up(splats: Splats, weights: Float64[np.ndarray, " N"], offsets: Float64[np.ndarray, "N 3"]) -> Point:
    """Along the axis that files use for it; tilted to the ground's normal if there is a ground.

    Flat Gaussians lie on surfaces, and their normals tell those that lie level. Which end is up: things stand on the
    ground, dense below and thinning out above.
    """
    axis = UP_OF_FILES[0]
    if not weights.any():
        return axis
    spread = np.sort(splats.scales.astype(np.float64), axis=1)
    area = np.exp(spread[:, 1] + spread[:, 2])
    flat = np.clip(spread[:, 1] - spread[:, 0], 0, 1) * np.minimum(area, np.quantile(area, 0.95)) * weights
    normals = _thin_axes(splats)
    level = [float(flat @ (np.abs(normals @ candidate) > np.cos(np.radians(15)))) for candidate in UP_OF_FILES]
    if level[1] > 2 * level[0] + 0.1 * flat.sum():
        axis = UP_OF_FILES[1]
    axis = _tilted(axis, normals, flat)
    heights = offsets @ axis
    mean = weights @ heights / weights.sum()
    deviation = np.sqrt(weights @ (heights - mean) ** 2 / weights.sum())
    skew = weights @ ((heights - mean) / max(deviation, 1e-30)) ** 3 / weights.sum()
    return -axis if skew < -0.3 else axis


def _tilted(axis: Point, normals: Float64[np.ndarray, "N 3"], weights: Float64[np.ndarray, " N"]) -> Point:
    """The ground's normal if most surfaces within 30° of ``axis`` agree on one, else ``axis``."""
    for narrow, share in ((30, 0.35), (15, 0.0), (8, 0.0)):
        along = normals @ axis
        near = (np.abs(along) > np.cos(np.radians(narrow))) * weights
        if near.sum() <= share * weights.sum() or not near.any():
            return axis
        mean = (near * np.sign(along)) @ normals
        axis = mean / np.linalg.norm(mean)
    return axis


def _thin_axes(splats: Splats) -> Float64[np.ndarray, "N 3"]:
    """The direction in which each Gaussian is thinnest."""
    w, x, y, z = splats.quats.astype(np.float64).T
    columns = np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y + w * z), 2 * (x * z - w * y)],
            [2 * (x * y - w * z), 1 - 2 * (x * x + z * z), 2 * (y * z + w * x)],
            [2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)],
        ]
    )
    thinnest = splats.scales.argmin(axis=1)
    return np.asarray(columns[thinnest, :, np.arange(len(splats))])
