"""``Encoded``: the files of a container in memory, and figures of its encoding."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from kissgs.core.array_types import Int
from kissgs.planning.encoding_plan import EncodingPlan


@dataclass(frozen=True, slots=True)
class Encoded:
    """A container in memory, and figures of its encoding.

    Attributes:
        files: name -> bytes, in the order in which they are best stored.
        order: ``(M,)`` index in the encoded scene of every Gaussian of the container, in the container's order.
        form_error: largest relative change of a covariance by the plan of its equivalent form.
        invisible: number of Gaussians pruned because no renderer draws them.
        pruned_by_rd: number of Gaussians pruned because removing them costs less than their bits.
        clipped_colors: number of Gaussians with a clipped base colour (:func:`kissgs.planning.quantize.clip_outliers`).
        errors: largest quantisation error by field and channel (:class:`kissgs.planning.encoding_plan.EncodingPlan`).
        rd_lambda: squared error per bit; None for uniform planning.
        codebook_side: S; the codebook has up to S × S entries.
        note: a sentence for the user if many Gaussians were pruned; else empty.
        coarse: a sentence for the user if the positions are too coarse for the Gaussians; else empty.
    """

    files: dict[str, bytes]
    order: Int[np.ndarray, " M"]
    form_error: float
    invisible: int
    pruned_by_rd: int
    clipped_colors: int
    errors: dict[str, list[float]]
    rd_lambda: float | None
    codebook_side: int
    note: str = ""
    coarse: str = ""

    @classmethod
    def of(cls, plan: EncodingPlan, files: dict[str, bytes]) -> Encoded:
        """Return the files of a plan with the plan's figures."""
        scene = plan.scene
        return cls(
            files=files,
            order=plan.grid.cells[plan.grid.mask],
            form_error=plan.form_error,
            invisible=scene.count - scene.visible,
            pruned_by_rd=scene.visible - int(plan.grid.mask.sum()),
            clipped_colors=plan.clipped_colors,
            errors=plan.errors,
            rd_lambda=plan.rd_lambda,
            codebook_side=plan.codebook.side,
            note=plan.note,
            coarse=plan.coarse,
        )
