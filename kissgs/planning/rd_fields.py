"""Levels of every attribute at one lambda, in the values that the container can hold."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from kissgs.core.array_types import Float32, Float64, Int
from kissgs.core.resources import Workers
from kissgs.core.signed_log import signed_exp, signed_log
from kissgs.core.splats import Splats
from kissgs.planning import table_fields
from kissgs.planning.container_model import Planning
from kissgs.planning.quantize import MEANS_TOP, Quantized, clip_outliers, log_extent, means_bits, quantize_means
from kissgs.planning.rd_criterion import RdCriterion
from kissgs.planning.rdo_quantize import quantize_by_class, rdo_quantize
from kissgs.planning.rotation_forms import StoredShapes
from kissgs.planning.rows import Rows, for_each_block, selected
from kissgs.planning.sh_codebook import COEFFICIENTS, Codebook

OUTLIERS = 1e-4
"""Share of base colours, at either end of a channel, that may be clipped so that the step of the others stays small."""


@dataclass(frozen=True, slots=True, eq=False)
class RdFields:
    """Quantises the attributes of M Gaussians."""

    planning: Planning
    criterion: RdCriterion
    largest: Mapping[str, Rows]  # see largest_changes

    def shapes(self, values: StoredShapes, hessians: Rows) -> dict[str, Quantized]:
        """Quantise opacity, log-scales and rotation."""
        criterion, largest, tables = self.criterion, self.largest, self.planning.container.tables
        wanted: StoredShapes | Float64[np.ndarray, "M 8"] = values
        if tables is None:
            fields = {
                field: quantize_by_class(
                    rows, criterion.steps_of(name), criterion.classes, largest[field], self.planning.pool
                )
                for rows, name, field in (
                    (values.opacities, "opacity", "opacities"),
                    (values.scales, "scale", "scales"),
                    (values.quats, "rotation", "quaternions"),
                )
            }
        else:
            logits = values.opacities[:][:, 0].astype(np.float64)
            wanted = table_fields.stored_values(values[:], tables)
            opacity, scale, rotation = (
                table_fields.criterion_steps(name, criterion, largest[field][:])
                for name, field in (("opacity", "opacities"), ("scale", "scales"), ("rotation", "quaternions"))
            )
            fields = table_fields.rounded_shapes(wanted, criterion.costs.scale, (opacity, scale, rotation), tables)
        if self.planning.settings.rdo_quantization:
            fields = rdo_quantize(
                wanted, fields, hessians, values.forms, criterion, largest, self.planning.pool, tables
            )
            if tables is None:
                fields = {name: field.from_zero() for name, field in fields.items()}
        return fields if tables is None else table_fields.finished_shapes(fields, logits, tables)

    def means(self, splats: Splats, order: Int[np.ndarray, " M"], coarser: Int[np.ndarray, " M"]) -> Quantized:
        """Quantise the positions of the Gaussians ``order``, with the bits that lambda asks for in each class.

        A Gaussian has at most ``coarser`` bits less than :func:`means_bits` gives for ``means_tolerance``.
        """
        means, criterion, pool = selected(splats.means, order), self.criterion, self.planning.pool
        usual = means_bits(splats, order, self.planning.settings.means_tolerance, pool)
        most = np.clip(16 - usual + coarser, 0, 8)
        unit = max(log_extent(means, pool), 1e-30) / MEANS_TOP
        steps = criterion.steps_of("position")
        if self.planning.container.tables is not None:
            each = np.array(steps)[criterion.classes]
            return table_fields.means_field(means[:], np.minimum(each, unit * 2.0**most / np.sqrt(2)))
        coarse = np.array([min(max(np.floor(np.log2(step / unit) + 0.5), 0), 8) for step in steps]).astype(np.int8)
        return quantize_means(means, bits=16 - np.minimum(coarse[criterion.classes], most), pool=pool)

    def colors(self, base: Float32[np.ndarray, "M 3"]) -> tuple[Quantized, int]:
        """Quantise base colours; return them and the number of clipped outliers."""
        criterion, coarsest = self.criterion, self.largest["f_dc"]
        if self.planning.container.tables is not None:
            steps = table_fields.criterion_steps("color", criterion, coarsest[:])
            return table_fields.color_field(base.astype(np.float64), steps, criterion.costs.color), 0
        optimal = criterion.steps_of("color")
        clipped = clip_outliers(base, step=min(optimal), share=OUTLIERS)
        levels = quantize_by_class(clipped, optimal, criterion.classes, coarsest, self.planning.pool)
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
    quats = table_fields.decoded_quats(fields)
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
            quats = table_fields.shape_quats(quats)
        pairs = {
            "means": (some["means"].values(), signed_log(means[rows])),
            "opacities": (some["opacities"].values(), wanted[:, :1]),
            "scales": (some["scales"].values(), wanted[:, 1:4]),
            "quaternions": (table_fields.decoded_quats(some), quats),
            "f_dc": (some["f_dc"].values(), colors[rows]),
        }
        return {name: np.abs(found - wanted).max(axis=0) for name, (found, wanted) in pairs.items()}

    blocks = for_each_block(len(values), largest, pool)
    return {name: np.max([block[name] for block in blocks], axis=0).tolist() for name in blocks[0]}
