"""Rate-distortion model: lambda, quantisation steps, codebook size and pruning.

lambda is squared image error per bit (:class:`kissgs.Sensitivity` measures the error). Rounding to a step d costs
H d²/12, and halving d costs one bit, so the optimum for any attribute is d² = 6 lambda / (ln 2 H). Gaussians are
ordered in classes of similar sensitivity, and each class has its own step, a multiple of the finest class's, so that
the decoder needs no classes. WebP's entropy codes, which vary over an image, spend no bits on a class's unused levels.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np

from kissgs.core.array_types import Bool, Float32, Float64, Int, Integer, UInt8, UInt64
from kissgs.core.sensitivity import OPACITY, ROTATION, SCALES, Sensitivity
from kissgs.core.signed_log import signed_log
from kissgs.core.splats import Splats
from kissgs.core.threads import Workers
from kissgs.planning.quantize import means_bits
from kissgs.planning.rows import Rows, for_each_block, row_range, selected, sorted_order
from kissgs.settings import EncodeSettings

FLOOR = 1e-3
"""Smallest sensitivity, in units of the median, so that Gaussians that no camera saw keep a bounded error."""

SH_SHRINK = 0.42
"""Exponent s of the codebook's error ~ entries^-s, measured on real scenes with 1,000 to 10,000 entries."""

ENTRY_BITS = 112
"""Bits per entry in the codebook's image, measured at 45 dimensions."""

LABEL_SHARE = 0.5
"""Bits per label for each bit of the codebook's size: less than 1, because frequent entries take fewer bits."""

QUICK = 1 << 13
"""Number of codebook entries that k-means finds in a few seconds."""

FEW = 64
"""Number of codebook entries that any scene may have: they take about 1 kB, and SOG-XT has no fewer."""

DIMENSIONS = 14
"""Rounded degrees of freedom per Gaussian: opacity, scales, rotation, base colour, position."""

GROWTH = 2.2
"""Measured ratio of the rounding error to H d²/12: above 1 because RDO quantisation prefers levels of few bits, and the
errors of several Gaussians add up in a pixel."""

SH_MEAN_SQUARE = 0.0796
"""Mean square of a spherical harmonic over all directions, 1 / (4 pi)."""

PAPER_RATIO = 8
"""Gaussians per codebook entry of the paper."""

PAPER_SH_GROWTH = 2.0
"""Measured factor on uncompensated shN errors, which add up in pixels."""


@dataclass(frozen=True, slots=True, eq=False)
class Costs:
    """Squared image error per squared unit of each attribute, ``(M,)`` each; means over channels.

    Attributes:
        opacity: for the opacity logit.
        scale: for a log-scale.
        rotation: for a rotation about one of the Gaussian's own axes, radians.
        color: for a coefficient of ``sh0``.
        position: for the signed logarithm of a coordinate.
        removal: squared image error of removing the Gaussian.
        coverage: from 0, unseen, to 1, seen from nearby.
    """

    opacity: Float64[np.ndarray, " M"]
    scale: Float64[np.ndarray, " M"]
    rotation: Float64[np.ndarray, " M"]
    color: Float64[np.ndarray, " M"]
    position: Float64[np.ndarray, " M"]
    removal: Float64[np.ndarray, " M"]
    coverage: Float64[np.ndarray, " M"]

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
            _raise_to_floor(cost)
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
        number below the largest is unused.
        """
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
        """Return which Gaussians' removal costs less than ``threshold_bits``; at most :data:`MAX_PRUNED` of all.

        Args:
            rd_lambda: squared error per bit.
            threshold_bits: largest number of bits that a removal may cost.
            default_lambda: lambda of the default quality. For Gaussians that no camera saw from nearby, only the excess
                of ``rd_lambda`` over it counts, so that up to it all of them are kept. None treats all alike.
        """
        unseen = 0.0 if default_lambda is None else min(default_lambda, rd_lambda) * (self.coverage < SEEN)
        pruned = self.removal < threshold_bits * (rd_lambda - unseen)
        most = int(MAX_PRUNED * len(pruned))
        if int(pruned.sum()) > most:
            pruned[np.argsort(np.where(pruned, self.removal, np.inf), kind="stable")[most:]] = False
        return pruned


MIX = np.uint64(0x9E3779B97F4A7C15)
"""Odd multiplier with random bits, for a hash of positions."""

SEEN = 0.1
"""Coverage below which a Gaussian counts as unseen: no camera saw it, or only from far away."""

MAX_PRUNED = 0.5
"""Largest share of pruned Gaussians: each removal uncovers others, so removal scores hold for a limited share."""


def step(cost: float, rd_lambda: float) -> float:
    """Return the optimal quantisation step for a squared error of ``cost`` per squared unit."""
    return float(np.sqrt(6 * rd_lambda / (np.log(2) * cost)))


ROUNDED = ("opacity", "scale", "rotation", "color", "position")
"""Attributes of :class:`Costs` that are rounded to steps."""


@dataclass(frozen=True, slots=True, eq=False)
class RdCriterion:
    """Costs, sensitivity classes and lambda, by which the levels of Gaussians are chosen.

    Attributes:
        costs: costs of the M Gaussians.
        classes: ``(M,)`` sensitivity class of each, from 0; no class is empty.
        rd_lambda: squared error per bit.
        steps: optimal step of each class for the attributes of ``costs``; None to compute them.
    """

    costs: Costs
    classes: Integer[np.ndarray, " M"]
    rd_lambda: float
    steps: Mapping[str, list[float]] | None = None

    def condensed(self) -> RdCriterion:
        """Return the steps and only the smallest costs, for what needs no more."""
        steps = {name: self.steps_of(name) for name in ROUNDED}
        least = {name: np.array([getattr(self.costs, name).min(initial=np.inf)]) for name in Costs.__slots__}
        return RdCriterion(Costs(**least), self.classes, self.rd_lambda, steps)

    def take(self, order: Int[np.ndarray, " M"]) -> RdCriterion:
        """Return the criterion with the Gaussians in another order."""
        costs = self.costs.take(order) if self.steps is None else self.costs
        return replace(self, costs=costs, classes=self.classes.take(order))

    def steps_of(self, name: str) -> list[float]:
        """Return the optimal step of each class for an attribute; a rotation has an error about each of three axes."""
        if self.steps is not None:
            return self.steps[name]
        return self.class_steps(getattr(self.costs, name), 3 if name == "rotation" else 1)

    def class_steps(self, cost: Float64[np.ndarray, " M"], channels: int = 1) -> list[float]:
        """Return the optimal step of each class for ``channels`` times the mean of ``cost``, error per squared unit."""
        number = int(self.classes.max()) + 1
        return [step(float((channels * cost[self.classes == c]).mean()), self.rd_lambda) for c in range(number)]


@dataclass(frozen=True, slots=True)
class CodebookErrorModel:
    """Error of a scene's shN by codebook size, extrapolated from a small codebook.

    Attributes:
        entries: number of entries of that codebook.
        weighted: its squared image error, weighted by sensitivity.
        unweighted: squared image error of a codebook of that size with equal weights.
    """

    entries: int = 1
    weighted: float = 0.0
    unweighted: float = 0.0

    def error(self, entries: float) -> float:
        """Return the squared image error of a codebook with that number of entries."""
        return self.weighted * (self.entries / entries) ** SH_SHRINK

    def best_size(self, rd_lambda: float, count: int, ratio: float, entry_bits: float = ENTRY_BITS) -> int:
        """Return the optimal number of entries, of ``entry_bits`` each, for ``count`` Gaussians.

        Beyond :data:`QUICK` entries, which would take long to find, there are at least ``ratio`` Gaussians per entry.
        Where no error is known, :data:`FEW` entries are right: k-means makes no more than the scene needs.
        """
        if self.weighted == 0:
            return FEW
        low, high = 0.0, np.log(max(count / ratio, min(count / 2, QUICK), FEW))
        for _ in range(50):
            middle = 0.5 * (low + high)
            size = np.exp(middle)
            worth = SH_SHRINK * self.error(size) > rd_lambda * (entry_bits * size + LABEL_SHARE * count / np.log(2))
            low, high = (middle, high) if worth else (low, middle)
        return round(float(np.exp(low)))


def default_error(costs: Costs, splats: Splats, kept: Int[np.ndarray, " M"], sh_model: CodebookErrorModel) -> float:
    """Estimate the mean squared error of the default quality: the smaller one of the presets ``paper`` and ``fast``.

    The paper's 100 levels for rotations, 256 for the rest and 65,536 for positions are spread from each channel's
    smallest to its largest value, so that a single outlier makes them coarse; the steps of ``fast`` are absolute.

    Args:
        costs: costs of all Gaussians of ``kept``, ``(M,)``.
        splats: the scene.
        kept: indices of the ``M`` Gaussians that a renderer draws.
        sh_model: error of the view-dependent colour, by codebook size.
    """
    scene = {"opacities": splats.opacities[:, None], "scales": splats.scales, "sh0": splats.sh0, "means": splats.means}
    ends = {name: row_range(selected(values, kept)) for name, values in scene.items()}
    spans = [np.ptp(np.array(ends[name], np.float64), axis=0) for name in ("opacities", "scales", "sh0")]
    opacity, scale, color = (span / 255 for span in spans)
    log_extent = np.ptp(signed_log(np.array(ends["means"])), axis=0)
    rotation = np.full(3, 2.0)  # a change of a quaternion by 1 is a rotation by 2 radians
    paper = (opacity, scale, rotation * 2 / 99, color, log_extent / 65535)
    defaults = {name: field.default for name, field in EncodeSettings.model_fields.items()}
    levels = 2 ** means_bits(splats, kept, defaults["means_tolerance"]) - 1
    fast = (
        np.float64(defaults["opacity_step"]),
        np.full(3, defaults["scale_step"]),
        rotation * defaults["quat_step"],
        np.full(3, defaults["sh0_step"]),
        log_extent / levels,
    )
    return min(
        _error(paper, PAPER_RATIO, costs, sh_model),
        _error(fast, defaults["gaussians_per_codebook_entry"], costs, sh_model),
    )


def _error(steps: Sequence[np.ndarray | np.float64], ratio: float, costs: Costs, sh_model: CodebookErrorModel) -> float:
    """Estimate the mean squared error of rounding to such steps of opacity, scale, rotation, colour and position.

    A Gaussian's error is at most twice that of its removal: one copy too few, and one where there should be none. The
    Hessian alone overestimates the rotation of long, thin Gaussians, a few of which would then decide. The share of
    positions is bounded by that of as many other numbers: far from the origin, even 16 bits are coarse, at
    any lambda.
    """
    each = (costs.opacity, costs.scale, costs.rotation, costs.color, costs.position)
    squares = [float(np.sum(np.square(step, dtype=np.float64))) for step in steps]

    def bounded(rows: slice) -> float:
        errors = np.stack([cost[rows] * (square / 12) for cost, square in zip(each[:-1], squares[:-1], strict=True)])
        return float(np.minimum(errors.sum(axis=0), 2 * costs.removal[rows]).sum())

    total = sum(for_each_block(len(costs.color), bounded))
    total += min(float(costs.position.sum()) * squares[-1] / 12, total * 3 / (DIMENSIONS - 3))
    entries = max(len(costs.color) / ratio, 1)
    return total + PAPER_SH_GROWTH * sh_model.unweighted * (sh_model.entries / entries) ** SH_SHRINK


OTHER_VIEWS_DB = 9.5
"""Decibels per unit of view uncertainty by which errors in other views exceed those in the measured views, where
planning hides them. It does not apply to shN: its codebook hardly adapts to the measured views once sensitivity is
shrunk towards the prior."""


MIN_ERROR_RATIO = 1.1
"""Smallest error to aim at, in units of the smallest possible one: the last 0.4 dB would cost far too many bits."""

SH_UNCOMPENSATED, SH_UNCOMPENSATED_GROWTH = 0.2, 2.7
"""Measured share of shN errors that base colours cannot compensate, and its growth per unit of view uncertainty."""


def error_at(
    rd_lambda: float,
    costs: Costs,
    sh_model: CodebookErrorModel,
    threshold_bits: float,
    ratio: float,
    view_uncertainty: float,
) -> float:
    """Estimate the mean squared error of a scene that is planned with ``rd_lambda``."""
    count = len(costs.color)
    pruned = costs.removal[costs.pruned_by_rd(rd_lambda, threshold_bits)]
    rounding = GROWTH * DIMENSIONS * (count - len(pruned)) * rd_lambda / (2 * np.log(2))
    other_views = 10 ** (OTHER_VIEWS_DB * view_uncertainty / 10)
    uncompensated = SH_UNCOMPENSATED + SH_UNCOMPENSATED_GROWTH * view_uncertainty
    sh_error = sh_model.error(max(sh_model.best_size(rd_lambda, count, ratio), 1))
    return float(other_views * (rounding + GROWTH * pruned.sum()) + uncompensated * sh_error)


def lambda_for(
    error: float,
    costs: Costs,
    sh_model: CodebookErrorModel,
    threshold_bits: float,
    ratio: float,
    view_uncertainty: float,
) -> float:
    """Return the lambda at which the mean squared error is about ``error``.

    The error aimed at is at least 1.1 times the smallest possible one: at any lambda, the error of the largest codebook
    remains.
    """
    low, high = np.log(1e-22), np.log(1e-2)
    error = max(error, MIN_ERROR_RATIO * error_at(1e-22, costs, sh_model, threshold_bits, ratio, view_uncertainty))
    for _ in range(60):
        middle = 0.5 * (low + high)
        small = error_at(float(np.exp(middle)), costs, sh_model, threshold_bits, ratio, view_uncertainty) < error
        low, high = (middle, high) if small else (low, middle)
    return float(np.exp(low))


def implied_lambda(error: float, count: int) -> float:
    """Return the lambda for which ``error`` is the expected mean squared error of rounding ``count`` Gaussians."""
    return 2 * float(np.log(2)) * error / (GROWTH * DIMENSIONS * max(count, 1))


def _rows_of(sensitivity: Sensitivity, rows: slice) -> Sensitivity:
    """Return the sensitivity of some Gaussians, without a copy."""
    values: dict[str, Any] = {field.name: getattr(sensitivity, field.name) for field in fields(sensitivity)}
    for name, value in values.items():
        if isinstance(value, np.ndarray):
            values[name] = value[rows]
    return Sensitivity(**values)


def _raise_to_floor(cost: Float64[np.ndarray, " M"]) -> None:
    seen = cost[cost > 0]
    floor = max(FLOOR * float(np.median(seen, overwrite_input=True)), 1e-30) if len(seen) else 1e-30
    np.maximum(cost, floor, out=cost)


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
