"""Levels of every attribute for containers with :class:`~kissgs.planning.container_model.ByteTables`."""

from __future__ import annotations

import numpy as np

from kissgs.core.array_types import Float, Float32, Float64, UInt8
from kissgs.core.resources import Workers
from kissgs.core.signed_log import signed_log
from kissgs.planning import smallest_three
from kissgs.planning.container_model import ByteTables
from kissgs.planning.quantize import MEANS_TOP, Quantized
from kissgs.planning.rd_criterion import RdCriterion
from kissgs.planning.rdo_tables import ShapeLevels, ShapeValues, rdo_quantize_tables
from kissgs.planning.value_table import fit_table, nearest_levels, table_field, without_unused


def shape_values(values: Float64[np.ndarray, "M 8"], tables: ByteTables) -> ShapeValues:
    """Return opacity logits, log-scales and quaternions in the form in which they are quantised.

    Logits are clipped to those of the levels that may be used; beyond, opacities differ by less than 1/255.
    """
    lowest, highest = tables.opacity_logits[[tables.first_drawn, tables.last_drawn]]
    omitted = smallest_three.omitted_components(values[:, 4:])
    quats = smallest_three.with_sign(values[:, 4:], omitted)
    return ShapeValues(
        opacities=np.clip(values[:, 0], lowest, highest),
        scales=np.ascontiguousarray(values[:, 1:4]),
        quats=quats,
        omitted=omitted,
        small=smallest_three.stored_components(quats, omitted),
    )


def rounded_shapes(
    values: ShapeValues,
    weights: Float64[np.ndarray, " M"],
    steps: tuple[Float64[np.ndarray, " M"], Float64[np.ndarray, " M"], Float64[np.ndarray, " M"]],
    tables: ByteTables,
) -> ShapeLevels:
    """Round opacity, scales and rotation of each Gaussian to steps of its own.

    Args:
        values: what is quantised.
        weights: squared image error per squared unit of the log-scales.
        steps: step of each Gaussian's opacity logit, log-scales and quaternion.
        tables: tables of the container.
    """
    opacities = nearest_levels(tables.opacity_logits, _on_lattice(values.opacities[:, None], steps[0]))
    opacities = np.clip(opacities, tables.first_drawn, tables.last_drawn)
    finest = float(steps[1].min())
    scales = _on_lattice(values.scales, np.clip(np.rint(steps[1] / finest), 1, 255) * finest)
    scale_table = fit_table(scales.ravel(), np.repeat(weights, 3), finest)
    rotations = smallest_three.lattice_levels(values.small, smallest_three.strides(steps[2]))
    levels = np.concatenate([opacities, nearest_levels(scale_table, scales), rotations], axis=1)
    return ShapeLevels(
        levels.astype(np.int64), tables.opacity_logits, tables.first_drawn, tables.last_drawn, scale_table
    )


def shape_fields(
    values: Float64[np.ndarray, "M 8"],
    steps: tuple[Float64[np.ndarray, " M"], Float64[np.ndarray, " M"], Float64[np.ndarray, " M"]],
    weights: Float64[np.ndarray, " M"],
    tables: ByteTables,
) -> dict[str, Quantized]:
    """Return the levels of :func:`rounded_shapes` by field: opacities, scales, quaternions, omitted."""
    wanted = shape_values(values, tables)
    return _fields(values, wanted, rounded_shapes(wanted, weights, steps, tables), tables)


def rd_shape_fields(
    values: Float64[np.ndarray, "M 8"],
    shapes: Float32[np.ndarray, "M 10"] | None,
    forms: UInt8[np.ndarray, " M"],
    criterion: RdCriterion,
    largest: dict[str, Float64[np.ndarray, " M"]],
    tables: ByteTables,
    pool: Workers,
) -> dict[str, Quantized]:
    """Return the levels of opacities, scales and rotations at the criterion's lambda.

    Args:
        values: opacity logit, log-scales and unit quaternion, in the stored form of each Gaussian.
        shapes: shape Hessians for RDO quantisation; None for the nearest levels.
        forms: form of each Gaussian.
        criterion: costs, sensitivity classes and lambda.
        largest: largest change of each attribute.
        tables: tables of the container.
        pool: threads.
    """
    costs = criterion.costs
    steps = (
        criterion_steps("opacity", criterion, largest["opacities"]),
        criterion_steps("scale", criterion, largest["scales"]),
        criterion_steps("rotation", criterion, largest["quaternions"]),
    )
    wanted = shape_values(values, tables)
    chosen = rounded_shapes(wanted, costs.scale, steps, tables)
    if shapes is not None:
        chosen = rdo_quantize_tables(wanted, chosen, shapes, forms, criterion, largest, pool)
    return _fields(values, wanted, chosen, tables)


def criterion_steps(
    name: str, criterion: RdCriterion, coarsest: Float64[np.ndarray, " M"]
) -> Float64[np.ndarray, " M"]:
    """Return the step of each Gaussian's attribute: the best one of its class, at most ``coarsest``."""
    return np.minimum(np.array(criterion.steps_of(name))[criterion.classes], coarsest)


def color_field(
    base: Float64[np.ndarray, "M 3"], steps: Float64[np.ndarray, " M"], weights: Float64[np.ndarray, " M"]
) -> Quantized:
    """Return the levels of base colours, each Gaussian's rounded to a step of its own."""
    finest = float(steps.min())
    rounded = _on_lattice(base, np.clip(np.rint(steps / finest), 1, 255) * finest)
    table = fit_table(rounded.ravel(), np.repeat(weights, 3), finest)
    return table_field(*without_unused(table, nearest_levels(table, rounded)))


def means_field(means: Float32[np.ndarray, "M 3"], steps: float | Float64[np.ndarray, " M"]) -> Quantized:
    """Return 16-bit levels of the positions' signed logarithms, with a range per axis.

    Args:
        means: finite positions.
        steps: wanted step of each Gaussian's signed logarithm. Levels are multiples of a power of two, up to 256, of
            about this step, so that the low bytes have trailing zeros.
    """
    logs = signed_log(means)
    low = logs.min(axis=0).astype(np.float32) + np.float32(0)
    high = logs.max(axis=0).astype(np.float32) + np.float32(0)
    extent = high.astype(np.float64) - low
    unit = np.where(extent > 0, extent, np.inf) / MEANS_TOP
    exponents = np.log2(np.maximum(np.reshape(steps, (-1, 1)) / unit, 1))
    every = np.exp2(np.clip(np.floor(exponents + 0.5), 0, 8))
    levels = np.clip(np.rint((logs - low) / unit / every) * every, 0, MEANS_TOP)
    stride = np.broadcast_to(every, levels.shape).astype(np.int64)
    return Quantized(levels.astype(np.uint16), low, high, MEANS_TOP, stride)


def decoded_quats(fields: dict[str, Quantized]) -> Float64[np.ndarray, "M 4"]:
    """Return the quaternions of a plan's fields, stored whole or as three components."""
    if "omitted" not in fields:
        return fields["quaternions"].values()
    return smallest_three.quaternions(
        fields["quaternions"].levels.astype(np.uint8), fields["omitted"].levels[:, 0].astype(np.uint8)
    )


def shape_quats(quats: Float64[np.ndarray, "M 4"]) -> Float64[np.ndarray, "M 4"]:
    """Return the quaternions with the sign in which they are quantised."""
    return smallest_three.with_sign(quats, smallest_three.omitted_components(quats))


def _fields(
    values: Float64[np.ndarray, "M 8"], wanted: ShapeValues, chosen: ShapeLevels, tables: ByteTables
) -> dict[str, Quantized]:
    opacities = chosen.levels[:, :1].astype(np.uint8)
    hidden = values[:, 0] <= tables.opacity_logits[1]  # no renderer draws them: they stay invisible
    opacities[hidden, 0] = np.rint(255 / (1 + np.exp(-values[hidden, 0])))
    scale_table, scales = without_unused(chosen.scale_table, chosen.levels[:, 1:4])
    ends = np.full(3, smallest_three.TABLE[-1], np.float32)
    return {
        "opacities": table_field(tables.opacity_logits.astype(np.float32), opacities),
        "scales": table_field(scale_table, scales),
        "quaternions": Quantized(chosen.levels[:, 4:].astype(np.uint8), -ends, ends, 255),
        "omitted": Quantized(wanted.omitted[:, None], np.zeros(1, np.float32), np.full(1, 3, np.float32), 3),
    }


def _on_lattice(values: Float64[np.ndarray, "M C"], steps: Float[np.ndarray, " M"]) -> Float64[np.ndarray, "M C"]:
    every = np.reshape(steps, (-1, 1))
    return np.rint(values / every) * every
