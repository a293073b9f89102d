"""Levels of every attribute for containers with :class:`~kissgs.planning.container_model.ByteTables`."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from kissgs.core.array_types import Float, Float32, Float64
from kissgs.core.signed_log import signed_log
from kissgs.planning import smallest_three
from kissgs.planning.container_model import ByteTables
from kissgs.planning.quantize import MEANS_TOP, Quantized, even_table
from kissgs.planning.rd_criterion import RdCriterion
from kissgs.planning.value_table import fit_table, nearest_levels, table_field, without_unused


def stored_values(values: Float64[np.ndarray, "M 8"], tables: ByteTables) -> Float64[np.ndarray, "M 8"]:
    """Return opacity logits, log-scales and quaternions in the form in which they are quantised.

    Logits are clipped to those of the levels that may be used; beyond, opacities differ by less than 1/255.
    """
    lowest, highest = tables.opacity_logits[[tables.first_drawn, tables.last_drawn]]
    opacities = np.clip(values[:, :1], lowest, highest)
    return np.concatenate([opacities, values[:, 1:4], shape_quats(values[:, 4:])], axis=1)


def rounded_shapes(
    values: Float64[np.ndarray, "M 8"],
    weights: Float64[np.ndarray, " M"],
    steps: tuple[Float64[np.ndarray, " M"], Float64[np.ndarray, " M"], Float64[np.ndarray, " M"]],
    tables: ByteTables,
) -> dict[str, Quantized]:
    """Round opacity, log-scales and quaternion of :func:`stored_values` to steps of each Gaussian's own.

    ``weights`` are squared image errors per squared unit of the log-scales.
    """
    quats = values[:, 4:]
    opacities = nearest_levels(tables.opacity_logits, _on_lattice(values[:, :1], steps[0]))
    finest = float(steps[1].min())
    scales = _on_lattice(values[:, 1:4], np.clip(np.rint(steps[1] / finest), 1, 255) * finest)
    scale_table = fit_table(scales.ravel(), np.repeat(weights, 3), finest)
    omitted = smallest_three.omitted_components(quats)
    small = smallest_three.stored_components(quats, omitted)
    return {
        "opacities": Quantized(
            np.clip(opacities, tables.first_drawn, tables.last_drawn), tables.opacity_logits[:, None]
        ),
        "scales": Quantized(nearest_levels(scale_table, scales), scale_table.astype(np.float64)[:, None]),
        "quaternions": Quantized(
            smallest_three.lattice_levels(small, smallest_three.strides(steps[2])), smallest_three.TABLE[:, None]
        ),
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
    used = without_unused(scales.table[:, 0].astype(np.float32), scales.levels)
    return {**fields, "opacities": replace(fields["opacities"], levels=opacities), "scales": table_field(*used)}


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

    Levels are multiples of a power of two, up to 256, of about the step of each Gaussian, so that low bytes compress.
    """
    logs = signed_log(means)
    low, high = (_as_text(end.astype(np.float32)) for end in (logs.min(axis=0), logs.max(axis=0)))
    table = even_table(low, high, MEANS_TOP)
    extent = high.astype(np.float32).astype(np.float64) - low.astype(np.float32)
    unit = np.where(extent > 0, extent, np.inf) / MEANS_TOP
    exponents = np.log2(np.maximum(np.reshape(steps, (-1, 1)) / unit, 1))
    every = np.exp2(np.clip(np.floor(exponents + 0.5), 0, 8))
    levels = np.clip(np.rint((logs - low.astype(np.float32)) / unit / every) * every, 0, MEANS_TOP)
    stride = np.broadcast_to(every, levels.shape).astype(np.int64)
    return Quantized(levels.astype(np.uint16), table, stride)


def _as_text(ends: Float32[np.ndarray, " C"]) -> Float64[np.ndarray, " C"]:
    """Return the shortest decimal numbers that stand for these, which the container stores as text."""
    return np.array([float(str(value + np.float32(0))) for value in ends])


def decoded_quats(fields: dict[str, Quantized]) -> Float64[np.ndarray, "M 4"]:
    """Return the quaternions of a plan's fields, stored whole or as three components."""
    if "omitted" not in fields:
        return fields["quaternions"].values()
    return smallest_three.whole(fields["quaternions"].values(), fields["omitted"].levels[:, 0])


def shape_quats(quats: Float64[np.ndarray, "M 4"]) -> Float64[np.ndarray, "M 4"]:
    """Return the quaternions with the sign in which they are quantised."""
    return smallest_three.with_sign(quats, smallest_three.omitted_components(quats))


def _on_lattice(values: Float64[np.ndarray, "M C"], steps: Float[np.ndarray, " M"]) -> Float64[np.ndarray, "M C"]:
    every = np.reshape(steps, (-1, 1))
    return np.rint(values / every) * every
