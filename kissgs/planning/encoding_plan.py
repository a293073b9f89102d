"""What an encoder has chosen for a scene: everything that the images will show."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from kissgs.core.array_types import Int
from kissgs.planning.layout import Grid
from kissgs.planning.quantize import Quantized
from kissgs.planning.rd_model import Costs
from kissgs.planning.sh_codebook import Codebook


@dataclass(frozen=True, slots=True, eq=False)
class EncodingPlan:
    """Levels of every cell, and what they lost.

    Attributes:
        grid: which Gaussian sits where.
        fields: levels by field of the metadata, one row per cell; ``f_rest_centroids``, one per entry.
        codebook: which entry each Gaussian has.
        classes: ``(M,)`` kind of each Gaussian, from 0; those of a kind have levels of their own.
        form_error: largest relative change of a covariance by the choice of its equivalent form.
        clipped_colors: number of Gaussians whose base colour, an outlier, was pulled in.
        errors: largest error that the choices may cause, base colours' making up for others included; per field and
            channel, in the field's own unit (positions: of their signed logarithm; f_rest_centroids: of the codebook's
            entries).
        costs: of one unit in each attribute, ``(M,)`` each; None where bits were not weighed.
        rd_lambda: of a bit, squared error; None where bits were not weighed.
        note: a sentence for people about Gaussians that were left out, if these are many; or empty.
    """

    grid: Grid
    fields: dict[str, Quantized]
    codebook: Codebook
    classes: Int[np.ndarray, " M"]
    form_error: float
    clipped_colors: int
    errors: dict[str, list[float]]
    costs: Costs | None = None
    rd_lambda: float | None = None
    note: str = ""
