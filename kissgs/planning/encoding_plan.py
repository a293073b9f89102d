"""``EncodingPlan``: the result of planning, independent of the container format; ``Encoded``: the files of it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from kissgs.core.array_types import Int, UInt8
from kissgs.core.positions import Origin
from kissgs.planning.layout import Grid
from kissgs.planning.quantize import Quantized
from kissgs.planning.rd_criterion import Costs
from kissgs.planning.sh_codebook import Codebook


@dataclass(frozen=True, slots=True)
class PlannedScene:
    """Facts of the scene that was planned, so that the scene itself is not needed any more."""

    count: int
    visible: int  # number of Gaussians that the plan could keep: those that a renderer draws, or all
    sh_degree: int
    origin: Origin
    antialiased: bool
    first_view: Mapping[str, Any] | None = None  # with which viewers open the scene, for the metadata


@dataclass(frozen=True, slots=True, eq=False)
class EncodingPlan:
    """Levels of every cell, and the errors that they cause."""

    scene: PlannedScene
    grid: Grid
    fields: dict[str, Quantized]  # by name in the metadata; one row per cell, or per entry of f_rest_centroids
    codebook: Codebook
    classes: UInt8[np.ndarray, " M"]  # sensitivity class of each Gaussian, from 0; each class has its own step
    form_error: float  # largest relative change of a covariance by the choice of its equivalent form
    clipped_colors: int  # number of Gaussians whose base colour, an outlier, was clipped
    # largest quantisation error per field and channel, in the field's own unit (positions: of their signed logarithm;
    # f_rest_centroids: of the codebook's entries). Base colours include the compensation of other errors
    errors: dict[str, list[float]]
    costs: Costs | None = None  # squared error of one unit in each attribute, ``(M,)`` each; None for uniform planning
    rd_lambda: float | None = None  # squared error per bit; None for uniform planning
    note: str = ""  # a sentence for the user if many Gaussians were pruned; else empty
    coarse: str = ""  # a sentence for the user if the positions are too coarse for the Gaussians; else empty


@dataclass(frozen=True, slots=True)
class Encoded:
    """A container in memory, and figures of its encoding, some of them those of :class:`EncodingPlan`."""

    files: dict[str, bytes]  # name -> bytes, in the order in which they are best stored
    order: Int[np.ndarray, " M"]  # index in the encoded scene of every Gaussian, in the container's order
    form_error: float
    invisible: int  # number of Gaussians pruned because no renderer draws them
    pruned_by_rd: int  # number of Gaussians pruned because removing them costs less than their bits
    clipped_colors: int
    errors: dict[str, list[float]]
    rd_lambda: float | None
    codebook_side: int  # S; the codebook has up to S × S entries
    note: str = ""
    coarse: str = ""

    @classmethod
    def of(cls, plan: EncodingPlan, files: dict[str, bytes]) -> Encoded:
        """Return the files of a plan with the plan's figures."""
        order, scene = plan.grid.cells[plan.grid.mask], plan.scene
        return cls(
            files=files,
            order=order,
            form_error=plan.form_error,
            invisible=scene.count - scene.visible,
            pruned_by_rd=scene.visible - len(order),
            clipped_colors=plan.clipped_colors,
            errors=plan.errors,
            rd_lambda=plan.rd_lambda,
            codebook_side=plan.codebook.side,
            note=plan.note,
            coarse=plan.coarse,
        )
