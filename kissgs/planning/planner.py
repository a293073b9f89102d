"""``plan_encoding``: rate-distortion planning if the scene's sensitivity is known, else uniform planning."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from kissgs.core.array_types import Float32, Float64, Int, Int32, UInt16
from kissgs.core.coarse_positions import coarse_note
from kissgs.core.errors import UnsupportedError
from kissgs.core.progress import Progress, load_kernels, silent
from kissgs.core.resources import Workers, blas_workers, return_free_memory
from kissgs.core.sensitivity import Sensitivity
from kissgs.core.splats import SH_REST_COUNTS, Splats
from kissgs.planning import table_fields
from kissgs.planning.container_model import EVEN_LEVELS, ByteTables, ContainerModel, Planning
from kissgs.planning.encoding_plan import EncodingPlan, PlannedScene
from kissgs.planning.layout import layout_grid
from kissgs.planning.order_refinement import refine_order
from kissgs.planning.quantize import (
    MEANS_TOP,
    Quantized,
    clip_outliers,
    half_steps,
    log_extent,
    means_bits,
    quantize,
    quantize_means,
)
from kissgs.planning.rate_distortion import ColorRefit, plan_rate_distortion
from kissgs.planning.rd_fields import OUTLIERS, largest_errors
from kissgs.planning.rotation_forms import choose_forms
from kissgs.planning.rows import Rows, selected
from kissgs.planning.sh_codebook import FEW, fit_codebook, size_weights
from kissgs.settings import EncodeSettings

# Uniform planning: the steps of the settings for all Gaussians, without rendering the scene.

FINEST = 1e-4
"""Step of values that may take all levels of a table."""


def plan_uniform(
    splats: Splats, kept: Int[np.ndarray, " M"], planning: Planning, groups: UInt16[np.ndarray, " N"] | None = None
) -> EncodingPlan:
    """Plan the Gaussians ``kept``, which may be none, for a container."""
    settings, container, pool = planning.settings, planning.container, planning.pool
    most = 16 if container.tables is None else 32
    bits = settings.means_bits or means_bits(splats, kept, settings.means_tolerance, pool, most=most)
    grid = layout_grid(splats.means, kept, min(bits, 16), settings, pool, planning.report("order"), None, groups)
    grid = grid.with_padding_last() if container.padding_last else grid
    # Padding repeats Gaussians of the scene; in a scene without any, padding is a neutral Gaussian.
    source, cells = (splats, grid.cells) if len(kept) else (_neutral(splats.sh_degree), grid.cells * 0)
    clips = settings.shared_step_size and container.tables is None
    sh0 = clip_outliers(source.sh0, step=settings.sh0_step, share=OUTLIERS) if clips else source.sh0
    shapes, form_error = choose_forms(source, cells, grid.side, planning)
    chosen = cells[grid.mask]
    weights = np.ones(len(chosen), np.float32)
    if source.sh_degree > 0:
        weights = size_weights(source, settings.sh_weight_power)[chosen]
    size = max(len(chosen) / settings.gaussians_per_codebook_entry, FEW)
    codebook = fit_codebook(source, chosen, weights, size, planning)
    return_free_memory()
    if container.tables is not None:
        means, colors = source.means[cells], source.sh0[cells]
        fields, errors = _table_fields(means, colors, shapes[:], bits, settings, container.tables)
    else:
        fields = {
            "means": quantize_means(selected(source.means, cells), bits=bits, pool=pool),
            "opacities": _quantize(shapes.opacities, settings.opacity_step, settings, pool),
            "scales": _quantize(shapes.scales, settings.scale_step, settings, pool),
            "quaternions": _quantize(shapes.quats, settings.quat_step, settings, pool, paper_top=99),
            "f_dc": _quantize(selected(sh0, cells), settings.sh0_step, settings, pool),
        }
        errors = {name: half_steps(field) for name, field in fields.items()}
        errors["means"] = half_steps(fields["means"], 1 << (16 - bits))
    return EncodingPlan(
        scene=PlannedScene(len(splats), len(kept), splats.sh_degree, splats.origin, splats.antialiased),
        grid=grid,
        fields={**fields, "f_rest_centroids": codebook.centroids},
        codebook=codebook,
        classes=np.zeros(len(chosen), np.uint8),
        form_error=form_error,
        clipped_colors=0 if sh0 is source.sh0 else int((sh0 != source.sh0).any(axis=1).sum()),
        errors={**errors, "f_rest_centroids": codebook.errors},
    )


def _table_fields(
    means: Float32[np.ndarray, "cells 3"],
    colors: Float32[np.ndarray, "cells 3"],
    values: Float64[np.ndarray, "cells 8"],
    bits: int,
    settings: EncodeSettings,
    tables: ByteTables,
) -> tuple[dict[str, Quantized], dict[str, list[float]]]:
    """Return the levels by field, and the largest errors, for a container with tables.

    Without ``shared_step_size``, every table has as many values as it may, and rotations have all their levels.
    """
    equal = np.ones(len(means))
    steps = (settings.opacity_step, settings.scale_step, settings.quat_step, settings.sh0_step)
    if not settings.shared_step_size:
        steps = (FINEST, FINEST, FINEST, FINEST)
    opacity, scale, rotation, color = (step * equal for step in steps)
    unit = log_extent(means) / MEANS_TOP
    wanted = table_fields.stored_values(values, tables)
    shapes = table_fields.rounded_shapes(wanted, equal, (opacity, scale, rotation), tables)
    fields = {
        **table_fields.finished_shapes(shapes, values[:, 0], tables),
        "means": table_fields.means_field(means, max(unit, 1e-30) * 2.0 ** (16 - bits)),
        "f_dc": table_fields.color_field(colors.astype(np.float64), color, equal),
    }
    return fields, largest_errors(fields, values, means, colors)


def _neutral(sh_degree: int) -> Splats:
    """Return a scene of one Gaussian at the origin, of unit size and half opacity."""
    return Splats(
        means=np.zeros((1, 3), np.float32),
        quats=np.array([[1, 0, 0, 0]], np.float32),
        scales=np.zeros((1, 3), np.float32),
        opacities=np.zeros(1, np.float32),
        sh0=np.zeros((1, 3), np.float32),
        shN=np.zeros((1, SH_REST_COUNTS[sh_degree], 3), np.float32),
    )


def _quantize(values: Rows, step: float, settings: EncodeSettings, pool: Workers, *, paper_top: int = 255) -> Quantized:
    if settings.shared_step_size:
        return quantize(values, step=step, pool=pool)
    return quantize(values, step=step, shared=False, max_top=paper_top, pool=pool)


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

    Without sensitivity, or if no camera saw any Gaussian, planning is uniform, with the steps of the settings. With
    ``groups``, the Gaussians of each follow one another in the container, the groups in ascending order.
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
        planning = Planning(settings, container, pool, progress)
        if sensitivity is not None and (sensitivity.color_weight[kept] > 0).any():
            plan = plan_rate_distortion(splats, kept, sensitivity, recolor, planning, keep_costs, groups)
        else:
            plan = plan_uniform(splats, kept, planning, groups)
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
