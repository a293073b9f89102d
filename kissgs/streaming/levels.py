"""Levels of detail: the partition of a scene into chunks, and coarser levels of a chunk by merging."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from kissgs.compaction.merging import covariances_of, merged_levels
from kissgs.core.array_types import Bool, Float32, Float64, Int64
from kissgs.core.context import Progress, Workers, silent
from kissgs.core.splats import Splats, concatenate
from kissgs.rendering.camera import Camera, look_at
from kissgs.rendering.rasterizer import render


def times_to_halve(count: int, most: int) -> int:
    """Return how often ``count`` Gaussians are halved until there are at most about ``most``."""
    return max(0, int(np.ceil(np.log2(max(count, 1) / most))))


def leaf_groups(
    means: Float32[np.ndarray, "n 3"], leaf: int
) -> tuple[Int64[np.ndarray, " n"], Int64[np.ndarray, " e"]]:
    """Split a chunk into leaves of at most ``leaf`` Gaussians: indices, ascending within each leaf, and its edges."""
    from kissgs.rendering.cpu.neighbours import leaves_of

    order, edges = leaves_of(means, leaf)
    for first, last in itertools.pairwise(edges):
        order[first:last].sort()
    return order.astype(np.int64), edges


# ``level_errors``: how much the coarser levels of a leaf differ from its finest, measured in rendered images.
#
# The leaf is drawn alone. Other Gaussians in front of it could only hide differences.

SIZE = 128  # width and height of the images, pixels; the leaf fills them

DIRECTIONS = np.array([[1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0], [0, 0, 1], [0, 0, -1]], np.float64)
"""Directions from which a leaf is seen."""

DISTANCE = 4.0  # distance of the cameras, in radii of the leaf
INSIDE = 0.9  # share of a leaf's Gaussians within its radius: a few may be far away

BACKGROUND = (0.5, 0.5, 0.5)


def level_errors(levels: Sequence[Splats]) -> list[float]:
    """Return the root mean square error of each level, in units of the range of colours; that of the finest is 0. No
    level has a smaller error than a finer one, so that a smaller error never asks for a coarser level."""
    squared = np.zeros(len(levels))
    for camera in _cameras(levels[0]):
        images = [np.clip(render(level, camera, background=BACKGROUND, threads=1)[0], 0, 1) for level in levels]
        squared += [float(np.mean((image - images[0]) ** 2)) for image in images]
    errors = np.sqrt(squared / len(DIRECTIONS))
    return [round(float(error), 5) for error in np.maximum.accumulate(np.nan_to_num(errors, nan=1.0))]


def _cameras(leaf: Splats) -> list[Camera]:
    """Return cameras around the ball around the centre that holds most of the leaf, or its median Gaussian."""
    means = leaf.means.astype(np.float64)
    centre = np.median(means, axis=0)
    size = float(np.exp(np.median(leaf.scales.max(axis=1).astype(np.float64))))
    radius = max(float(np.quantile(np.linalg.norm(means - centre, axis=1), INSIDE)), 2 * size)
    fov, up = 2 * np.arctan(1 / DISTANCE), np.array([0.1, 1.0, 0.2])
    return [
        look_at(centre + DISTANCE * radius * direction, centre, up, fov=fov, width=SIZE, height=SIZE)
        for direction in DIRECTIONS
    ]


# Levels of detail of one chunk: each leaf merged to half its Gaussians, again and again.

MERGING = 0.7  # share of merging in the time for the levels of a chunk; the rest measures their errors


def chunk_levels(
    chunk: Splats, levels: int, leaf: int, threads: int, progress: Progress = silent
) -> tuple[list[Splats], dict[str, Any]]:
    """Split a chunk into leaves and merge each to half its Gaussians for every further level. Returned are the levels,
    and the counts by level, the bounds and the errors of the leaves, as JSON."""
    order, edges = leaf_groups(chunk.means, leaf)

    def leaf_levels(at: int) -> list[Splats]:
        finest = chunk.select(order[edges[at] : edges[at + 1]])
        counts = [max(1, -(-len(finest) >> level)) for level in range(1, levels)]
        return [finest, *merged_levels(finest, counts, threads=1)]

    with Workers(threads) as pool:
        numbers = range(len(edges) - 1)
        leaves = pool.map(leaf_levels, numbers, lambda fraction: progress("merge", MERGING * fraction))
        errors = pool.map(level_errors, leaves, lambda fraction: progress("merge", MERGING + (1 - MERGING) * fraction))
    counts = [[len(own[level]) for own in leaves] for level in range(levels)]
    stated = {"counts": counts, "bounds": [bounds(concatenate(own)).tolist() for own in leaves], "errors": errors}
    return [concatenate([own[level] for own in leaves]) for level in range(levels)], stated


def bounds(splats: Splats) -> Float64[np.ndarray, "2 3"]:
    """Return the corners of the box around the boxes of one standard deviation of all Gaussians."""
    covariances = np.empty((len(splats), 6))
    covariances_of(splats.quats, splats.scales, 0, len(splats), covariances)
    reach = np.sqrt(covariances[:, [0, 3, 5]])
    means = splats.means.astype(np.float64)
    return np.stack([(means - reach).min(axis=0), (means + reach).max(axis=0)])


# ``Environment``: the far surroundings of a scene, such as its sky, which are apart from the levels of detail.
#
# They look alike from everywhere in the scene, so no distance says which of their levels to draw; and they would widen
# the boxes of the leaves that they are in.

FAR = 8.0  # distance from which Gaussians belong to the environment, in units of their median distance from the centre
FEWEST, MOST = 1_000, 65_536  # Gaussians of an environment, which viewers draw always and whole
LARGEST_SHARE = 0.3  # largest share of a scene in its environment
ONE_SIDED = 0.7  # length of the mean direction from which Gaussians do not surround the scene: half a sphere has 0.5


@dataclass(frozen=True, slots=True, eq=False)
class Environment:
    """Space beyond a ball."""

    center: Float64[np.ndarray, "3"]
    radius: float

    @classmethod
    def of(cls, positions: Float32[np.ndarray, "S 3"], count: int) -> Environment:
        """Return the environment of a scene of ``count`` Gaussians, by evenly sampled positions."""
        none = cls(np.zeros(3), np.inf)
        if not len(positions):
            return none
        points = positions.astype(np.float64)
        center = np.median(points, axis=0)
        found = cls(center, FAR * float(np.median(np.linalg.norm(points - center, axis=1))))
        far = points[found.contains(positions)] - center
        estimate = len(far) / len(points) * count
        if found.radius <= 0 or not FEWEST <= estimate <= min(MOST, LARGEST_SHARE * count):
            return none
        directions = far / np.linalg.norm(far, axis=1, keepdims=True)
        return found if np.linalg.norm(directions.mean(axis=0)) < ONE_SIDED else none

    def contains(self, means: Float32[np.ndarray, "n 3"]) -> Bool[np.ndarray, " n"]:
        """Return whether each position belongs to the environment."""
        return np.linalg.norm(means.astype(np.float64) - self.center, axis=1) > self.radius
