"""How many Gaussians to keep: a count, a share, or as few as a loss of picture quality allows."""

from __future__ import annotations

import math
from dataclasses import replace
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from kissgs.compaction.popspa import popspa
from kissgs.compaction.result import Compacted, CompactionReport
from kissgs.errors import UnsupportedError
from kissgs.evaluation.likeness import Evaluation
from kissgs.evaluation.pictures import evaluate
from kissgs.progress import Progress, as_stage, silent
from kissgs.rendering.gsplat_backend import need_cuda
from kissgs.rendering.rasterizer import Device
from kissgs.search import seek
from kissgs.settings import CompactSettings
from kissgs.splats import Splats
from kissgs.training.school import SCORED, School, school
from kissgs.views.view import Views

if TYPE_CHECKING:
    from kissgs.training.lessons import Lessons

USUAL = 30.0
"""Decibels between a scene's pictures and photographs, where there are none to ask: about that of good captures."""

START, SLOPE, LARGEST = -2.0, 0.4, -0.1
"""First share that is tried, decibels that doubling it is about worth, and the largest share; powers of 2."""

MODELLED = f"without photographs, the drop is that of a scene {USUAL:g} dB from them to which the new errors are added"

GRAIN = 1 / 64
"""Of shares, the same: counts that are nearer to each other than 1 % are not told apart."""

NEAR = 0.02
"""Decibels to spare that are near enough."""


def compact_scene(
    splats: Splats,
    settings: CompactSettings,
    views: Views | None = None,
    *,
    judges: bool = False,
    checkpoint: Path | None = None,
    threads: int = 0,
    device: Device = "cpu",
    progress: Progress = silent,
) -> Compacted:
    """Fewer Gaussians for the same pictures, as the settings ask.

    Args:
        splats: clean.
        settings: with a budget.
        views: a capture: its views for training are learned from, those that are held out judge. By default virtual
            ones, and the scene itself is the teacher.
        judges: measure PSNR, SSIM and bytes after every step, unless several compactions are tried.
        checkpoint: see :func:`kissgs.compaction.popspa.popspa`.
        threads: 0 means one per processor; the result does not depend on it.
        device: see the same.
        progress: receives "cameras" and the stages of that.

    Raises:
        InvalidViewsError: a photograph cannot be read.
        OutputError: ``checkpoint`` is of other work, or cannot be written.
        UnsupportedError: no budget is given; no torch or no GPU to train with; too little memory.
    """
    if not settings.wanted:
        raise UnsupportedError("how many Gaussians to keep is not said; give count, ratio or max_psnr_drop")
    if settings.max_psnr_drop is not None and checkpoint is not None:
        raise UnsupportedError("a search for a drop of PSNR keeps no checkpoint; give a count or a ratio with it")
    count = settings.count or max(1, round(len(splats) * (settings.ratio or 0.0)))
    if count >= len(splats):
        return _unchanged(splats, "no more than asked for")
    if settings.trains and find_spec("torch") is None:
        raise UnsupportedError(
            "training is done with torch, which is missing: pip install 'kissgs[train]' (a CPU build will do); the "
            "preset fast only prunes, and needs none"
        )
    if settings.trains and device == "cuda":
        need_cuda()
    scored = SCORED if settings.trains else 1
    taught = school(splats, views, settings, scored=scored, threads=threads, progress=progress)
    if settings.max_psnr_drop is None:
        return popspa(
            *(splats, count, settings, taught),
            judges=judges,
            checkpoint=checkpoint,
            threads=threads,
            device=device,
            progress=progress,
        )
    return _Search(splats, settings, taught, threads, device, progress).run(settings.max_psnr_drop)


def _unchanged(splats: Splats, why: str) -> Compacted:
    count = f"{len(splats):,} Gaussian{'' if len(splats) == 1 else 's'}"
    note = f"the scene has {count}, {why}: it stays as it is"
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
        self,
        splats: Splats,
        settings: CompactSettings,
        taught: School,
        threads: int,
        device: Device,
        progress: Progress,
    ) -> None:
        self.splats, self.settings, self.school = splats, settings, taught
        self.lessons: Lessons | None = None
        self.threads, self.device, self.progress = threads, device, progress
        self.trials: dict[int, float] = {}
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
        modelled = "" if any(view.photo for view in self.school.test) else MODELLED
        note = "; ".join(filter(None, [best.report.note, modelled]))
        return replace(best, report=replace(best.report, trials=tuple(self.trials.items()), note=note))

    def _drop(self, share: float, allowed: float) -> float:
        count = min(max(1, round(len(self.splats) * 2**share)), len(self.splats) - 1)
        if count in self.trials:
            return self.trials[count]
        if self.lessons is None and self.settings.trains:
            from kissgs.training.lessons import lessons

            taught = self.school
            self.lessons = lessons(
                *(self.splats, taught.train, taught.background),
                threads=self.threads,
                device=self.device,
                progress=self.progress,
            )
        found = popspa(
            *(self.splats, count, self.settings, self.school),
            lessons=self.lessons,
            threads=self.threads,
            device=self.device,
            progress=self.progress,
        )
        compared = evaluate(
            *(self.splats, found.splats, self.school.exam),
            threads=self.threads,
            progress=as_stage("judge", self.progress),
        )
        drop = drop_of(compared)
        self.trials[count] = drop
        if drop <= allowed and (self.best is None or count < len(self.best.splats)):
            self.best = found
        return drop
