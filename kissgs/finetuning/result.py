"""``FinetuneReport``: effort and results of fine-tuning."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any


@dataclass(frozen=True, slots=True, kw_only=True)
class FinetuneReport:
    """Effort and results of fine-tuning.

    Attributes:
        steps: number of training steps.
        target_source: training targets: "photos", or "renderings" of the original scene.
        source: description of the training views.
        psnr_before: PSNR of the container without fine-tuning, decibels: mean over the evaluation views, to photographs
            or, without them, to renderings of the original scene. Evaluation views are held-out views, or training
            views if there are none. None if no such container was made, because training the scene went on through
            fine-tuning.
        psnr_after: PSNR after fine-tuning, decibels.
        bytes_before: size of the container without fine-tuning, as a zip; None as before.
        bytes_after: size after fine-tuning, as a zip.
        kept: whether the fine-tuned container was kept: it has less squared error plus lambda times bits.
        seconds: wall time, evaluation included, preparation of the targets excluded.
        note: note for the user, a sentence without capital and full stop; may be empty.
    """

    steps: int
    target_source: str
    source: str
    psnr_before: float | None
    psnr_after: float
    bytes_before: int | None
    bytes_after: int
    kept: bool
    seconds: float
    note: str = ""

    def as_dict(self) -> dict[str, Any]:
        """Return the report for JSON; an infinite PSNR is None (null)."""
        values = asdict(self)
        for name in ("psnr_before", "psnr_after"):
            values[name] = None if values[name] == float("inf") else values[name]
        return values
