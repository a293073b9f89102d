"""What each Gaussian of a scene can show, and how often to look at it so that every part of the scene gets its turn."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from kissgs.core.array_types import Float64, Int
from kissgs.core.splats import Splats
from kissgs.rendering.constants import ALPHA_MIN

LEVELS = 21
"""Halvings of the scene's extent along each axis: as many as 64 bits hold."""

NEIGHBOURS = 64
"""Gaussians that count as a neighbourhood."""

FAIRNESS = 0.25
"""Exponent of what a part of the scene can show, where parts compete: 1 gives each its due, 0 all parts the same."""


def opacity(splats: Splats) -> Float64[np.ndarray, " N"]:
    """Opacities from 0 to 1; 0 for those that no renderer draws."""
    opacities = 1 / (1 + np.exp(-splats.opacities.astype(np.float64)))
    return np.where(opacities > ALPHA_MIN, opacities, 0.0)


def prominence(splats: Splats) -> Float64[np.ndarray, " N"]:
    """Opacity times area relative to the neighbourhood: what each Gaussian can show of its surroundings, from 0 to 1.

    The area counts as a / (a + median of its neighbourhood). So the details of a small object count as much as the
    large Gaussians of a background, and one immense Gaussian for no more than two.
    """
    weights = np.zeros(len(splats))
    opacities = opacity(splats)
    visible = np.flatnonzero(opacities > 0)
    if len(visible):
        visible = visible[np.argsort(morton_codes(splats.means[visible].astype(np.float64)), kind="stable")]
        axes = np.sort(splats.scales[visible].astype(np.float64), axis=1)
        areas = np.exp(axes[:, 1] + axes[:, 2])
        blocks = np.pad(areas, (0, -len(areas) % NEIGHBOURS), mode="edge").reshape(-1, NEIGHBOURS)
        usual = np.repeat(np.median(blocks, axis=1), NEIGHBOURS)[: len(areas)]
        weights[visible] = opacities[visible] * areas / (areas + usual)
    return weights


def distances(splats: Splats, place: Float64[np.ndarray, "3"]) -> Float64[np.ndarray, " N"]:
    """From the middle of each Gaussian, in its standard deviations along that direction (Mahalanobis)."""
    away = place - splats.means.astype(np.float64)
    w, axis = splats.quats[:, :1].astype(np.float64), -splats.quats[:, 1:].astype(np.float64)
    turned = away + 2 * np.cross(axis, np.cross(axis, away) + w * away)
    return np.asarray(np.linalg.norm(turned * np.exp(-splats.scales.astype(np.float64)), axis=1))


@dataclass(frozen=True, slots=True, eq=False)
class GaussianSampler:
    """Chooses Gaussians by numbers from 0 to 1: numbers near to each other choose Gaussians near to each other.

    Attributes:
        order: ``(N,)`` Gaussians along a space-filling curve.
        until: ``(N,)`` sums of their chances up to and including each.
    """

    order: Int[np.ndarray, " N"]
    until: Float64[np.ndarray, " N"]

    @classmethod
    def of(cls, means: Float64[np.ndarray, "N 3"], weights: Float64[np.ndarray, " N"]) -> GaussianSampler:
        """Chances of one or more Gaussians: half by their weights, half by the parts of the scene they belong to.

        The scene's cube is halved along each axis, again and again. The parts of a cube share its chances by the
        fourth root of their weights, so that a small cluster that stands alone is not left out beside a large one, nor
        a large one beside a few outliers.

        Args:
            means: positions.
            weights: not negative, not all 0.
        """
        codes = morton_codes(means)
        order = np.argsort(codes, kind="stable")
        sorted_weights = weights[order] / weights.sum()
        fair = _fair_chances(codes[order], sorted_weights)
        until = np.cumsum(0.5 * sorted_weights + 0.5 * fair)
        return cls(order, until / until[-1])

    def at(self, number: float) -> int:
        """The Gaussian that ``number``, from 0 to 1, stands for."""
        place = int(np.searchsorted(self.until, number, side="right"))
        return int(self.order[min(place, len(self.order) - 1)])


def _fair_chances(codes: Int[np.ndarray, " N"], weights: Float64[np.ndarray, " N"]) -> Float64[np.ndarray, " N"]:
    """Chances by the parts of the scene alone; Gaussians are in the order of their codes."""
    parts, of_part = np.unique(codes, return_inverse=True)
    levels = [np.bincount(of_part, weights)]
    parents = [of_part]
    while len(parts) > 1:
        parts, parent = np.unique(parts >> 3, return_inverse=True)
        levels.append(np.bincount(parent, levels[-1]))
        parents.append(parent)
    chances = np.ones(1)
    for parent, part_weights in zip(parents[:0:-1], levels[-2::-1], strict=True):
        claims = part_weights**FAIRNESS
        chances = chances[parent] * claims / np.maximum(np.bincount(parent, claims), 1e-300)[parent]
    leaf = parents[0]
    return np.asarray(chances[leaf] * weights / np.maximum(levels[0], 1e-300)[leaf])


def morton_codes(means: Float64[np.ndarray, "N 3"]) -> Int[np.ndarray, " N"]:
    """Places along a space-filling curve: the bits of the coordinates, interleaved (Morton)."""
    low = means.min(axis=0)
    extent = max(float((means.max(axis=0) - low).max()), 1e-300)
    steps = np.minimum((means - low) / extent * 2**LEVELS, 2**LEVELS - 1).astype(np.int64)
    codes = np.zeros(len(means), np.int64)
    for axis in range(3):
        codes |= _spread_bits(steps[:, axis]) << axis
    return codes


def _spread_bits(values: Int[np.ndarray, " N"]) -> Int[np.ndarray, " N"]:
    """Two zeros before each of the lowest 21 bits."""
    for shift, mask in (
        (32, 0x1F00000000FFFF),
        (16, 0x1F0000FF0000FF),
        (8, 0x100F00F00F00F00F),
        (4, 0x10C30C30C30C30C3),
        (2, 0x1249249249249249),
    ):
        values = (values | (values << shift)) & mask
    return values
