"""Strategies of compaction at equal numbers of Gaussians and of training steps.

With the settings of ``paper``, :data:`OF_PAPER` are those of KISS-GS, table 4.
"""

from __future__ import annotations

from typing import Any

from kissgs import CompactSettings, Splats, Views
from kissgs.compaction.merging import merge_gaussians
from kissgs.compaction.popspa import Popspa
from kissgs.core.context import Context
from kissgs.training.supervision import SCORING_STRIDE, supervision_views, training_targets

AT_ONCE, IN_ROUNDS = {"min_keep_per_scoring": 0.0}, {"min_keep_per_scoring": 0.8}
ALONE = {"admm_rho": 0.0, "erank_weight": 0.0, "min_scale_weight": 0.0}
ONE, FIVE = {**ALONE, **AT_ONCE, "prune_rounds": 1}, {**ALONE, **IN_ROUNDS, "prune_rounds": 5}
ADMM, ERANK = {"admm_rho": 5e-4}, {"erank_weight": 0.01, "min_scale_weight": 1.0}
"""Weights in the published code of GaussianSpa and of the effective-rank loss."""

STRATEGIES: dict[str, tuple[str, bool, dict[str, Any]]] = {
    "POP": ("none", False, AT_ONCE),
    "POP in rounds": ("none", False, IN_ROUNDS),
    "merge": ("none", True, {}),
    "POP + refine": ("after", False, AT_ONCE),
    "POP in rounds + refine": ("after", False, IN_ROUNDS),
    "merge + refine": ("after", True, {}),
    "POP + train + POP + refine": ("along", False, ONE),
    "POP + sparsify + POP + refine": ("along", False, {**ONE, **ADMM}),
    "POPSpa": ("along", False, {**ONE, **ADMM, **ERANK}),
    "prunings along the way": ("along", False, FIVE),
}
"""When it is trained, whether the scene is merged first or the highest scores stay, and its compaction settings."""


OF_PAPER = "POP + train + POP + refine", "POP + sparsify + POP + refine", "POPSpa"


def compacted(
    scene: Splats, count: int, strategy: str, settings: CompactSettings, views: Views | None, context: Context
) -> Splats:
    """Return a scene with ``count`` Gaussians by a strategy, trained on ``views`` or renderings of the whole scene."""
    when, merges, changes = STRATEGIES[strategy]
    stride = SCORING_STRIDE if settings.trains else 1
    supervised = supervision_views(scene, views, settings, context, scoring_stride=stride)
    steps = {"sparsify_steps": 0, "refine_steps": settings.steps if when == "after" else 0}
    own = settings.model_copy(update={**({} if when == "along" else steps), **changes})
    targets = training_targets(scene, supervised, context) if own.trains else None
    reduced = merge_gaussians(scene, count, context)[0] if merges else scene
    return Popspa(reduced, own, supervised, context, targets)(count).splats
