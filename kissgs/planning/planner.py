"""``plan_encoding``: rate-distortion planning if the scene's sensitivity is known, else uniform planning."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from kissgs.core.array_types import Int32, UInt16
from kissgs.core.coarse_positions import coarse_note
from kissgs.core.errors import UnsupportedError
from kissgs.core.progress import Progress, silent
from kissgs.core.sensitivity import Sensitivity
from kissgs.core.splats import Splats
from kissgs.core.threads import blas_workers
from kissgs.planning.container_model import EVEN_LEVELS, ContainerModel
from kissgs.planning.encoding_plan import EncodingPlan
from kissgs.planning.order_refinement import refine_order
from kissgs.planning.rate_distortion import ColorRefit, plan_rate_distortion
from kissgs.planning.uniform import plan_uniform
from kissgs.settings import EncodeSettings

INVISIBLE_LOGIT = -5.5373
"""Logit of opacity 1/255, rounded up; no renderer draws Gaussians of this opacity or less."""

SAMPLED = 1 << 18
"""Number of Gaussians whose sizes are compared with the steps of positions."""

MAX_GROUPS = 1 << 14
"""Largest number of groups of Gaussians in a container: group and class of steps together are a number of 16 bits."""


def plan_encoding(
    splats: Splats,
    settings: EncodeSettings,
    *,
    sensitivity: Sensitivity | None = None,
    recolor: ColorRefit | None = None,
    container: ContainerModel = EVEN_LEVELS,
    keep_costs: bool = True,
    groups: UInt16[np.ndarray, " N"] | None = None,
    threads: int = 0,
    progress: Progress = silent,
) -> EncodingPlan:
    """Choose order, rotation forms, codebook and levels for a clean scene.

    Args:
        splats: the scene.
        settings: settings of the encoder.
        sensitivity: squared image error of changes of the scene, for rate-distortion planning. Without it, or if no
            camera saw any Gaussian, planning is uniform, with the steps of the settings.
        recolor: for rate-distortion planning: returns better ``sh0`` for the decoded Gaussians and their indices in
            the scene.
        container: what the container can hold.
        keep_costs: whether the plan of rate-distortion planning has its costs, which fine-tuning needs.
        groups: group of each Gaussian, below 16,384: those of a group follow one another in the container, the groups
            in ascending order. Not with PLAS. None for one group.
        threads: number of threads; 0 means one per processor.
        progress: receives "kernels", "rate_distortion", "order", "forms", "codebook", "sort codebook", "rounding" and
            "reorder".

    Raises:
        InvalidSceneError: ``sensitivity`` does not fit the scene.
        UnsupportedError: the scene is too large for one container; groups with PLAS.
    """
    if groups is not None and settings.order == "plas":
        raise UnsupportedError("a container with groups of Gaussians needs order=hilbert or order=refined")
    if groups is not None and int(groups.max(initial=0)) >= MAX_GROUPS:
        raise UnsupportedError(f"a container holds up to {MAX_GROUPS:,} groups of Gaussians; make them larger")
    if sensitivity is not None:
        sensitivity.check(splats)
    load_kernels(progress)
    kept = visible_gaussians(splats, settings)
    with blas_workers(threads) as pool:
        if sensitivity is not None and (sensitivity.color_weight[kept] > 0).any():
            plan = plan_rate_distortion(
                splats,
                kept,
                sensitivity,
                recolor,
                settings,
                container,
                pool,
                progress,
                keep_costs=keep_costs,
                groups=groups,
            )
        else:
            plan = plan_uniform(splats, kept, settings, container, pool, progress, groups)
        if settings.order == "refined":
            plan = refine_order(plan, groups, pool, progress)
        return replace(plan, coarse=_coarse(splats, plan))


def _coarse(splats: Splats, plan: EncodingPlan) -> str:
    """Return the sentence about coarse positions, by at most :data:`SAMPLED` Gaussians."""
    order, means = plan.grid.cells[plan.grid.mask], plan.fields["means"]
    some = order[:: 1 + len(order) // SAMPLED]
    return coarse_note(splats.means[some], splats.scales[some], means.low, means.high, len(order))


def visible_gaussians(splats: Splats, settings: EncodeSettings) -> Int32[np.ndarray, " K"]:
    """Return the indices of the Gaussians that a renderer draws, or of all if ``prune_invisible`` is off."""
    if not settings.prune_invisible:
        return np.arange(len(splats), dtype=np.int32)
    return np.flatnonzero(splats.opacities > np.float32(INVISIBLE_LOGIT)).astype(np.int32)


def load_kernels(progress: Progress = silent) -> None:
    """Compile the encoder's kernels, or load them from numba's cache."""
    progress("kernels", 0.0)
    from kissgs.planning import form_kernels, kernels, kmeans_kernels, order_kernels, relocation_kernels, tour_kernels  # noqa: F401

    progress("kernels", 1.0)
