"""Costs of errors of each Gaussian, its sensitivity class, and optimal quantisation steps by lambda."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np

from kissgs.core.array_types import Bool, Float32, Float64, Int, Integer, UInt8, UInt64
from kissgs.core.resources import Workers
from kissgs.core.sensitivity import OPACITY, ROTATION, SCALES, Sensitivity
from kissgs.core.splats import Splats
from kissgs.planning.quantize import Computed, Rows, for_each_block, sorted_order

FLOOR = 1e-3  # smallest sensitivity, in units of the median, so that Gaussians that no camera saw keep a bounded error
MIX = np.uint64(0x9E3779B97F4A7C15)  # odd multiplier with random bits, for a hash of positions
SEEN = 0.1  # coverage below which a Gaussian counts as unseen: no camera saw it, or only from far away
MAX_PRUNED = 0.5  # share of pruned Gaussians: each removal uncovers others, so scores hold for some


@dataclass(frozen=True, slots=True, eq=False)
class Costs:
    """Squared image error per squared unit of each attribute, ``(M,)`` each; means over channels."""

    opacity: Float64[np.ndarray, " M"]  # for the opacity logit
    scale: Float64[np.ndarray, " M"]  # for a log-scale
    rotation: Float64[np.ndarray, " M"]  # for a rotation about one of the Gaussian's own axes, radians
    color: Float64[np.ndarray, " M"]  # for a coefficient of ``sh0``
    position: Float64[np.ndarray, " M"]  # for the signed logarithm of a coordinate
    removal: Float64[np.ndarray, " M"]  # squared image error of removing the Gaussian
    coverage: Float64[np.ndarray, " M"]  # from 0, unseen, to 1, seen from nearby

    @classmethod
    def of(cls, sensitivity: Sensitivity, splats: Splats, pool: Workers | None = None) -> Costs:
        """Return the costs of all Gaussians; those of attributes are at least :data:`FLOOR` of their median."""
        found = cls(**{name: np.empty(len(splats)) for name in cls.__slots__})

        def measure(rows: slice) -> None:
            some, scene = _rows_of(sensitivity, rows), splats.select(rows)
            factor = (1 + np.abs(scene.means).astype(np.float64)) ** 2
            found.opacity[rows] = some.diagonal(OPACITY)[:, 0]
            found.scale[rows] = some.diagonal(SCALES).mean(axis=1)
            found.rotation[rows] = some.diagonal(ROTATION).mean(axis=1)
            found.color[rows] = some.base_colors()
            found.position[rows] = (some.position_hessian * factor).mean(axis=1)
            found.removal[rows], found.coverage[rows] = some.removal(scene), some.coverage

        for_each_block(len(splats), measure, pool)
        for cost in (found.opacity, found.scale, found.rotation, found.color, found.position):
            seen = cost[cost > 0]
            floor = max(FLOOR * float(np.median(seen, overwrite_input=True)), 1e-30) if len(seen) else 1e-30
            np.maximum(cost, floor, out=cost)
        return found

    def take(self, chosen: Int[np.ndarray, " k"]) -> Costs:
        """Return the costs of the Gaussians ``chosen``."""
        return Costs(**{name: getattr(self, name).take(chosen) for name in Costs.__slots__})

    def of_rounding(self) -> Costs:
        """Return the costs with zeros, which take no memory, for those that only pruning needs."""
        nothing = np.broadcast_to(0.0, self.color.shape)
        return replace(self, removal=nothing, coverage=nothing)

    def keep(self, chosen: Int[np.ndarray, " k"]) -> Costs:
        """Return the costs of the Gaussians ``chosen``, ascending, in the memory of these, which are overwritten."""
        for name in Costs.__slots__:
            values = getattr(self, name)
            values[: len(chosen)] = values.take(chosen)
        return Costs(**{name: getattr(self, name)[: len(chosen)] for name in Costs.__slots__})

    def classes(self, number: int, means: Float32[np.ndarray, "M 3"] | Rows) -> UInt8[np.ndarray, " M"]:
        """Return the sensitivity class of each Gaussian, from 0, the most sensitive; classes have similar sizes.
        Gaussians of equal ``means`` are in one class: renderers blend them in stored order, which is by class. No class
        number below the largest is unused."""
        count = len(means)
        each = min(number, count)
        classes = np.empty(count, np.uint8)
        order = sorted_order(self._worth_keys())
        for label in range(each):  # class = rank · number / count, rounded down
            classes[order[-(-count * label // each) : -(-count * (label + 1) // each)]] = label
        del order
        _join_equal(_position_keys(means), classes)
        used = np.flatnonzero(np.bincount(classes, minlength=1))
        return np.searchsorted(used, np.arange(256)).astype(np.uint8)[classes]

    def _worth_keys(self) -> UInt64[np.ndarray, " M"]:
        """Return numbers by which Gaussians are ordered, the most sensitive first: bits of float64 that sort alike."""
        keys = np.empty(len(self.scale), np.uint64)

        def write(rows: slice) -> None:
            worth = np.log(self.scale[rows]) + np.log(self.rotation[rows]) + np.log(self.color[rows])
            bits = (0.0 - worth).view(np.uint64)
            keys[rows] = np.where(bits >> np.uint64(63), ~bits, bits | np.uint64(1 << 63))

        for_each_block(len(keys), write)
        return keys

    def pruned_by_rd(
        self, rd_lambda: float, threshold_bits: float, default_lambda: float | None = None
    ) -> Bool[np.ndarray, " M"]:
        """Return which Gaussians' removal costs less than ``threshold_bits``; at most :data:`MAX_PRUNED` of all. For
        Gaussians that no camera saw from nearby, only the excess over the lambda of the default quality counts, so that
        up to it all of them are kept."""
        unseen = 0.0 if default_lambda is None else min(default_lambda, rd_lambda) * (self.coverage < SEEN)
        pruned = self.removal < threshold_bits * (rd_lambda - unseen)
        most = int(MAX_PRUNED * len(pruned))
        if int(pruned.sum()) > most:
            pruned[np.argsort(np.where(pruned, self.removal, np.inf), kind="stable")[most:]] = False
        return pruned


def _rows_of(sensitivity: Sensitivity, rows: slice) -> Sensitivity:
    """Return the sensitivity of some Gaussians, without a copy."""
    values: dict[str, Any] = {field.name: getattr(sensitivity, field.name) for field in fields(sensitivity)}
    values |= {name: each[rows] for name, each in values.items() if isinstance(each, np.ndarray)}
    return Sensitivity(**values)


def _position_keys(means: Float32[np.ndarray, "M 3"] | Rows) -> UInt64[np.ndarray, " M"]:
    """Return a hash of each position."""
    keys = np.zeros(len(means), np.uint64)

    def mix(rows: slice) -> None:
        for axis in (means[rows] + np.float32(0)).view(np.uint32).T:
            keys[rows] = (keys[rows] ^ axis) * MIX

    for_each_block(len(means), mix)
    return keys


def _join_equal(key: UInt64[np.ndarray, " M"], classes: UInt8[np.ndarray, " M"]) -> None:
    """Give all Gaussians of an equal ``key`` the smallest of their classes; the keys are sorted."""
    order = sorted_order(key)
    equal = np.flatnonzero(key[1:] == key[:-1])
    if len(equal) == 0:
        return
    rows = np.unique(np.concatenate([equal, equal + 1]))
    group = np.concatenate([[0], np.cumsum(key[rows[1:]] != key[rows[:-1]])])
    smallest = np.full(int(group[-1]) + 1, 255, np.uint8)
    np.minimum.at(smallest, group, classes[order[rows]])
    classes[order[rows]] = smallest[group]


# Optimal quantisation steps by lambda, for each class of Gaussians.
#
# lambda is squared image error per bit (:class:`kissgs.Sensitivity` measures the error). Rounding to a step d costs
# H d²/12, and halving d costs one bit, so the optimum for any attribute is d² = 6 lambda / (ln 2 H). Each sensitivity
# class has its own step, a multiple of the finest class's, so that the decoder needs no classes. WebP's entropy codes,
# which vary over an image, spend no bits on a class's unused levels.

ROUNDED = ("opacity", "scale", "rotation", "color", "position")  # attributes of Costs that are rounded to steps


def step(cost: float, rd_lambda: float) -> float:
    """Return the optimal quantisation step for a squared error of ``cost`` per squared unit."""
    return float(np.sqrt(6 * rd_lambda / (np.log(2) * cost)))


@dataclass(frozen=True, slots=True, eq=False)
class RdCriterion:
    """Steps, sensitivity classes and lambda, by which the levels of Gaussians are chosen."""

    rd_lambda: float
    classes: Integer[np.ndarray, " M"]  # sensitivity class of each, from 0; no class is empty
    steps: Mapping[str, list[float]]  # optimal step of each class, by attribute
    least: Mapping[str, float]  # smallest cost, by attribute
    costs: Costs | None  # None where nothing needs them any more

    @classmethod
    def of(cls, costs: Costs, classes: Integer[np.ndarray, " M"], rd_lambda: float, *, keep: bool) -> RdCriterion:
        """Return the criterion of these costs, with or without the costs themselves."""
        steps, least = {}, {}
        for name in ROUNDED:
            cost, channels = getattr(costs, name), 3 if name == "rotation" else 1  # an error about each of three axes
            means = ((channels * cost[classes == c]).mean() for c in range(int(classes.max()) + 1))
            steps[name] = [step(float(mean), rd_lambda) for mean in means]
            least[name] = float(cost.min(initial=np.inf))
        return cls(rd_lambda, classes, steps, least, costs if keep else None)

    def take(self, order: Int[np.ndarray, " M"]) -> RdCriterion:
        """Return the criterion with the Gaussians in another order."""
        costs = None if self.costs is None else self.costs.take(order)
        return replace(self, costs=costs, classes=self.classes.take(order))

    def each_step(self, name: str, coarsest: Float64[np.ndarray, " M"] | Rows) -> Computed:
        """Return the step of an attribute of each Gaussian: the best one of its class, at most ``coarsest``."""
        best = np.array(self.steps[name])
        return Computed(len(self.classes), lambda rows: np.minimum(best[self.classes[rows]], coarsest[rows]))
