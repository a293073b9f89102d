"""RDO quantisation for tables of values and smallest-three rotations: squared image error plus lambda · bits."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from kissgs.core.array_types import Float32, Float64, Int, UInt8
from kissgs.core.resources import Workers
from kissgs.planning.rd_criterion import RdCriterion
from kissgs.planning.rdo_quantize import CHUNK, ROUNDS, level_bits
from kissgs.planning.rotation_forms import PERMUTATIONS
from kissgs.planning.smallest_three import KEPT, TABLE
from kissgs.planning.value_table import SIZE, refit_table


@dataclass(frozen=True, slots=True, eq=False)
class ShapeValues:
    """Opacity, log-scales and rotation of M Gaussians, to be quantised.

    Attributes:
        opacities: ``(M,)`` logits.
        scales: ``(M, 3)`` log-scales.
        quats: ``(M, 4)`` quaternions of length 1 whose missing component is not negative.
        omitted: ``(M,)`` index of the missing component.
        small: ``(M, 3)`` the other components.
    """

    opacities: Float64[np.ndarray, " M"]
    scales: Float64[np.ndarray, "M 3"]
    quats: Float64[np.ndarray, "M 4"]
    omitted: UInt8[np.ndarray, " M"]
    small: Float64[np.ndarray, "M 3"]


@dataclass(frozen=True, slots=True, eq=False)
class ShapeLevels:
    """Levels of opacity, log-scales and rotation, and the tables of the first two.

    Attributes:
        levels: ``(M, 7)`` opacity, scales, stored components of the rotation.
        opacity_table: ``(256,)`` logits; the levels ``first`` to ``last`` may be chosen.
        first: smallest level of opacity to choose.
        last: largest level of opacity to choose.
        scale_table: ascending log-scales.
    """

    levels: Int[np.ndarray, "M 7"]
    opacity_table: Float64[np.ndarray, " 256"]
    first: int
    last: int
    scale_table: Float32[np.ndarray, " levels"]


def rdo_quantize_tables(
    values: ShapeValues,
    start: ShapeLevels,
    shapes: Float32[np.ndarray, "M 10"],
    forms: UInt8[np.ndarray, " M"],
    criterion: RdCriterion,
    largest: dict[str, Float64[np.ndarray, " M"]],
    pool: Workers,
) -> ShapeLevels:
    """Choose the levels jointly, and move the values of the scales' table to the mean of what they stand for.

    Args:
        values: what is quantised, in the stored form of each Gaussian.
        start: the rounded values.
        shapes: shape Hessians of :class:`kissgs.Sensitivity`.
        forms: form of each Gaussian, see :mod:`kissgs.planning.rotation_forms`.
        criterion: sensitivity classes, lambda, and costs, whose smallest values are added to the Hessians' diagonals.
        largest: largest change of each attribute (:func:`~kissgs.planning.rdo_quantize.largest_changes`).
        pool: threads.
    """
    from kissgs.planning import table_kernels

    costs, classes = criterion.costs, criterion.classes.astype(np.int64)
    columns = np.concatenate([values.opacities[:, None], values.scales, values.small], axis=1)
    levels, scale_table = start.levels.copy(), start.scale_table
    ranges = np.stack(
        [
            np.stack([largest["opacities"], *3 * [largest[scales]], *3 * [largest["quaternions"]]], axis=1)
            for scales in ("scales", "growth")
        ],
        axis=1,
    )
    floor = np.array([float(cost.min(initial=np.inf)) for cost in (costs.opacity, costs.scale, costs.rotation)])
    ends = np.array([[start.first, start.last], *3 * [[0, len(scale_table) - 1]], *3 * [[0, SIZE - 1]]])

    for _ in range(ROUNDS):
        rate_table = criterion.rd_lambda * level_bits(levels, classes)
        tables = np.stack([start.opacity_table, *3 * [_padded(scale_table)], *3 * [TABLE]])

        def choose(first: int, rate_table: np.ndarray = rate_table, tables: np.ndarray = tables) -> None:
            rows = slice(first, first + CHUNK)
            table_kernels.choose_levels(
                columns[rows],
                values.quats[rows],
                values.omitted[rows],
                shapes[rows],
                forms[rows],
                PERMUTATIONS,
                KEPT,
                classes[rows],
                tables,
                ends,
                rate_table,
                ranges[rows],
                floor,
                levels[rows],
            )

        pool.map(choose, range(0, len(levels), CHUNK))
        bounds = largest["scales"], largest["growth"]
        scale_table = refit_table(scale_table, levels[:, 1:4], values.scales, costs.scale, bounds)
    return ShapeLevels(levels, start.opacity_table, start.first, start.last, scale_table)


def _padded(table: Float32[np.ndarray, " levels"]) -> Float64[np.ndarray, " 256"]:
    """Return the table with its last value repeated to 256."""
    return np.pad(table.astype(np.float64), (0, SIZE - len(table)), mode="edge")
