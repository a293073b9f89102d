"""How many Gaussians to keep: a count, a share, or as few as a loss of picture quality allows."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np

from kissgs.compaction.popspa import popspa
from kissgs.compaction.result import Compacted, CompactionReport
from kissgs.compaction.school import School, school
from kissgs.errors import UnsupportedError
from kissgs.evaluation.likeness import Evaluation
from kissgs.evaluation.pictures import evaluate
from kissgs.progress import Progress, as_stage, silent
from kissgs.search import seek
from kissgs.settings import CompactSettings
from kissgs.splats import Splats
from kissgs.views.view import Views

USUAL = 30.0
"""Decibels between a scene's pictures and photographs, where there are none to ask: about that of good captures."""

START, SLOPE, LARGEST = -2.0, 0.4, -0.1
"""First share that is tried, decibels that doubling it is about worth, and the largest share; powers of 2."""

GRAIN = 1 / 64
"""Of shares, the same: counts that are nearer to each other than 1 % are not told apart."""

NEAR = 0.02
"""Decibels to spare that are near enough."""


def compact_scene(
    splats: Splats,
    settings: CompactSettings,
    views: Views | None = None,
    *,
    judge: bool = False,
    checkpoint: Path | None = None,
    threads: int = 0,
    progress: Progress = silent,
) -> Compacted:
    """Fewer Gaussians for the same pictures, as the settings ask.

    Args:
        splats: clean.
        settings: with a budget.
        views: a capture: its views for training are learned from, those that are held out judge. By default virtual
            ones, and the scene itself is the teacher.
        judge: measure PSNR, SSIM and bytes after every step.
        checkpoint: see :func:`kissgs.compaction.popspa.popspa`.
        threads: 0 means one per processor; the result does not depend on it.
        progress: receives "cameras" and the stages of that.

    Raises:
        InvalidViewsError: a photograph cannot be read.
        OutputError: ``checkpoint`` is of other work, or cannot be written.
        UnsupportedError: no budget is given; no torch to train with; too little memory.
    """
    if not settings.wanted:
        raise UnsupportedError("how many Gaussians to keep is not said; give count, ratio or max_psnr_drop")
    count = settings.count or max(1, round(len(splats) * (settings.ratio or 0.0)))
    if count >= len(splats):
        return _unchanged(splats, "no more than asked for")
    taught = school(splats, views, settings, threads=threads, progress=progress)
    if settings.max_psnr_drop is None:
        return popspa(
            *(splats, count, settings, taught),
            judge=judge,
            checkpoint=checkpoint,
            threads=threads,
            progress=progress,
        )
    if checkpoint is not None:
        raise UnsupportedError("a search for a drop of PSNR keeps no checkpoint; give a count or a ratio with it")
    return _Search(splats, settings, taught, judge, threads, progress).run(settings.max_psnr_drop)


def _unchanged(splats: Splats, why: str) -> Compacted:
    note = f"the scene has {len(splats):,} Gaussians, {why}: it stays as it is"
    report = CompactionReport(
        source_count=len(splats), count=len(splats), taught_by="nothing", source="", steps=(), note=note
    )
    return Compacted(splats, np.arange(len(splats)), report)


def drop_of(evaluation: Evaluation) -> float:
    """By how many decibels a scene's pictures have become worse.

    Where there are no photographs to ask, as if the scene had been :data:`USUAL` decibels from them and the new errors
    were independent of those: squared errors then add up. (Of fox it predicts 0.40 dB where 0.38 are measured.)
    """
    change = evaluation.mean.change
    if change is not None:
        return -change
    return 10 * math.log10(1 + 10 ** ((USUAL - min(evaluation.mean.between.psnr, 1e3)) / 10))


class _Search:
    """For the fewest Gaussians whose pictures lose no more than is allowed."""

    def __init__(
        self, splats: Splats, settings: CompactSettings, taught: School, judge: bool, threads: int, progress: Progress
    ) -> None:
        self.splats, self.settings, self.school, self.judge = splats, settings, taught, judge
        self.threads, self.progress = threads, progress
        self.trials: list[tuple[int, float]] = []
        self.best: Compacted | None = None

    def run(self, allowed: float) -> Compacted:
        """All attempts; the scene as it was where none loses so little."""
        least = -math.log2(len(self.splats))
        seek(
            lambda share: allowed - self._drop(share, allowed), max(START, least), SLOPE, NEAR, (least, LARGEST), GRAIN
        )
        best = self.best or _unchanged(
            self.splats, f"and every smaller one that was tried loses more than {allowed:g} dB"
        )
        return replace(best, report=replace(best.report, trials=tuple(self.trials)))

    def _drop(self, share: float, allowed: float) -> float:
        count = max(1, round(len(self.splats) * 2**share))
        found = popspa(
            *(self.splats, count, self.settings, self.school),
            judge=self.judge,
            threads=self.threads,
            progress=self.progress,
        )
        compared = evaluate(
            *(self.splats, found.splats, self.school.exam),
            threads=self.threads,
            progress=as_stage("evaluate", self.progress),
        )
        drop = drop_of(compared)
        self.trials.append((count, drop))
        if drop <= allowed and (self.best is None or count < len(self.best.splats)):
            self.best = found
        return drop
