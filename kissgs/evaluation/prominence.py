"""Prominence of Gaussians, and a sampler that draws them by it so that every part of a scene is considered."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from kissgs.core.array_types import Float64, Int
from kissgs.core.splats import Splats
from kissgs.rendering.constants import ALPHA_MIN

MORTON_BITS = 21
"""Bits per axis of a Morton code: as many as 64 bits hold."""

NEIGHBOURS = 64
"""Number of Gaussians, consecutive in Morton order, that form a neighbourhood."""

FAIRNESS = 0.25
"""Exponent of prominence when octree cells share a probability: 1 is proportional, 0 gives all cells the same."""


def drawn_opacities(splats: Splats) -> Float64[np.ndarray, " N"]:
    """Return opacities from 0 to 1; 0 for Gaussians that no renderer draws."""
    opacities = 1 / (1 + np.exp(-splats.opacities.astype(np.float64)))
    return np.where(opacities > ALPHA_MIN, opacities, 0.0)


def prominence(splats: Splats) -> Float64[np.ndarray, " N"]:
    """Return the prominence of each Gaussian, ``(N,)``, 0 to 1: opacity times its area relative to its neighbourhood.

    The relative area is a / (a + median of the neighbourhood). So the details of a small object count as much as the
    large Gaussians of a background, and one immense Gaussian at most twice as much as an ordinary one.
    """
    weights = np.zeros(len(splats))
    opacities = drawn_opacities(splats)
    visible = np.flatnonzero(opacities > 0)
    if len(visible):
        visible = visible[np.argsort(morton_codes(splats.means[visible].astype(np.float64)), kind="stable")]
        axes = np.sort(splats.scales[visible].astype(np.float64), axis=1)
        areas = np.exp(axes[:, 1] + axes[:, 2])
        blocks = np.pad(areas, (0, -len(areas) % NEIGHBOURS), mode="edge").reshape(-1, NEIGHBOURS)
        medians = np.repeat(np.median(blocks, axis=1), NEIGHBOURS)[: len(areas)]
        weights[visible] = opacities[visible] * areas / (areas + medians)
    return weights


def mahalanobis_distances(splats: Splats, point: Float64[np.ndarray, "3"]) -> Float64[np.ndarray, " N"]:
    """Return the Mahalanobis distance of a point to each Gaussian: the distance in its standard deviations."""
    offsets = point - splats.means.astype(np.float64)
    w, axis = splats.quats[:, :1].astype(np.float64), -splats.quats[:, 1:].astype(np.float64)
    rotated = offsets + 2 * np.cross(axis, np.cross(axis, offsets) + w * offsets)
    return np.asarray(np.linalg.norm(rotated * np.exp(-splats.scales.astype(np.float64)), axis=1))


@dataclass(frozen=True, slots=True, eq=False)
class GaussianSampler:
    """Maps numbers from 0 to 1 to Gaussians; near numbers give Gaussians near to each other.

    Attributes:
        order: ``(N,)`` Gaussians in Morton order.
        cumulative: ``(N,)`` cumulative probabilities in that order.
    """

    order: Int[np.ndarray, " N"]
    cumulative: Float64[np.ndarray, " N"]

    @classmethod
    def of(cls, means: Float64[np.ndarray, "N 3"], weights: Float64[np.ndarray, " N"]) -> GaussianSampler:
        """Return a sampler whose probabilities are half proportional to the weights and half shared fairly in space.

        The fair half is shared in an octree: the children of a cell get parts of its probability in proportion to the
        fourth roots of their weights. So a small isolated cluster is not missed beside a large one, nor a large one
        beside a few outliers.

        Args:
            means: ``(N, 3)`` positions of one or more Gaussians.
            weights: ``(N,)`` at least 0, not all 0.
        """
        codes = morton_codes(means)
        order = np.argsort(codes, kind="stable")
        sorted_weights = weights[order] / weights.sum()
        fair = _fair_probabilities(codes[order], sorted_weights)
        cumulative = np.cumsum(0.5 * sorted_weights + 0.5 * fair)
        return cls(order, cumulative / cumulative[-1])

    def at(self, number: float) -> int:
        """Return the index of the Gaussian at this quantile, a number from 0 to 1."""
        rank = int(np.searchsorted(self.cumulative, number, side="right"))
        return int(self.order[min(rank, len(self.order) - 1)])


def _fair_probabilities(codes: Int[np.ndarray, " N"], weights: Float64[np.ndarray, " N"]) -> Float64[np.ndarray, " N"]:
    """Return the probabilities of the fair half; Gaussians are in the order of their Morton codes."""
    cells, leaf = np.unique(codes, return_inverse=True)
    levels = [np.bincount(leaf, weights)]
    parents = [leaf]
    while len(cells) > 1:
        cells, parent = np.unique(cells >> 3, return_inverse=True)
        levels.append(np.bincount(parent, levels[-1]))
        parents.append(parent)
    probabilities = np.ones(1)
    for parent, cell_weights in zip(parents[:0:-1], levels[-2::-1], strict=True):
        shares = cell_weights**FAIRNESS
        probabilities = probabilities[parent] * shares / np.maximum(np.bincount(parent, shares), 1e-300)[parent]
    return np.asarray(probabilities[leaf] * weights / np.maximum(levels[0], 1e-300)[leaf])


def morton_codes(means: Float64[np.ndarray, "N 3"]) -> Int[np.ndarray, " N"]:
    """Return Morton codes, ``(N,)``: positions along a space-filling curve, the interleaved bits of the coordinates."""
    low = means.min(axis=0)
    extent = max(float((means.max(axis=0) - low).max()), 1e-300)
    steps = np.minimum((means - low) / extent * 2**MORTON_BITS, 2**MORTON_BITS - 1).astype(np.int64)
    codes = np.zeros(len(means), np.int64)
    for axis in range(3):
        codes |= _spread_bits(steps[:, axis]) << axis
    return codes


def _spread_bits(values: Int[np.ndarray, " N"]) -> Int[np.ndarray, " N"]:
    """Insert two zeros before each of the lowest 21 bits."""
    for shift, mask in (
        (32, 0x1F00000000FFFF),
        (16, 0x1F0000FF0000FF),
        (8, 0x100F00F00F00F00F),
        (4, 0x10C30C30C30C30C3),
        (2, 0x1249249249249249),
    ):
        values = (values | (values << shift)) & mask
    return values
