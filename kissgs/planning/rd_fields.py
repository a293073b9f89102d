"""Costs of errors, steps by lambda, and the levels of each attribute with the least distortion and rate."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields, replace
from functools import partial
from math import ceil
from typing import Any

import numpy as np

from kissgs.core.array_types import Bool, Float, Float32, Float64, Int, Integer, UInt8, UInt64
from kissgs.core.context import Workers
from kissgs.core.positions import signed_exp, signed_log
from kissgs.core.sensitivity import OPACITY, ROTATION, SCALES, Sensitivity
from kissgs.core.splats import Splats
from kissgs.planning import quantize, rotation_forms
from kissgs.planning.quantize import (
    ByteTables,
    Computed,
    Planning,
    Quantized,
    Rows,
    for_each_block,
    selected,
    sorted_order,
)
from kissgs.planning.rotation_forms import KEPT, PERMUTATIONS, SHAPE_COLUMNS, StoredShapes
from kissgs.planning.sh_codebook import COEFFICIENTS, Codebook

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


# RDO quantisation: levels of the smallest squared image error plus lambda · bits.
#
# Every sensitivity class has its own step, and within a class, frequent levels are preferred where the error is small.

# Largest step of each attribute and largest change by rounding, at any lambda: the Hessian does not hold for larger
# errors. UNSEEN, the steps of fast, is for Gaussians that no camera saw; VIRTUAL for those that virtual cameras saw,
# because others may come closer; CAPTURED for those that a capture's cameras saw. A Gaussian smaller than a pixel has
# no derivative by its size, but would become a visible blob from nearby, so scales may grow less than shrink.
UNSEEN = {"opacities": 0.15, "scales": 0.11, "growth": 0.11, "quaternions": 0.023, "f_dc": 0.055}
VIRTUAL = {"opacities": 0.4, "scales": 0.13, "growth": 0.12, "quaternions": 0.04, "f_dc": 0.2}
CAPTURED = {"opacities": 2.0, "scales": 0.6, "growth": 0.3, "quaternions": 0.25, "f_dc": 0.5}
STEP_GROWTH_POWER = 1 / 3  # of step_growth, by which these bounds grow; measured with other cameras


def largest_changes(
    coverage: Float[np.ndarray, " M"], captured: Float[np.ndarray, " M"], step_growth: float
) -> dict[str, Computed]:
    """Return the largest change by rounding of each attribute of each Gaussian, rows of float64. Optimal steps grow as
    the root of lambda. These bounds grow more slowly: they protect views in which a change is more visible than in the
    measured ones, where pruning or coarser colours would be the smaller loss."""

    def change(name: str, rows: slice) -> Float64[np.ndarray, " n"]:
        seen, by_capture = coverage[rows].astype(np.float64), captured[rows].astype(np.float64)
        unseen, virtual, capture = np.log([UNSEEN[name], VIRTUAL[name], CAPTURED[name]])
        logs = unseen * (1 - seen) + virtual * (seen - by_capture) + capture * by_capture
        return np.minimum(np.exp(logs) * step_growth**STEP_GROWTH_POWER, CAPTURED[name])

    return {name: Computed(len(coverage), partial(change, name)) for name in CAPTURED}


UNUSED_COUNT = 0.05  # count that an unused level has in the estimate of its bits
ROUNDS = 3  # number of iterations of counting levels and choosing by the counts
CHUNK = 1 << 14  # Gaussians per task


def quantize_by_steps(
    values: Float[np.ndarray, "M C"] | Rows, steps: Float64[np.ndarray, " M"] | Rows, pool: Workers | None = None
) -> Quantized:
    """Round to the nearest multiples of each Gaussian's own step, the same for all its channels."""
    smallest, largest = quantize.row_range(values, pool)
    low32 = smallest.astype(np.float32) + np.float32(0)
    low = low32.astype(np.float64)
    extent = largest.astype(np.float64) - low
    widest = float(extent.max(initial=0))
    count = len(values)
    least = min(for_each_block(count, lambda rows: float(steps[rows].min()), pool))
    finest = max(least, widest / 255, 1e-30)
    top = int(min(max(ceil(widest / finest - 1e-3), 1), 255))
    levels, stride = np.empty((count, len(low)), np.uint8), np.empty(count, np.uint8)

    def round_to_levels(rows: slice) -> None:
        spacing = np.clip(np.rint(steps[rows] / finest), 1, 255)
        multiples = spacing[:, None]
        found = np.rint((values[rows] - low) / finest / multiples) * multiples
        found = np.where(found > top, np.floor(top / multiples) * multiples, found)
        levels[rows], stride[rows] = np.clip(found, 0, top), spacing

    for_each_block(count, round_to_levels, pool)
    high = np.where(extent > 0, low + top * finest, low).astype(np.float32)
    return Quantized(levels, quantize.even_table(low32, high, top), stride)


def rdo_quantize(
    values: Float64[np.ndarray, "M 8"] | Rows,
    parts: dict[str, Quantized],
    hessians: Float32[np.ndarray, "M 10"] | Rows,
    forms: UInt8[np.ndarray, " M"],
    criterion: RdCriterion,
    largest: Mapping[str, Float64[np.ndarray, " M"] | Rows],
    pool: Workers,
    tables: ByteTables | None = None,
) -> dict[str, Quantized]:
    """Choose the levels of opacities, scales and quaternions jointly by squared error plus lambda · bits. With
    ``tables``, the values of the scales' table move to the mean of what they stand for."""
    from kissgs.planning import kernels

    classes = criterion.classes
    levels = np.concatenate([parts[name].levels for name in SHAPE_COLUMNS], axis=1)
    omitted = parts["omitted"].levels[:, 0] if "omitted" in parts else None
    floor = np.array([criterion.least[name] for name in ("opacity", "scale", "rotation")])

    for _ in range(ROUNDS):
        rate_table = criterion.rd_lambda * level_bits(levels, classes, pool)
        values_of_levels, ends = _values_of_levels([parts[name] for name in SHAPE_COLUMNS])
        if tables is not None:
            ends[0] = tables.first_drawn, tables.last_drawn

        of_levels = values_of_levels, ends, rate_table

        def choose(rows: slice, of_levels: tuple[np.ndarray, np.ndarray, np.ndarray] = of_levels) -> None:
            chosen = levels[rows].astype(np.int64)
            missing = np.full(len(chosen), -1) if omitted is None else omitted[rows].astype(np.int64)
            stored = np.tile(np.arange(4), (len(chosen), 1)) if omitted is None else KEPT[missing]
            own = hessians[rows], forms[rows], PERMUTATIONS, classes[rows].astype(np.int64)
            bounds = _bounds(largest, rows, levels.shape[1])
            kernels.choose_levels(values[rows], stored, missing, *own, *of_levels, bounds, floor, chosen)
            levels[rows] = chosen

        for_each_block(len(levels), choose, pool, block=CHUNK)
        if criterion.costs is not None and tables is not None:
            bounds = largest["scales"][:], largest["growth"][:]
            table = parts["scales"].table[:, 0].astype(np.float32)
            moved = quantize.refit_table(table, levels[:, 1:4], values[:][:, 1:4], criterion.costs.scale, bounds)
            parts = {**parts, "scales": replace(parts["scales"], table=moved.astype(np.float64)[:, None])}
    chosen = np.split(levels, [1, 4], axis=1)
    found = {name: replace(parts[name], levels=own) for name, own in zip(SHAPE_COLUMNS, chosen, strict=True)}
    return {**parts, **found}


def _values_of_levels(fields: list[Quantized]) -> tuple[Float64[np.ndarray, "C 256"], Int[np.ndarray, "C 2"]]:
    """Return the values of the levels of every channel, and the first and last level to use: one if it is constant."""
    values, ends = [], []
    for field in fields:
        for column in range(field.levels.shape[1]):
            table = field.table[:, column % field.table.shape[1]]
            values.append(np.pad(table, (0, quantize.SIZE - len(table)), mode="edge"))
            ends.append((0, field.top if table[-1] > table[0] else 0))
    return np.stack(values), np.array(ends)


def _bounds(
    largest: Mapping[str, Float64[np.ndarray, " M"] | Rows], rows: slice, columns: int
) -> Float64[np.ndarray, "n 2 columns"]:
    """Return the largest distance of a level below and above each value."""
    bounds = np.empty((len(range(rows.stop)[rows]), 2, columns))
    bounds[:, :, 0] = largest["opacities"][rows][:, None]
    bounds[:, 0, 1:4] = largest["scales"][rows][:, None]
    bounds[:, 1, 1:4] = largest["growth"][rows][:, None]
    bounds[:, :, 4:] = largest["quaternions"][rows][:, None, None]
    return bounds


def level_bits(
    levels: Integer[np.ndarray, "M C"], classes: Integer[np.ndarray, " M"], pool: Workers | None = None
) -> Float64[np.ndarray, "classes C 256"]:
    """Estimate the bits of every level of every channel in every class from the counts of ``levels``."""
    number = int(classes.max()) + 1

    def counted(rows: slice) -> Int[np.ndarray, "classes C 256"]:
        base = classes[rows].astype(np.int64) * 256
        counts = [np.bincount(base + column, minlength=number * 256) for column in levels[rows].T]
        return np.stack([each.reshape(number, 256) for each in counts], axis=1)

    likely = np.sum(for_each_block(len(levels), counted, pool), axis=0) + UNUSED_COUNT
    return np.asarray(np.log2(likely.sum(axis=2, keepdims=True)) - np.log2(likely))


# Levels of every attribute for containers with :class:`~kissgs.planning.quantize.ByteTables`.


def stored_values(values: Float64[np.ndarray, "M 8"], tables: ByteTables) -> Float64[np.ndarray, "M 8"]:
    """Return opacity logits, log-scales and quaternions in the form in which they are quantised. Logits are clipped to
    those of the levels that may be used; beyond, opacities differ by less than 1/255."""
    lowest, highest = tables.opacity_logits[[tables.first_drawn, tables.last_drawn]]
    opacities = np.clip(values[:, :1], lowest, highest)
    return np.concatenate([opacities, values[:, 1:4], shape_quats(values[:, 4:])], axis=1)


def rounded_shapes(
    values: Float64[np.ndarray, "M 8"],
    weights: Float64[np.ndarray, " M"],
    steps: Mapping[str, Float64[np.ndarray, " M"]],
    tables: ByteTables,
) -> dict[str, Quantized]:
    """Round opacity, log-scales and quaternion of :func:`stored_values` to steps of each Gaussian's own. ``weights``
    are squared image errors per squared unit of the log-scales."""
    quats = values[:, 4:]
    opacities = quantize.nearest_levels(tables.opacity_logits, _on_lattice(values[:, :1], steps["opacities"]))
    finest = float(steps["scales"].min())
    scales = _on_lattice(values[:, 1:4], np.clip(np.rint(steps["scales"] / finest), 1, 255) * finest)
    scale_table = quantize.fit_table(scales.ravel(), np.repeat(weights, 3), finest)
    omitted = rotation_forms.omitted_components(quats)
    small = rotation_forms.stored_components(quats, omitted)
    strides = np.clip(np.rint(steps["quaternions"] / rotation_forms.STEP), 1, 64).astype(np.int64)
    drawn = np.clip(opacities, tables.first_drawn, tables.last_drawn)
    return {
        "opacities": Quantized(drawn, tables.opacity_logits[:, None]),
        "scales": Quantized(quantize.nearest_levels(scale_table, scales), scale_table.astype(np.float64)[:, None]),
        "quaternions": Quantized(rotation_forms.lattice_levels(small, strides), rotation_forms.TABLE[:, None]),
        "omitted": Quantized(omitted[:, None], np.arange(4.0)[:, None]),
    }


def finished_shapes(
    fields: dict[str, Quantized], logits: Float64[np.ndarray, " M"], tables: ByteTables
) -> dict[str, Quantized]:
    """Return the fields with the digits that are stored; Gaussians of these ``logits`` that nobody draws stay so."""
    opacities = fields["opacities"].levels.copy()
    hidden = logits <= tables.opacity_logits[1]
    opacities[hidden, 0] = np.rint(255 / (1 + np.exp(-logits[hidden])))
    scales = fields["scales"]
    used = quantize.table_field(*quantize.without_unused(scales.table[:, 0].astype(np.float32), scales.levels))
    return {**fields, "opacities": replace(fields["opacities"], levels=opacities), "scales": used}


def color_field(
    base: Float64[np.ndarray, "M 3"], steps: Float64[np.ndarray, " M"], weights: Float64[np.ndarray, " M"]
) -> Quantized:
    """Return the levels of base colours, each Gaussian's rounded to a step of its own."""
    finest = float(steps.min())
    rounded = _on_lattice(base, np.clip(np.rint(steps / finest), 1, 255) * finest)
    table = quantize.fit_table(rounded.ravel(), np.repeat(weights, 3), finest)
    return quantize.table_field(*quantize.without_unused(table, quantize.nearest_levels(table, rounded)))


def means_field(means: Float32[np.ndarray, "M 3"], steps: float | Float64[np.ndarray, " M"]) -> Quantized:
    """Return 16-bit levels of the positions' signed logarithms, with a range per axis. Levels are multiples of a power
    of two, up to 256, of about the step of each Gaussian, so that low bytes compress."""
    logs = signed_log(means)
    low, high = (_as_text(end.astype(np.float32)) for end in (logs.min(axis=0), logs.max(axis=0)))
    table = quantize.even_table(low, high, quantize.MEANS_TOP)
    extent = high.astype(np.float32).astype(np.float64) - low.astype(np.float32)
    unit = np.where(extent > 0, extent, np.inf) / quantize.MEANS_TOP
    exponents = np.log2(np.maximum(np.reshape(steps, (-1, 1)) / unit, 1))
    every = np.exp2(np.clip(np.floor(exponents + 0.5), 0, 8))
    levels = np.clip(np.rint((logs - low.astype(np.float32)) / unit / every) * every, 0, quantize.MEANS_TOP)
    stride = np.broadcast_to(every, levels.shape).astype(np.int64)
    return Quantized(levels.astype(np.uint16), table, stride)


def _as_text(ends: Float32[np.ndarray, " C"]) -> Float64[np.ndarray, " C"]:
    """Return the shortest decimal numbers that stand for these, which the container stores as text."""
    return np.array([float(str(value + np.float32(0))) for value in ends])


def decoded_quats(fields: dict[str, Quantized]) -> Float64[np.ndarray, "M 4"]:
    """Return the quaternions of a plan's fields, stored whole or as three components."""
    if "omitted" not in fields:
        return fields["quaternions"].values()
    return rotation_forms.whole(fields["quaternions"].values(), fields["omitted"].levels[:, 0])


def shape_quats(quats: Float64[np.ndarray, "M 4"]) -> Float64[np.ndarray, "M 4"]:
    """Return the quaternions with the sign in which they are quantised."""
    return rotation_forms.with_sign(quats, rotation_forms.omitted_components(quats))


def _on_lattice(values: Float64[np.ndarray, "M C"], steps: Float[np.ndarray, " M"]) -> Float64[np.ndarray, "M C"]:
    every = np.reshape(steps, (-1, 1))
    return np.rint(values / every) * every


# Levels of every attribute at one lambda, in the values that the container can hold.

OUTLIERS = 1e-4  # share of base colours at either end of a channel that may be clipped, for a smaller step


@dataclass(frozen=True, slots=True, eq=False)
class RdFields:
    """Quantises the attributes of M Gaussians."""

    planning: Planning
    criterion: RdCriterion
    largest: Mapping[str, Rows]  # see largest_changes

    def shapes(self, values: StoredShapes, hessians: Rows) -> dict[str, Quantized]:
        """Quantise opacity, log-scales and rotation."""
        criterion, tables, pool = self.criterion, self.planning.container.tables, self.planning.pool
        wanted: StoredShapes | Float64[np.ndarray, "M 8"] = values
        steps = {
            field: criterion.each_step(name, self.largest[field])
            for name, field in (("opacity", "opacities"), ("scale", "scales"), ("rotation", "quaternions"))
        }
        if tables is None or criterion.costs is None:
            fields = {name: quantize_by_steps(values.field(name), steps[name], pool) for name in SHAPE_COLUMNS}
        else:
            logits = values.field("opacities")[:][:, 0].astype(np.float64)
            wanted, each = stored_values(values[:], tables), {name: some[:] for name, some in steps.items()}
            fields = rounded_shapes(wanted, criterion.costs.scale, each, tables)
        if self.planning.settings.rdo_quantization:
            fields = rdo_quantize(wanted, fields, hessians, values.forms, criterion, self.largest, pool, tables)
            if tables is None:
                fields = {name: field.from_zero() for name, field in fields.items()}
        return fields if tables is None else finished_shapes(fields, logits, tables)

    def means(self, splats: Splats, order: Int[np.ndarray, " M"], coarser: Int[np.ndarray, " M"]) -> Quantized:
        """Quantise the positions of the Gaussians ``order``, with the bits that lambda asks for in each class. A
        Gaussian has at most ``coarser`` bits less than :func:`means_bits` gives for ``means_tolerance``."""
        means, criterion, pool = selected(splats.means, order), self.criterion, self.planning.pool
        usual = quantize.means_bits(splats, order, self.planning.settings.means_tolerance, pool)
        most = np.clip(16 - usual + coarser, 0, 8)
        unit = max(quantize.log_extent(means, pool), 1e-30) / quantize.MEANS_TOP
        steps = criterion.steps["position"]
        if self.planning.container.tables is not None:
            each = np.array(steps)[criterion.classes]
            return means_field(means[:], np.minimum(each, unit * 2.0**most / np.sqrt(2)))
        coarse = np.array([min(max(np.floor(np.log2(step / unit) + 0.5), 0), 8) for step in steps]).astype(np.int8)
        return quantize.quantize_means(means, bits=16 - np.minimum(coarse[criterion.classes], most), pool=pool)

    def colors(self, base: Float32[np.ndarray, "M 3"]) -> tuple[Quantized, int]:
        """Quantise base colours; return them and the number of clipped outliers."""
        criterion = self.criterion
        steps = criterion.each_step("color", self.largest["f_dc"])
        if self.planning.container.tables is not None and criterion.costs is not None:
            return color_field(base.astype(np.float64), steps[:], criterion.costs.color), 0
        clipped = quantize.clip_outliers(base, step=min(criterion.steps["color"]), share=OUTLIERS)
        levels = quantize_by_steps(clipped, steps, self.planning.pool)
        return levels, 0 if clipped is base else int((clipped != base).any(axis=1).sum())


def decoded_entries(codebook: Codebook, coefficients: int) -> Float32[np.ndarray, "entries K 3"]:
    """Return the decoded shN coefficients of the codebook's entries."""
    centroids = codebook.centroids
    entries = np.empty((len(centroids.levels), coefficients, 3), np.float32)

    def decode(rows: slice) -> None:
        values = centroids.take(rows).values().reshape(-1, 3, COEFFICIENTS)
        entries[rows] = values[:, :, :coefficients].transpose(0, 2, 1)

    for_each_block(len(entries), decode)
    return entries


def decoded_scene(
    fields: dict[str, Quantized], sh0: Float32[np.ndarray, "M 3"], shN: Float32[np.ndarray, "M K 3"]
) -> Splats:
    """Return the decoded scene."""
    quats = decoded_quats(fields)
    norms = np.linalg.norm(quats, axis=1, keepdims=True)
    return Splats(
        means=signed_exp(fields["means"].values()).astype(np.float32),
        quats=(quats / np.where(norms > 0, norms, 1)).astype(np.float32),
        scales=fields["scales"].values().astype(np.float32),
        opacities=fields["opacities"].values()[:, 0].astype(np.float32),
        sh0=sh0,
        shN=shN,
    )


def largest_errors(
    fields: dict[str, Quantized],
    values: Float64[np.ndarray, "M 8"] | Rows,
    means: Float32[np.ndarray, "M 3"] | Rows,
    colors: Float32[np.ndarray, "M 3"] | Rows,
    pool: Workers | None = None,
) -> dict[str, list[float]]:
    """Return the largest error per field and channel, in the unit of the field (positions: of the signed logarithm)."""

    def largest(rows: slice) -> dict[str, np.ndarray]:
        wanted, some = values[rows], {name: field.take(rows) for name, field in fields.items()}
        quats = wanted[:, 4:]
        if "omitted" in fields:  # the sign of the missing component is not stored
            quats = shape_quats(quats)
        pairs = {
            "means": (some["means"].values(), signed_log(means[rows])),
            "opacities": (some["opacities"].values(), wanted[:, :1]),
            "scales": (some["scales"].values(), wanted[:, 1:4]),
            "quaternions": (decoded_quats(some), quats),
            "f_dc": (some["f_dc"].values(), colors[rows]),
        }
        return {name: np.abs(found - wanted).max(axis=0) for name, (found, wanted) in pairs.items()}

    blocks = for_each_block(len(values), largest, pool)
    return {name: np.max([block[name] for block in blocks], axis=0).tolist() for name in blocks[0]}
