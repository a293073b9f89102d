"""``Environment``: the far surroundings of a scene, such as its sky, which are apart from the levels of detail.

They look alike from everywhere in the scene, so no distance says which of their levels to draw; and they would widen
the boxes of the leaves that they are in.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from kissgs.core.array_types import Bool, Float32, Float64

FAR = 8.0
"""Distance from which Gaussians belong to the environment, in units of their median distance from the centre."""

FEWEST, MOST = 1_000, 65_536
"""Least and largest number of Gaussians in an environment. Viewers draw it always and whole, so it must be small."""

LARGEST_SHARE = 0.3
"""Largest share of a scene in its environment."""

ONE_SIDED = 0.7
"""Length of the mean direction of Gaussians from which they do not surround the scene. Half a sphere has 0.5."""


@dataclass(frozen=True, slots=True, eq=False)
class Environment:
    """Space beyond a ball.

    Attributes:
        center: ``(3,)`` centre of the scene, world units.
        radius: of the ball; infinite if the scene has no environment.
    """

    center: Float64[np.ndarray, "3"]
    radius: float

    @classmethod
    def of(cls, positions: Float32[np.ndarray, "S 3"], count: int) -> Environment:
        """Return the environment of a scene of ``count`` Gaussians, by evenly sampled positions."""
        none = cls(np.zeros(3), np.inf)
        if not len(positions):
            return none
        points = positions.astype(np.float64)
        found = cls(
            center := np.median(points, axis=0), FAR * float(np.median(np.linalg.norm(points - center, axis=1)))
        )
        far = points[found.contains(positions)] - center
        estimate = len(far) / len(points) * count
        if found.radius <= 0 or not FEWEST <= estimate <= min(MOST, LARGEST_SHARE * count):
            return none
        directions = far / np.linalg.norm(far, axis=1, keepdims=True)
        return found if np.linalg.norm(directions.mean(axis=0)) < ONE_SIDED else none

    def contains(self, means: Float32[np.ndarray, "n 3"]) -> Bool[np.ndarray, " n"]:
        """Return whether each position belongs to the environment."""
        return np.linalg.norm(means.astype(np.float64) - self.center, axis=1) > self.radius
