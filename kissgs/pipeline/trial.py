"""``Trial``: a container that a search has made on its way, and what it gave."""

from __future__ import annotations

from dataclasses import asdict, dataclass, replace
from typing import TYPE_CHECKING, Any

from kissgs.evaluation.psnr_loss import drop_of, psnr_of
from kissgs.evaluation.results import as_json

if TYPE_CHECKING:
    from kissgs.evaluation.results import Evaluation


@dataclass(frozen=True, slots=True)
class Trial:
    """A container that was made on the way to the one that was asked for.

    Attributes:
        count: Gaussians of the scene that was encoded.
        rd_lambda: squared error per bit; None where nothing is seen, and bits were not weighed.
        bytes: of its zip, or of the files in its folder.
        psnr: of its pictures to those of the scene, as goals count it (:func:`kissgs.evaluation.psnr_loss.psnr_of`),
            decibels; None where it was not asked for.
        drop: decibels that they have lost (:func:`kissgs.evaluation.psnr_loss.drop_of`); the same.
        worst: PSNR of the worst view; the same.
        fifth_percentile: of the views' PSNR; the same.
    """

    count: int
    rd_lambda: float | None
    bytes: int
    psnr: float | None = None
    drop: float | None = None
    worst: float | None = None
    fifth_percentile: float | None = None

    def with_pictures(self, seen: Evaluation) -> Trial:
        """The same, with what the pictures say of it."""
        worst, fifth = seen.worst.comparison.candidate_vs_reference.psnr, seen.fifth_percentile
        return replace(self, psnr=psnr_of(seen), drop=drop_of(seen), worst=worst, fifth_percentile=fifth)

    def spelled(self) -> str:
        """For people."""
        pictures = "" if self.psnr is None else f" at {self.psnr:.2f} dB"
        lost = "" if self.drop is None else f" (-{self.drop:.2f})"
        worst = "" if self.worst is None else f", worst view {self.worst:.1f} dB"
        return f"{self.bytes / 1000:,.0f} kB{pictures}{lost}{worst}"

    def as_dict(self) -> dict[str, Any]:
        """For machines; what is infinite is null, and NaN, of a picture that failed, the string ``"NaN"``."""
        return {name: as_json(value) if isinstance(value, float) else value for name, value in asdict(self).items()}
