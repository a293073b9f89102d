"""``FinetuneReport``: what fine-tuning took and gave."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any


@dataclass(frozen=True, slots=True, kw_only=True)
class FinetuneReport:
    """What fine-tuning took and gave.

    Attributes:
        steps: of training.
        target_source: what the levels were fitted to: "photos", or "renderings" of the scene as it was.
        source: of the views, for people.
        psnr_before: decibels, mean over held-out views (over those that were learned from, if none are), to their
            photographs or, where there are none, to renderings: of the container as it was chosen.
        psnr_after: the same after fine-tuning.
        bytes_before: of the container as it was chosen.
        bytes_after: the same after fine-tuning.
        kept: whether the fine-tuned container is the better one, and is what was written: less squared error than the
            other, once bytes are paid for at the price at which levels were chosen.
        seconds: wall time, judging included; without that of taking the pictures to learn from.
        note: a sentence for people about what they may not have expected, without a capital and a full stop; or none.
    """

    steps: int
    target_source: str
    source: str
    psnr_before: float
    psnr_after: float
    bytes_before: int
    bytes_after: int
    kept: bool
    seconds: float
    note: str = ""

    def as_dict(self) -> dict[str, Any]:
        """For machines; what is infinite is null."""
        told = asdict(self)
        for name in ("psnr_before", "psnr_after"):
            told[name] = None if told[name] == float("inf") else told[name]
        return told
