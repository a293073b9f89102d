"""RDO quantisation: levels of the smallest squared image error plus lambda · bits.

Every sensitivity class has its own step, and within a class, frequent levels are preferred where the error is small.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial
from math import ceil

import numpy as np

from kissgs.core.array_types import Float, Float32, Float64, Int, Integer, UInt8
from kissgs.core.resources import Workers
from kissgs.planning.container_model import ByteTables
from kissgs.planning.quantize import Quantized, even_table
from kissgs.planning.rd_criterion import RdCriterion
from kissgs.planning.rotation_forms import PERMUTATIONS
from kissgs.planning.rows import Computed, Rows, for_each_block, row_range
from kissgs.planning.smallest_three import KEPT
from kissgs.planning.value_table import SIZE, refit_table

UNSEEN = {"opacities": 0.15, "scales": 0.11, "growth": 0.11, "quaternions": 0.023, "f_dc": 0.055}
VIRTUAL = {"opacities": 0.4, "scales": 0.13, "growth": 0.12, "quaternions": 0.04, "f_dc": 0.2}
CAPTURED = {"opacities": 2.0, "scales": 0.6, "growth": 0.3, "quaternions": 0.25, "f_dc": 0.5}
"""Largest step of each attribute and largest change by rounding, at any lambda.

``UNSEEN``, the steps of ``fast``, is for Gaussians that no camera saw; ``VIRTUAL`` for those that virtual cameras saw,
because other cameras may come closer; ``CAPTURED`` for those that a capture's cameras saw. The Hessian does not hold
for larger errors. A Gaussian smaller than a pixel has no derivative by its size, but would become a visible blob from
nearby, so scales may grow less than they may shrink (``growth``).
"""

SLACK_POWER = 1 / 3
"""Exponent with which these bounds grow with ``slack``, measured with cameras that the encoder did not use."""


def largest_changes(
    coverage: Float[np.ndarray, " M"], captured: Float[np.ndarray, " M"], slack: float
) -> dict[str, Computed]:
    """Return the largest change by rounding of each attribute of each Gaussian, rows of float64.

    Optimal steps grow as the root of lambda. These bounds grow more slowly: they protect views in which a change is
    more visible than in the measured ones, where pruning or coarser colours would be the smaller loss.
    """

    def change(name: str, rows: slice) -> Float64[np.ndarray, " n"]:
        seen, by_capture = coverage[rows].astype(np.float64), captured[rows].astype(np.float64)
        unseen, virtual, capture = np.log([UNSEEN[name], VIRTUAL[name], CAPTURED[name]])
        logs = unseen * (1 - seen) + virtual * (seen - by_capture) + capture * by_capture
        return np.minimum(np.exp(logs) * slack**SLACK_POWER, CAPTURED[name])

    return {name: Computed(len(coverage), partial(change, name)) for name in CAPTURED}


UNUSED_COUNT = 0.05
"""Count that an unused level has in the estimate of its bits."""

ROUNDS = 3
"""Number of iterations of counting levels and choosing by the counts."""

CHUNK = 1 << 14
"""Gaussians per task."""

SHAPE_FIELDS = ("opacities", "scales", "quaternions")
"""Fields whose levels are chosen jointly."""


def quantize_by_class(
    values: Float[np.ndarray, "M C"] | Rows,
    optimal: Sequence[float],
    classes: Integer[np.ndarray, " M"],
    coarsest: Float64[np.ndarray, " M"] | Rows,
    pool: Workers | None = None,
) -> Quantized:
    """Round to the nearest of the levels that each sensitivity class uses: multiples of one step for all channels.

    ``optimal`` is the best step of each class; no step is above ``coarsest`` of the Gaussian.
    """
    smallest, largest = row_range(values, pool)
    low32 = smallest.astype(np.float32) + np.float32(0)
    low = low32.astype(np.float64)
    extent = largest.astype(np.float64) - low
    widest = float(extent.max(initial=0))
    count, best = len(values), np.array(optimal)

    def steps(rows: slice) -> Float64[np.ndarray, " n"]:
        return np.minimum(best[classes[rows]], coarsest[rows])

    least = min(for_each_block(count, lambda rows: float(steps(rows).min()), pool))
    finest = max(least, widest / 255, 1e-30)
    top = int(min(max(ceil(widest / finest - 1e-3), 1), 255))
    levels, stride = np.empty((count, len(low)), np.uint8), np.empty(count, np.uint8)

    def round_to_levels(rows: slice) -> None:
        spacing = np.clip(np.rint(steps(rows) / finest), 1, 255)
        multiples = spacing[:, None]
        found = np.rint((values[rows] - low) / finest / multiples) * multiples
        found = np.where(found > top, np.floor(top / multiples) * multiples, found)
        levels[rows], stride[rows] = np.clip(found, 0, top), spacing

    for_each_block(count, round_to_levels, pool)
    high = np.where(extent > 0, low + top * finest, low).astype(np.float32)
    return Quantized(levels, even_table(low32, high, top), stride)


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
    """Choose the levels of opacities, scales and quaternions jointly by squared error plus lambda · bits.

    With ``tables``, the values of the scales' table move to the mean of what they stand for.
    """
    from kissgs.planning import rdo_kernels

    costs, classes = criterion.costs, criterion.classes
    levels = np.concatenate([parts[name].levels for name in SHAPE_FIELDS], axis=1)
    omitted = parts["omitted"].levels[:, 0] if "omitted" in parts else None
    floor = np.array([float(cost.min(initial=np.inf)) for cost in (costs.opacity, costs.scale, costs.rotation)])

    for _ in range(ROUNDS):
        rate_table = criterion.rd_lambda * level_bits(levels, classes, pool)
        values_of_levels, ends = _values_of_levels([parts[name] for name in SHAPE_FIELDS])
        if tables is not None:
            ends[0] = tables.first_drawn, tables.last_drawn

        def choose(
            rows: slice,
            rate_table: Float64[np.ndarray, "classes C 256"] = rate_table,
            values_of_levels: Float64[np.ndarray, "C 256"] = values_of_levels,
            ends: Int[np.ndarray, "C 2"] = ends,
        ) -> None:
            chosen = levels[rows].astype(np.int64)
            missing = np.full(len(chosen), -1) if omitted is None else omitted[rows].astype(np.int64)
            rdo_kernels.choose_levels(
                values[rows],
                np.tile(np.arange(4), (len(chosen), 1)) if omitted is None else KEPT[missing],
                missing,
                hessians[rows],
                forms[rows],
                PERMUTATIONS,
                classes[rows].astype(np.int64),
                values_of_levels,
                ends,
                rate_table,
                _bounds(largest, rows, levels.shape[1]),
                floor,
                chosen,
            )
            levels[rows] = chosen

        for_each_block(len(levels), choose, pool, block=CHUNK)
        if tables is not None:
            bounds = largest["scales"][:], largest["growth"][:]
            table = parts["scales"].table[:, 0].astype(np.float32)
            moved = refit_table(table, levels[:, 1:4], values[:][:, 1:4], costs.scale, bounds)
            parts = {**parts, "scales": replace(parts["scales"], table=moved.astype(np.float64)[:, None])}
    chosen = np.split(levels, [1, 4], axis=1)
    found = {name: replace(parts[name], levels=own) for name, own in zip(SHAPE_FIELDS, chosen, strict=True)}
    return {**parts, **found}


def _values_of_levels(fields: list[Quantized]) -> tuple[Float64[np.ndarray, "C 256"], Int[np.ndarray, "C 2"]]:
    """Return the values of the levels of every channel, and the first and last level to use: one if it is constant."""
    values, ends = [], []
    for field in fields:
        for column in range(field.levels.shape[1]):
            table = field.table[:, column % field.table.shape[1]]
            values.append(np.pad(table, (0, SIZE - len(table)), mode="edge"))
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
    levels: Integer[np.ndarray, "M C"],
    classes: Integer[np.ndarray, " M"],
    pool: Workers | None = None,
) -> Float64[np.ndarray, "classes C 256"]:
    """Estimate the bits of every level of every channel in every class from the counts of ``levels``."""
    number = int(classes.max()) + 1

    def counted(rows: slice) -> Int[np.ndarray, "classes C 256"]:
        base = classes[rows].astype(np.int64) * 256
        return np.stack(
            [np.bincount(base + column, minlength=number * 256).reshape(number, 256) for column in levels[rows].T],
            axis=1,
        )

    likely = np.sum(for_each_block(len(levels), counted, pool), axis=0) + UNUSED_COUNT
    return np.asarray(np.log2(likely.sum(axis=2, keepdims=True)) - np.log2(likely))
