"""Number of Gaussians to keep: a count, a share, or as few as a drop of PSNR allows."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np

from kissgs.cameras.views import Views
from kissgs.compaction.popspa import Popspa, StepLog
from kissgs.compaction.result import Compacted, CompactionReport, CountTrial
from kissgs.compaction.search_evaluation import SearchEvaluation
from kissgs.core.context import DEFAULT_CONTEXT, TORCH_MISSING, Context, has_torch
from kissgs.core.errors import StopSearch, UnsupportedError
from kissgs.core.root_finding import find_root
from kissgs.core.splats import Splats
from kissgs.evaluation.results import ESTIMATED_DROP, drop_of
from kissgs.rendering.rasterizer import need_cuda
from kissgs.settings import CompactSettings
from kissgs.training.supervision import SCORING_STRIDE, SupervisionViews, evaluation_only, supervision_views

START_LOG2, MAX_LOG2 = -2.0, -0.1  # log2 of the first share of the Gaussians, and of the largest one
DROP_PER_HALVING = 0.4  # decibels that a search expects from half as many Gaussians, for its first steps
GRAIN_LOG2 = 1 / 64  # shares are multiples of this, as log2: counts that differ by less than 1 % are not tried both
TOLERANCE_DB = 0.02  # a search ends once the drop is at most this far below the allowed one, decibels

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
    """Reduce the number of Gaussians to the budget of the settings; no more than that are unchanged, or only trained.
    With a capture, its training views train and score, and its held-out views evaluate. Without one, virtual views
    train and score with renderings of the scene as targets, and cameras drawn over the whole scene evaluate."""
    if not settings.enabled:
        raise UnsupportedError("missing the number of Gaussians to keep: give count, ratio or max_psnr_drop")
    if settings.auto_count:
        raise UnsupportedError(
            "auto_count needs a container: use kissgs compress, or give count, ratio or max_psnr_drop"
        )
    if settings.max_psnr_drop is not None and checkpoint is not None:
        raise UnsupportedError(NO_CHECKPOINT.format("drop of PSNR"))
    count = settings.count or max(1, round(len(splats) * (settings.ratio or 0.0)))
    if count >= len(splats) and not (settings.trains_all and settings.trains and len(splats)):
        return unchanged(splats, "no more than requested")
    compactor = Popspa(splats, settings, chosen_views(splats, settings, views, context), context)
    if settings.max_psnr_drop is None:
        return _compacted(compactor, min(count, len(splats)), evaluate=evaluate, checkpoint=checkpoint)
    compare = SearchEvaluation(splats, None if views is None else compactor.supervision.eval_views)
    return _search_drop(compactor, compare, settings.max_psnr_drop)


def unchanged(splats: Splats, reason: str) -> Compacted:
    """Return the scene with all its Gaussians and a report whose note gives the reason."""
    count = f"{len(splats):,} Gaussian{'' if len(splats) == 1 else 's'}"
    note = f"the scene has {count}, {reason}: it is unchanged"
    report = CompactionReport(source_count=len(splats), count=len(splats), note=note)
    return Compacted(splats, np.arange(len(splats)), report)


def _merge(compactor: Popspa, count: int, *, evaluate: bool) -> Compacted:
    """Return the scene with ``count`` Gaussians by merging."""
    progress = compactor.context.progress
    progress("kernels", 0.0)
    from kissgs.compaction.merging import merge_gaussians  # loads kernels that pruning does not need

    progress("kernels", 1.0)
    log = StepLog(compactor.evaluate if evaluate else None)
    log.record("input", compactor.splats)
    merged, index = merge_gaussians(compactor.splats, count, compactor.context)
    log.record("merge", merged)
    uses_views = evaluate or compactor.settings.max_psnr_drop is not None
    note, total = compactor.supervision.note if uses_views else "", len(compactor.splats)
    report = CompactionReport(source_count=total, count=count, steps=tuple(log.steps), note=note)
    return Compacted(merged, index, report)


def chosen_views(splats: Splats, settings: CompactSettings, views: Views | None, context: Context) -> SupervisionViews:
    """Return the views of a compaction; training that is impossible is refused before any other work."""
    if settings.trains and not has_torch():
        raise UnsupportedError(
            f"training needs {TORCH_MISSING}; the method merge, that of the preset fast, does not need it"
        )
    if settings.trains and context.device == "cuda":
        need_cuda()
    if settings.method == "merge":
        return evaluation_only(views)
    return supervision_views(splats, views, settings, context, scoring_stride=SCORING_STRIDE if settings.trains else 1)


def estimate_note(supervision: SupervisionViews) -> str:
    """Return the note that drops of PSNR in these views are estimates; empty if photographs measure them."""
    return "" if any(view.photo for view in supervision.test) else ESTIMATED_DROP


def _compacted(compactor: Popspa, count: int, *, evaluate: bool = False, checkpoint: Path | None = None) -> Compacted:
    """Return the scene with exactly ``count`` Gaussians, from 1 to fewer than it has, by the method of the settings."""
    if compactor.settings.method == "merge":
        return _merge(compactor, count, evaluate=evaluate)
    return compactor(count, evaluate=evaluate, checkpoint=checkpoint)


def _search_drop(compactor: Popspa, compare: SearchEvaluation, allowed: float) -> Compacted:
    """Return the fewest Gaussians that lose at most ``allowed`` decibels; the unchanged scene if there are none."""
    total, trials = len(compactor.splats), dict[int, float]()
    best: Compacted | None = None

    def margin(log2_share: float) -> float:
        nonlocal best
        count = min(max(1, round(total * 2**log2_share)), total - 1)
        if count not in trials:
            compacted = _compacted(compactor, count)
            trials[count] = drop_of(compare(compacted.splats, compactor.context.stage("evaluate")))
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
        best = unchanged(compactor.splats, f"and every smaller count that was tried loses more than {allowed:g} dB")
    note = "; ".join(filter(None, [best.report.note, estimate_note(compactor.supervision)]))
    report = replace(best.report, trials=tuple(CountTrial(count, drop) for count, drop in trials.items()), note=note)
    return replace(best, report=report)
