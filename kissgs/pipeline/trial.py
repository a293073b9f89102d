"""``Trial``: one container that a search for a goal made, with its size and quality."""

from __future__ import annotations

from dataclasses import asdict, dataclass, replace
from typing import TYPE_CHECKING, Any

from kissgs.evaluation.psnr_loss import drop_of, over_scene, psnr_of, ssim_drop_of
from kissgs.evaluation.results import as_json

if TYPE_CHECKING:
    from kissgs.evaluation.results import Evaluation


@dataclass(frozen=True, slots=True)
class Trial:
    """One container that a search for a goal made.

    Attributes:
        count: Gaussians of the scene that was encoded.
        rd_lambda: squared error per bit; None if no Gaussian is visible, so that there was no rate-distortion planning.
        bytes: size of the zip, or of all files in the folder.
        psnr: PSNR of its renderings to those of the scene as goals count it, decibels
            (:func:`kissgs.evaluation.psnr_loss.psnr_of`); without a capture in other views than ``drop``, in those of
            ``worst`` and ``fifth_percentile``. None, as all that follow, where the goal is a size.
        drop: loss of PSNR as goals count it, decibels (:func:`kissgs.evaluation.psnr_loss.drop_of`).
        ssim_drop: loss of SSIM as goals count it (:func:`kissgs.evaluation.psnr_loss.ssim_drop_of`); None where that is
            no goal.
        against: what ``drop`` is a loss against: "photos", or "renderings", from which it is estimated.
        worst: PSNR of the worst view, decibels.
        fifth_percentile: fifth percentile of the views' PSNR, decibels.
    """

    count: int
    rd_lambda: float | None
    bytes: int
    psnr: float | None = None
    drop: float | None = None
    ssim_drop: float | None = None
    worst: float | None = None
    fifth_percentile: float | None = None
    against: str | None = None

    def with_evaluation(self, evaluation: Evaluation, *, ssim: bool = False) -> Trial:
        """Return a copy with the figures of an evaluation, also those of SSIM if requested."""
        scene = over_scene(evaluation)
        worst, fifth = scene.worst.comparison.candidate_vs_reference.psnr, scene.fifth_percentile
        return replace(
            self,
            psnr=psnr_of(evaluation),
            drop=drop_of(evaluation),
            ssim_drop=ssim_drop_of(evaluation) if ssim else None,
            worst=worst,
            fifth_percentile=fifth,
            against=evaluation.against,
        )

    def summary(self) -> str:
        """Return size and quality in one phrase: "812 kB at 41.20 dB, drop 0.120 dB, worst view 35.1 dB"."""
        quality = self.quality()
        return f"{self.bytes / 1000:,.0f} kB{quality and f' at {quality}'}"

    def quality(self) -> str:
        """Return the figures of quality in one phrase, empty where the goal is a size."""
        against = {"photos": " to photographs", "renderings": " by its renderings"}.get(self.against or "", "")
        parts = [
            None if self.psnr is None else f"{self.psnr:.2f} dB",
            None if self.drop is None else f"drop {self.drop:.3f} dB{against}",
            None if self.ssim_drop is None else f"SSIM drop {self.ssim_drop:.3g}",
            None if self.worst is None else f"worst view {self.worst:.1f} dB",
        ]
        return ", ".join(filter(None, parts))

    def as_dict(self) -> dict[str, Any]:
        """Return all fields for JSON: infinity as null, NaN (a failed rendering) as the string ``"NaN"``."""
        return {name: as_json(value) if isinstance(value, float) else value for name, value in asdict(self).items()}
