"""``Goal``: what a search for a container is to meet, and how far a container is from it."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

from kissgs.evaluation.results import MAX_VIEW_PSNR
from kissgs.pipeline.trial import Trial
from kissgs.settings import EncodeSettings

if TYPE_CHECKING:
    from kissgs.evaluation.results import Evaluation

NEAR_SSIM_DROP = -math.log2(0.95)
"""Margin of a drop of SSIM that is small enough: 5 % of the drop, for which a container takes some 3 % of bytes."""


@dataclass(frozen=True, slots=True)
class Goal:
    """A goal for a container: a size, a PSNR, or a drop of PSNR, of SSIM or of both.

    Attributes:
        settings: settings that name a goal.
        slope: typical change of :meth:`margin` per doubling of lambda.
        near: margin that is small enough to stop the search.
    """

    settings: EncodeSettings
    slope: float
    near: float

    @classmethod
    def of(cls, settings: EncodeSettings) -> Goal:
        """Return the goal of these settings.

        Near is 3 % of a size, 0.1 dB of a PSNR, 0.02 dB of a drop of PSNR and 5 % of a drop of SSIM.
        """
        if settings.target_size is not None:
            return cls(settings, 0.2, -math.log2(0.97))
        if settings.psnr is not None:
            return cls(settings, -1.5, 0.1)
        if settings.max_psnr_drop is None:
            return cls(settings, -0.6, NEAR_SSIM_DROP)
        return cls(settings, -0.5, -math.log2(max(1 - 0.02 / settings.max_psnr_drop, 0.5)))

    @property
    def by_size(self) -> bool:
        """Whether the goal is a size, so that no rendering is needed to evaluate it."""
        return self.settings.target_size is not None

    def measured(self, trial: Trial, evaluation: Evaluation) -> Trial:
        """Return a copy of a trial with the figures of its evaluation, those of SSIM only if they decide."""
        return trial.with_evaluation(evaluation, ssim=self.settings.max_ssim_drop is not None)

    def margin(self, trial: Trial) -> float:
        """Return by how much a trial exceeds the goal: at least 0 where it is met.

        The unit is log2 of a ratio for sizes and drops, and decibels for a PSNR. Infinite where nothing is lost at all:
        then the distance to the goal is unknown. Of two drops the smaller margin counts, where that of SSIM is scaled
        such that both have the same ``near``.
        """
        settings = self.settings
        if settings.target_size is not None:
            return math.log2(settings.target_size / trial.bytes)
        if settings.psnr is not None:
            return (trial.psnr or 0.0) - settings.psnr
        margins = []
        if settings.max_psnr_drop is not None:
            margins.append(_room(settings.max_psnr_drop, trial.drop))
        if settings.max_ssim_drop is not None:
            margins.append(_room(settings.max_ssim_drop, trial.ssim_drop) * self.near / NEAR_SSIM_DROP)
        return min(margins)

    def failure_message(self, trials: Sequence[Trial], *, suggest_compaction: bool) -> str:
        """Return why no trial meets the goal; ``suggest_compaction``: whether fewer Gaussians might, untried so far."""
        lambdas = [trial.rd_lambda for trial in trials if trial.rd_lambda]
        extreme = (max if self.by_size else min)(lambdas, default=None)
        trials = [trial for trial in trials if trial.rd_lambda in (None, extreme)]  # those at the extreme lambda
        if self.settings.target_size is not None:
            smallest, target = min(trial.bytes for trial in trials), int(self.settings.target_size)
            return (
                f"target_size {target:,} byte{'' if target == 1 else 's'} cannot be met: the smallest container found "
                f"has {smallest:,}; ask for at least that"
                + (", or for fewer Gaussians: --compact auto" * suggest_compaction)
            )
        if self.settings.psnr is not None:
            highest = math.floor(100 * max(trial.psnr or 0.0 for trial in trials)) / 100
            return (
                f"psnr {self.settings.psnr:g} dB cannot be met: the finest container found has {highest:.2f} dB; "
                "ask for at most that"
                + (f"; each view counts for at most {MAX_VIEW_PSNR:g} dB" if self.settings.psnr > MAX_VIEW_PSNR else "")
            )
        limits, found = [], []
        if self.settings.max_psnr_drop is not None:
            limits.append(f"max_psnr_drop {self.settings.max_psnr_drop:g} dB")
            found.append(f"{_smallest(trial.drop for trial in trials):.3g} dB")
        if self.settings.max_ssim_drop is not None:
            limits.append(f"max_ssim_drop {self.settings.max_ssim_drop:g}")
            found.append(f"{_smallest(trial.ssim_drop for trial in trials):.3g} of SSIM")
        return (
            f"{' and '.join(limits)} cannot be met: the finest container found loses {' and '.join(found)}; allow at "
            "least that"
        )


def _room(limit: float, drop: float | None) -> float:
    """Return log2 of the ratio of a limit to a drop; -∞ where the drop is unknown."""
    if drop is None or not drop < math.inf:  # infinite where the photographs equal the renderings of the scene
        return -math.inf
    if drop <= 0:  # a container may even be closer to the photographs than the scene
        return math.inf
    return math.log2(limit / drop)


def _smallest(drops: Iterable[float | None]) -> float:
    """Return the smallest drop, rounded up."""
    return 1.005 * min(math.inf if drop is None else drop for drop in drops)
