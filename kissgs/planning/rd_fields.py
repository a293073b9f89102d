"""Levels of every attribute at one lambda, in the values that the container can hold."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from kissgs.core.array_types import Float, Float32, Float64, UInt8
from kissgs.core.signed_log import signed_exp, signed_log
from kissgs.core.splats import Splats
from kissgs.core.threads import Workers
from kissgs.planning import table_fields
from kissgs.planning.container_model import ContainerModel
from kissgs.planning.quantize import MEANS_TOP, Quantized, clip_outliers, means_bits, quantize_means
from kissgs.planning.rd_model import RdCriterion
from kissgs.planning.rdo_quantize import quantize_by_class, rdo_quantize_shapes
from kissgs.planning.sh_codebook import COEFFICIENTS, Codebook
from kissgs.settings import EncodeSettings

OUTLIERS = 1e-4
"""Share of base colours, at either end of a channel, that may be clipped so that the step of the others stays small."""


@dataclass(frozen=True, slots=True, eq=False)
class RdFields:
    """Quantises the attributes of M Gaussians.

    Attributes:
        container: what the container can hold.
        settings: settings of the encoder.
        criterion: costs, sensitivity classes and lambda.
        largest: largest change of each attribute, see :func:`kissgs.planning.rdo_quantize.largest_changes`.
        pool: threads.
    """

    container: ContainerModel
    settings: EncodeSettings
    criterion: RdCriterion
    largest: dict[str, Float64[np.ndarray, " M"]]
    pool: Workers

    def shapes(
        self, values: Float64[np.ndarray, "M 8"], shapes: Float32[np.ndarray, "M 28"], forms: UInt8[np.ndarray, " M"]
    ) -> dict[str, Quantized]:
        """Quantise opacity, log-scales and rotation.

        Args:
            values: opacity logit, log-scales and unit quaternion, in the stored form of each Gaussian.
            shapes: shape Hessians of :class:`kissgs.Sensitivity`.
            forms: form of each Gaussian, see :mod:`kissgs.planning.rotation_forms`.
        """
        criterion, largest, costs = self.criterion, self.largest, self.criterion.costs
        if self.container.tables is not None:
            hessians = shapes if self.settings.rdo_quantization else None
            return table_fields.rd_shape_fields(
                values, hessians, forms, criterion, largest, self.container.tables, self.pool
            )
        parts = (
            quantize_by_class(values[:, :1], costs.opacity, criterion, largest["opacities"]),
            quantize_by_class(values[:, 1:4], costs.scale, criterion, largest["scales"]),
            quantize_by_class(values[:, 4:], 3 * costs.rotation, criterion, largest["quaternions"]),
        )
        if self.settings.rdo_quantization:
            parts = rdo_quantize_shapes(values, parts, shapes, forms, criterion, largest, self.pool)
        return dict(zip(("opacities", "scales", "quaternions"), parts, strict=True))

    def means(self, ordered: Splats, coarser: Float[np.ndarray, " M"]) -> Quantized:
        """Quantise positions, with the bits that lambda asks for in each class.

        A Gaussian has at most ``coarser`` bits less than :func:`means_bits` gives for ``means_tolerance``.
        """
        means, criterion = ordered.means, self.criterion
        usual = means_bits(ordered, np.arange(len(ordered)), self.settings.means_tolerance)
        most = np.clip(16 - usual + coarser, 0, 8)
        unit = max(float(np.ptp(signed_log(means))), 1e-30) / MEANS_TOP
        steps = criterion.class_steps(criterion.costs.position)
        if self.container.tables is not None:
            each = np.array(steps)[criterion.classes]
            return table_fields.means_field(means, np.minimum(each, unit * 2**most / np.sqrt(2)))
        coarse = [max(np.floor(np.log2(step / unit) + 0.5), 0) for step in steps]
        return quantize_means(means, bits=16 - np.minimum(np.array(coarse)[criterion.classes], most).astype(np.int64))

    def colors(self, base: Float64[np.ndarray, "M 3"]) -> tuple[Quantized, int]:
        """Quantise base colours; return them and the number of clipped outliers."""
        criterion, cost, coarsest = self.criterion, self.criterion.costs.color, self.largest["f_dc"]
        if self.container.tables is not None:
            steps = table_fields.criterion_steps(cost, criterion, coarsest)
            return table_fields.color_field(base, steps, cost), 0
        finest = min(criterion.class_steps(cost))
        clipped = clip_outliers(base, step=finest, share=OUTLIERS)
        levels = quantize_by_class(clipped, cost, criterion, coarsest)
        return levels, int((clipped != base).any(axis=1).sum())


def decoded_sh(codebook: Codebook, ordered: Splats) -> Float32[np.ndarray, "M K 3"]:
    """Return the decoded shN coefficients."""
    coefficients = ordered.shN.shape[1]
    entries = codebook.centroids.values().reshape(-1, 3, COEFFICIENTS)[:, :, :coefficients].transpose(0, 2, 1)
    return np.ascontiguousarray(entries.astype(np.float32)[codebook.labels[: len(ordered)]])


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
    fields: dict[str, Quantized], values: Float64[np.ndarray, "M 8"], ordered: Splats
) -> dict[str, list[float]]:
    """Return the largest error per field and channel, in the unit of the field (positions: of the signed logarithm).

    Args:
        fields: levels of the Gaussians, in order.
        values: opacity logit, log-scales and unit quaternion, in the stored form of each Gaussian.
        ordered: the Gaussians.
    """
    quats = values[:, 4:]
    if "omitted" in fields:  # the sign of the missing component is not stored
        quats = table_fields.shape_quats(quats)
    pairs = {
        "means": (fields["means"].values(), signed_log(ordered.means)),
        "opacities": (fields["opacities"].values(), values[:, :1]),
        "scales": (fields["scales"].values(), values[:, 1:4]),
        "quaternions": (table_fields.decoded_quats(fields), quats),
        "f_dc": (fields["f_dc"].values(), ordered.sh0),
    }
    return {name: np.abs(found - wanted).max(axis=0).tolist() for name, (found, wanted) in pairs.items()}
