"""``EncodingPlan``: the encoder's decisions for a scene, independent of the container format."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from kissgs.core.array_types import UInt8
from kissgs.core.origin import Origin
from kissgs.planning.gaussian_costs import Costs
from kissgs.planning.layout import Grid
from kissgs.planning.quantize import Quantized
from kissgs.planning.sh_codebook import Codebook


@dataclass(frozen=True, slots=True)
class PlannedScene:
    """Facts of the scene that was planned, so that the scene itself is not needed any more.

    Attributes:
        count: number of Gaussians.
        visible: number of Gaussians that the plan could keep: those that a renderer draws, or all.
        sh_degree: 0 to 3.
        origin: see :class:`kissgs.Splats`.
        antialiased: see :class:`kissgs.Splats`.
    """

    count: int
    visible: int
    sh_degree: int
    origin: Origin
    antialiased: bool


@dataclass(frozen=True, slots=True, eq=False)
class EncodingPlan:
    """Levels of every cell, and the errors that they cause.

    Attributes:
        scene: the scene that was planned.
        grid: cell of each Gaussian.
        fields: levels by field of the metadata, one row per cell; ``f_rest_centroids``: one row per entry.
        codebook: the SH codebook, and the entry of each Gaussian.
        classes: ``(M,)`` sensitivity class of each Gaussian, from 0; each class has its own step.
        form_error: largest relative change of a covariance by the choice of its equivalent form.
        clipped_colors: number of Gaussians whose base colour, an outlier, was clipped.
        errors: largest quantisation error per field and channel, in the field's own unit (positions: of their signed
            logarithm; f_rest_centroids: of the codebook's entries). Base colours include the compensation of other
            errors.
        costs: squared error of one unit in each attribute, ``(M,)`` each; None for uniform planning.
        rd_lambda: squared error per bit; None for uniform planning.
        note: a sentence for the user if many Gaussians were pruned; else empty.
        coarse: a sentence for the user if the positions are too coarse for the Gaussians; else empty.
    """

    scene: PlannedScene
    grid: Grid
    fields: dict[str, Quantized]
    codebook: Codebook
    classes: UInt8[np.ndarray, " M"]
    form_error: float
    clipped_colors: int
    errors: dict[str, list[float]]
    costs: Costs | None = None
    rd_lambda: float | None = None
    note: str = ""
    coarse: str = ""
