"""How many Gaussians to keep: a count, a share, or as few as a loss of picture quality allows."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from kissgs.cameras.views import Views
from kissgs.compaction.popspa import popspa
from kissgs.compaction.result import Compacted, CompactionReport
from kissgs.core.errors import StopSearch, UnsupportedError
from kissgs.core.progress import Progress, as_stage, silent
from kissgs.core.root_finding import find_root
from kissgs.core.splats import Splats
from kissgs.evaluation.cameras import evaluation_views
from kissgs.evaluation.evaluate import Rendering, compare_images
from kissgs.evaluation.psnr_loss import ESTIMATED_DROP, SEARCH_SEED, drop_of
from kissgs.rendering.gsplat_backend import need_cuda
from kissgs.rendering.rasterizer import Device
from kissgs.settings import CompactSettings
from kissgs.training.supervision import SCORING_STRIDE, SupervisionViews, supervision_views

if TYPE_CHECKING:
    from kissgs.evaluation.results import Evaluation
    from kissgs.training.targets import TrainingTargets

START, SLOPE, LARGEST = -2.0, 0.4, -0.1
"""First share that is tried, decibels that doubling it is about worth, and the largest share; powers of 2."""

GRAIN = 1 / 64
"""Of shares, the same: counts that are nearer to each other than 1 % are not told apart."""

NEAR = 0.02
"""Decibels to spare that are near enough."""

NO_CHECKPOINT = "a search for a {} keeps no checkpoint; give a count or a ratio with it"


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
            ones teach, by pictures of the scene itself, and cameras drawn over the whole scene judge.
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
    if not settings.enabled:
        raise UnsupportedError("how many Gaussians to keep is not said; give count, ratio or max_psnr_drop")
    if settings.auto_count:
        raise UnsupportedError(
            "a goal is that of a container: kissgs compress; here give count, ratio or max_psnr_drop"
        )
    if settings.max_psnr_drop is not None and checkpoint is not None:
        raise UnsupportedError(NO_CHECKPOINT.format("drop of PSNR"))
    count = settings.count or max(1, round(len(splats) * (settings.ratio or 0.0)))
    if count >= len(splats):
        return unchanged(splats, "no more than asked for")
    compactor = Compactor.of(splats, settings, views, threads=threads, device=device, progress=progress)
    if settings.max_psnr_drop is None:
        return compactor(count, judges=judges, checkpoint=checkpoint)
    return _Search(compactor).run(settings.max_psnr_drop)


def unchanged(splats: Splats, why: str) -> Compacted:
    """All of them."""
    count = f"{len(splats):,} Gaussian{'' if len(splats) == 1 else 's'}"
    note = f"the scene has {count}, {why}: it stays as it is"
    report = CompactionReport(
        source_count=len(splats), count=len(splats), target_source="nothing", source="", steps=(), note=note
    )
    return Compacted(splats, np.arange(len(splats)), report)


@dataclass(slots=True, eq=False)
class Compactor:
    """Compacts one scene, to several counts if need be: what is learned from is drawn or read once.

    Attributes:
        splats: clean.
        settings: of the recipe.
        supervision: views to learn from.
        threads: see :func:`compact_scene`.
        device: see the same.
        progress: see the same.
        judges: views to judge by; None: cameras drawn over the whole scene.
    """

    splats: Splats
    settings: CompactSettings
    supervision: SupervisionViews
    threads: int
    device: Device
    progress: Progress
    judges: Views | None = None
    _taken: dict[str, Rendering] | None = None
    _targets: TrainingTargets | None = None

    @classmethod
    def of(
        cls,
        splats: Splats,
        settings: CompactSettings,
        views: Views | None,
        *,
        threads: int = 0,
        device: Device = "cpu",
        progress: Progress = silent,
    ) -> Compactor:
        """See :func:`compact_scene` for arguments and errors."""
        if settings.trains and find_spec("torch") is None:
            raise UnsupportedError(
                "training is done with torch, which is missing: pip install 'kissgs[train]' (a CPU build will do); the "
                "preset fast only prunes, and needs none"
            )
        if settings.trains and device == "cuda":
            need_cuda()
        scored = SCORING_STRIDE if settings.trains else 1
        taught = supervision_views(splats, views, settings, scoring_stride=scored, threads=threads, progress=progress)
        return cls(splats, settings, taught, threads, device, progress, None if views is None else taught.eval_views)

    def __call__(self, count: int, *, judges: bool = False, checkpoint: Path | None = None) -> Compacted:
        """Down to ``count``, which is less than the scene has."""
        if self._targets is None and self.settings.trains:
            from kissgs.training.targets import training_targets

            self._targets = training_targets(
                *(self.splats, self.supervision.train, self.supervision.background),
                threads=self.threads,
                device=self.device,
                progress=self.progress,
            )
        return popspa(
            *(self.splats, count, self.settings, self.supervision),
            targets=self._targets,
            judges=judges,
            checkpoint=checkpoint,
            threads=self.threads,
            device=self.device,
            progress=self.progress,
        )

    def pictures(self, found: Compacted) -> Evaluation:
        """From views that were not learned from, beside those of the scene."""
        progress = as_stage("evaluate", self.progress)
        if self.judges is None:
            drawn = evaluation_views(self.splats, seed=SEARCH_SEED, threads=self.threads, progress=progress)
            self.judges, self._taken = drawn, {}
        return compare_images(
            self.splats,
            found.splats,
            self.judges,
            threads=self.threads,
            reference_images=self._taken,
            progress=progress,
        )

    @property
    def note(self) -> str:
        """How a drop is told, where that needs to be said."""
        return "" if any(view.photo for view in self.supervision.test) else ESTIMATED_DROP


class _Search:
    """For the fewest Gaussians whose pictures lose no more than is allowed."""

    def __init__(self, compactor: Compactor) -> None:
        self.compactor = compactor
        self.trials: dict[int, float] = {}
        self.best: Compacted | None = None

    def run(self, allowed: float) -> Compacted:
        """All attempts; the scene as it was where none loses so little."""
        splats = self.compactor.splats
        least = -math.log2(len(splats))
        try:
            find_root(
                lambda share: allowed - self._drop(share, allowed),
                max(START, least),
                SLOPE,
                NEAR,
                (least, LARGEST),
                GRAIN,
            )
        except StopSearch:
            if self.best is None:
                raise
        best = self.best or unchanged(splats, f"and every smaller one that was tried loses more than {allowed:g} dB")
        note = "; ".join(filter(None, [best.report.note, self.compactor.note]))
        return replace(best, report=replace(best.report, trials=tuple(self.trials.items()), note=note))

    def _drop(self, share: float, allowed: float) -> float:
        everything = len(self.compactor.splats)
        count = min(max(1, round(everything * 2**share)), everything - 1)
        if count in self.trials:
            return self.trials[count]
        found = self.compactor(count)
        drop = self.trials[count] = drop_of(self.compactor.pictures(found))
        if drop <= allowed and (self.best is None or count < len(self.best.splats)):
            self.best = found
        return drop
