"""Number of Gaussians to keep: a count, a share, or as few as a drop of PSNR allows."""

from __future__ import annotations

import math
import time
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from kissgs.cameras.views import View, Views
from kissgs.cameras.virtual.samples import random_poses
from kissgs.compaction.popspa import Popspa, StepLog
from kissgs.compaction.result import Compacted, CompactionReport, CountTrial
from kissgs.core.errors import StopSearch, UnsupportedError
from kissgs.core.progress import DEFAULT_CONTEXT, Context
from kissgs.core.root_finding import find_root
from kissgs.core.splats import Splats
from kissgs.evaluation.cameras import BACKGROUNDS, evaluation_views
from kissgs.evaluation.evaluate import Rendering, compare_images
from kissgs.evaluation.results import ESTIMATED_DROP, SEARCH_SEED, Evaluation, drop_of
from kissgs.rendering.rasterizer import need_cuda
from kissgs.settings import CompactSettings
from kissgs.training.supervision import SCORING_STRIDE, SupervisionViews, evaluation_only, supervision_views

if TYPE_CHECKING:
    pass


# ``SearchEvaluation``: how far the candidates of a search are from the original scene.

COUNT, SIDE = 24, 320
"""Number and side, pixels, of the views without a capture, apart from those drawn over the whole scene."""

KEPT_PIXELS = 2**24
"""Pixels of all held-out views of a capture up to which the renderings of the original are kept, 0.2 GB."""


@dataclass(slots=True, eq=False)
class SearchEvaluation:
    """Compares candidates with the original scene in views that nothing is trained or planned with.

    With a capture these are held-out views of it. Without one they are random poses from which photographs might have
    been taken, and their ``surroundings`` cameras drawn over the whole scene. What a container loses in such poses is
    near what it loses in photographs: for fox 0.7 to 1.5 dB more PSNR to the original, with and without training. Drawn
    cameras find 3 to 4 dB more without training and 0.5 with it, but they see every part of the scene.

    ``views`` are the capture, or some of its held-out views.
    """

    original: Splats
    views: Views | None
    seconds: float = field(init=False, default=0.0)  # that the latest comparison took
    _poses: Views | None = field(init=False, default=None)
    _drawn: Views | None = field(init=False, default=None)
    _images: dict[int, Rendering] = field(init=False, default_factory=dict)
    _drawn_images: dict[int, Rendering] = field(init=False, default_factory=dict)

    @classmethod
    def of(cls, original: Splats, views: Views | None, supervision: SupervisionViews) -> SearchEvaluation:
        """Return the evaluation for a compaction: with a capture in the views that it holds out."""
        return cls(original, None if views is None else supervision.eval_views)

    def __call__(self, candidate: Splats, context: Context = DEFAULT_CONTEXT) -> Evaluation:
        """Evaluate a candidate, always on the CPU; reports the stages "cameras", "kernels" and "evaluate"."""
        started = time.perf_counter()
        found = self._evaluation(candidate, replace(context, device="cpu"))
        self.seconds = time.perf_counter() - started
        return found

    def _evaluation(self, candidate: Splats, context: Context) -> Evaluation:
        if self.views is not None:
            pixels = sum(view.camera.width * view.camera.height for view in self.views.test)
            images = self._images if pixels <= KEPT_PIXELS else None
            return compare_images(self.original, candidate, self.views, context, reference_images=images)
        if self._poses is None or self._drawn is None:
            poses = random_poses(self.original, context, side=SIDE, count=COUNT, seed=SEARCH_SEED)
            self._drawn = evaluation_views(self.original, context, seed=SEARCH_SEED)
            self._poses = replace(poses, train=(), test=_over_backgrounds(poses.train + poses.test))
        scenes = self.original, candidate
        found = compare_images(*scenes, self._poses, context, reference_images=self._images)
        around = compare_images(*scenes, self._drawn, context, reference_images=self._drawn_images)
        return replace(found, surroundings=around)


def _over_backgrounds(views: Sequence[View]) -> tuple[View, ...]:
    """Return views over black, grey and white in turn: on black, dark parts do not show."""
    levels = [BACKGROUNDS[n % len(BACKGROUNDS)] for n in range(len(views))]
    return tuple(
        replace(view, background=np.full(3, level, np.float32)) for view, level in zip(views, levels, strict=True)
    )


START_LOG2, MAX_LOG2 = -2.0, -0.1
"""log2 of the first share of the Gaussians that a search tries, and of the largest one."""

DROP_PER_HALVING = 0.4
"""Drop of PSNR, decibels, that a search expects from half as many Gaussians; only for its first steps."""

GRAIN_LOG2 = 1 / 64
"""Shares are multiples of this, as log2: counts that differ by less than 1 % are not tried both."""

TOLERANCE_DB = 0.02
"""A search ends once the drop is at most this far below the allowed one, decibels."""

NO_CHECKPOINT = "a search for a {} keeps no checkpoint; give a count or a ratio with it"


def compact_scene(
    splats: Splats,
    settings: CompactSettings,
    views: Views | None = None,
    context: Context = DEFAULT_CONTEXT,
    *,
    evaluate: bool = False,
    checkpoint: Path | None = None,
) -> Compacted:
    """Reduce the number of Gaussians to the budget of the settings; no more than that are returned unchanged.

    With a capture, its training views train and score, and its held-out views evaluate. Without one, virtual views
    train and score with renderings of the scene as targets, and cameras drawn over the whole scene evaluate.
    """
    if not settings.enabled:
        raise UnsupportedError("missing the number of Gaussians to keep: give count, ratio or max_psnr_drop")
    if settings.auto_count:
        raise UnsupportedError(
            "auto_count needs a container: use kissgs compress, or give count, ratio or max_psnr_drop"
        )
    if settings.max_psnr_drop is not None and checkpoint is not None:
        raise UnsupportedError(NO_CHECKPOINT.format("drop of PSNR"))
    count = settings.count or max(1, round(len(splats) * (settings.ratio or 0.0)))
    if count >= len(splats):
        return unchanged(splats, "no more than requested")
    task = Popspa(splats, settings, chosen_views(splats, settings, views, context), context)
    if settings.max_psnr_drop is None:
        return _compacted(task, count, evaluate=evaluate, checkpoint=checkpoint)
    return _search_drop(task, SearchEvaluation.of(splats, views, task.supervision), settings.max_psnr_drop)


def unchanged(splats: Splats, reason: str) -> Compacted:
    """Return the scene with all its Gaussians and a report whose note gives the reason."""
    count = f"{len(splats):,} Gaussian{'' if len(splats) == 1 else 's'}"
    note = f"the scene has {count}, {reason}: it is unchanged"
    report = CompactionReport(
        source_count=len(splats), count=len(splats), target_source="nothing", source="", steps=(), note=note
    )
    return Compacted(splats, np.arange(len(splats)), report)


def _merge(task: Popspa, count: int, *, evaluate: bool) -> Compacted:
    """Return the scene with ``count`` Gaussians by merging."""
    progress = task.context.progress
    progress("kernels", 0.0)
    from kissgs.compaction.merging import merge_gaussians  # loads kernels that pruning does not need

    progress("kernels", 1.0)
    log = StepLog(task.evaluate if evaluate else None)
    log.record("input", task.splats)
    merged, index = merge_gaussians(task.splats, count, task.context)
    log.record("merge", merged)
    uses_views = evaluate or task.settings.max_psnr_drop is not None
    report = CompactionReport(
        source_count=len(task.splats),
        count=count,
        target_source="nothing",
        source="",
        steps=tuple(log.steps),
        note=task.supervision.note if uses_views else "",
    )
    return Compacted(merged, index, report)


def chosen_views(splats: Splats, settings: CompactSettings, views: Views | None, context: Context) -> SupervisionViews:
    """Return the views of a compaction; training that is impossible is refused before any other work."""
    if settings.trains and find_spec("torch") is None:
        raise UnsupportedError(
            "training needs torch, which is missing: pip install 'kissgs[train]' (a CPU build is enough); the "
            "preset fast, which only prunes, and the method merge do not need it"
        )
    if settings.trains and context.device == "cuda":
        need_cuda()
    if settings.method == "merge":
        return evaluation_only(views)
    return supervision_views(splats, views, settings, context, scoring_stride=SCORING_STRIDE if settings.trains else 1)


def estimate_note(supervision: SupervisionViews) -> str:
    """Return the note that drops of PSNR in these views are estimates; empty if photographs measure them."""
    return "" if any(view.photo for view in supervision.test) else ESTIMATED_DROP


def _compacted(task: Popspa, count: int, *, evaluate: bool = False, checkpoint: Path | None = None) -> Compacted:
    """Return the scene with exactly ``count`` Gaussians, from 1 to fewer than it has, by the method of the settings."""
    if task.settings.method == "merge":
        return _merge(task, count, evaluate=evaluate)
    return task(count, evaluate=evaluate, checkpoint=checkpoint)


def _search_drop(task: Popspa, compare: SearchEvaluation, allowed: float) -> Compacted:
    """Return the fewest Gaussians that lose at most ``allowed`` decibels; the unchanged scene if there are none."""
    total, trials = len(task.splats), dict[int, float]()
    best: Compacted | None = None

    def margin(log2_share: float) -> float:
        nonlocal best
        count = min(max(1, round(total * 2**log2_share)), total - 1)
        if count not in trials:
            compacted = _compacted(task, count)
            trials[count] = drop_of(compare(compacted.splats, task.context.stage("evaluate")))
            if trials[count] <= allowed and (best is None or count < len(best.splats)):
                best = compacted
        return allowed - trials[count]

    least = -math.log2(total)
    try:
        find_root(margin, max(START_LOG2, least), DROP_PER_HALVING, TOLERANCE_DB, (least, MAX_LOG2), GRAIN_LOG2)
    except StopSearch:
        if best is None:
            raise
    if best is None:
        best = unchanged(task.splats, f"and every smaller count that was tried loses more than {allowed:g} dB")
    note = "; ".join(filter(None, [best.report.note, estimate_note(task.supervision)]))
    report = replace(best.report, trials=tuple(CountTrial(count, drop) for count, drop in trials.items()), note=note)
    return replace(best, report=report)
