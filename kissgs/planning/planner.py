"""``plan_encoding``: by rate and distortion, all with one lambda, or with uniform steps, makes an ``EncodingPlan``."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from kissgs.core.array_types import Bool, Float32, Float64, Int, Int32, UInt8, UInt16
from kissgs.core.context import DEFAULT_CONTEXT, Context, Progress, Workers, blas_workers, return_free_memory
from kissgs.core.errors import UnsupportedError
from kissgs.core.positions import Origin, coarse_note, signed_log
from kissgs.core.sensitivity import Sensitivity
from kissgs.core.splats import SH_C0, SH_REST_COUNTS, Splats
from kissgs.planning import quantize, rd_fields, sh_codebook
from kissgs.planning.layout import Grid, layout_grid, refined_order
from kissgs.planning.quantize import (
    EVEN_LEVELS,
    ByteTables,
    ContainerModel,
    Planning,
    Quantized,
    Rows,
    for_each_block,
    means_bits,
    row_range,
    selected,
)
from kissgs.planning.rd_fields import (
    OUTLIERS,
    SEEN,
    Costs,
    RdCriterion,
    RdFields,
    decoded_entries,
    decoded_scene,
    largest_changes,
    largest_errors,
)
from kissgs.planning.rotation_forms import SHAPE_COLUMNS, choose_forms
from kissgs.planning.sh_codebook import (
    FEW,
    Codebook,
    CodebookErrorModel,
    ShMetric,
    fit_codebook,
    sensitivity_weights,
    size_weights,
)
from kissgs.settings import EncodeSettings


@dataclass(frozen=True, slots=True)
class PlannedScene:
    """Facts of the scene that was planned, so that the scene itself is not needed any more."""

    count: int
    visible: int  # number of Gaussians that the plan could keep: those that a renderer draws, or all
    sh_degree: int
    origin: Origin
    antialiased: bool
    first_view: Mapping[str, Any] | None = None  # with which viewers open the scene, for the metadata


@dataclass(frozen=True, slots=True, eq=False)
class EncodingPlan:
    """Levels of every cell, and the errors that they cause."""

    scene: PlannedScene
    grid: Grid
    fields: dict[str, Quantized]  # by name in the metadata; one row per cell, or per entry of f_rest_centroids
    codebook: Codebook
    classes: UInt8[np.ndarray, " M"]  # sensitivity class of each Gaussian, from 0; each class has its own step
    form_error: float  # largest relative change of a covariance by the choice of its equivalent form
    clipped_colors: int  # number of Gaussians whose base colour, an outlier, was clipped
    # largest quantisation error per field and channel, in the field's own unit (positions: of their signed logarithm;
    # f_rest_centroids: of the codebook's entries). Base colours include the compensation of other errors
    errors: dict[str, list[float]]
    costs: Costs | None = None  # squared error of one unit in each attribute, ``(M,)`` each; None for uniform planning
    rd_lambda: float | None = None  # squared error per bit; None for uniform planning
    note: str = ""  # a sentence for the user if many Gaussians were pruned; else empty
    coarse: str = ""  # a sentence for the user if the positions are too coarse for the Gaussians; else empty


@dataclass(frozen=True, slots=True)
class Encoded:
    """A container in memory, and figures of its encoding, some of them those of :class:`EncodingPlan`."""

    files: dict[str, bytes]  # name -> bytes, in the order in which they are best stored
    order: Int[np.ndarray, " M"]  # index in the encoded scene of every Gaussian, in the container's order
    form_error: float
    invisible: int  # number of Gaussians pruned because no renderer draws them
    pruned_by_rd: int  # number of Gaussians pruned because removing them costs less than their bits
    clipped_colors: int
    errors: dict[str, list[float]]
    rd_lambda: float | None
    codebook_side: int  # S; the codebook has up to S × S entries
    note: str = ""
    coarse: str = ""

    @classmethod
    def of(cls, plan: EncodingPlan, files: dict[str, bytes]) -> Encoded:
        """Return the files of a plan with the plan's figures."""
        order, scene = plan.grid.cells[plan.grid.mask], plan.scene
        return cls(
            files=files,
            order=order,
            form_error=plan.form_error,
            invisible=scene.count - scene.visible,
            pruned_by_rd=scene.visible - len(order),
            clipped_colors=plan.clipped_colors,
            errors=plan.errors,
            rd_lambda=plan.rd_lambda,
            codebook_side=plan.codebook.side,
            note=plan.note,
            coarse=plan.coarse,
        )


# Estimate of a scene's error by lambda, before it is planned, and the lambda for a given error.

DIMENSIONS = 14  # rounded degrees of freedom per Gaussian: opacity, scales, rotation, base colour, position

# Measured ratio of the rounding error to H d²/12: RDO quantisation prefers levels of few bits, and the errors of
# several Gaussians add up in a pixel.
GROWTH = 2.2
PAPER_RATIO = 8  # Gaussians per codebook entry of the paper
PAPER_SH_GROWTH = 2.0  # measured factor on uncompensated shN errors, which add up in pixels

# Decibels per unit of view uncertainty by which errors in other views exceed those in measured views, where planning
# hides them. Not of shN: its codebook hardly adapts to the measured views once sensitivity is shrunk towards the prior.
OTHER_VIEWS_DB = 9.5
MIN_ERROR_RATIO = 1.1  # smallest error to aim at over the smallest possible: the last 0.4 dB cost too many bits
SH_UNCOMPENSATED, SH_UNCOMPENSATED_GROWTH = 0.14, 1.9  # measured share, and growth per unit of view uncertainty
REFIT_GAIN = 0.17  # PSNR gain per iteration of the colour refit, decibels: less than the measured mean


@dataclass(frozen=True, slots=True, eq=False)
class ErrorModel:
    """Estimate of the mean squared error of a scene by lambda."""

    costs: Costs
    sh_model: CodebookErrorModel
    prune_bits: float  # largest number of bits that the removal of a Gaussian may cost
    view_uncertainty: float

    def error_at(self, rd_lambda: float) -> float:
        """Estimate the mean squared error of the scene planned with ``rd_lambda``."""
        costs, count = self.costs, len(self.costs.color)
        pruned = costs.removal[costs.pruned_by_rd(rd_lambda, self.prune_bits)]
        rounding = GROWTH * DIMENSIONS * (count - len(pruned)) * rd_lambda / (2 * np.log(2))
        other_views = 10 ** (OTHER_VIEWS_DB * self.view_uncertainty / 10)
        uncompensated = SH_UNCOMPENSATED + SH_UNCOMPENSATED_GROWTH * self.view_uncertainty
        sh_error = self.sh_model.error(max(self.sh_model.best_size(rd_lambda, count), 1))
        return float(other_views * (rounding + GROWTH * pruned.sum()) + uncompensated * sh_error)

    def lambda_for(self, error: float) -> float:
        """Return the lambda at which the mean squared error is about ``error``, or 1.1 times the smallest possible one.
        At any lambda, the error of the largest codebook remains."""
        low, high = np.log(1e-22), np.log(1e-2)
        error = max(error, MIN_ERROR_RATIO * self.error_at(1e-22))
        for _ in range(60):
            middle = 0.5 * (low + high)
            small = self.error_at(float(np.exp(middle))) < error
            low, high = (middle, high) if small else (low, middle)
        return float(np.exp(low))


def choose_lambda(usual: float, model: ErrorModel, settings: EncodeSettings, refits: int) -> tuple[float, float]:
    """Return the lambda of the settings, and that of the default quality, whose error is ``usual``."""

    def for_error(error: float, quality_offset_db: float) -> float:
        return model.lambda_for(error * 10 ** (-(quality_offset_db - REFIT_GAIN * refits) / 10))

    default_lambda = for_error(usual, 0.0)
    if settings.rd_lambda is not None:
        return settings.rd_lambda, default_lambda
    if settings.psnr is not None:
        return for_error(10 ** (-settings.psnr / 10), 0.0), default_lambda
    return for_error(usual, settings.quality_offset_db), default_lambda


def default_error(costs: Costs, splats: Splats, kept: Int[np.ndarray, " M"], sh_model: CodebookErrorModel) -> float:
    """Estimate the mean squared error of the default quality: the smaller one of the presets ``paper`` and ``fast``.
    The paper's 100 levels for rotations, 256 for the rest and 65,536 for positions are spread from each channel's
    smallest to its largest value, so that a single outlier makes them coarse; the steps of ``fast`` are absolute."""
    scene = {"opacities": splats.opacities[:, None], "scales": splats.scales, "sh0": splats.sh0, "means": splats.means}
    ends = {name: row_range(selected(values, kept)) for name, values in scene.items()}
    spans = [np.ptp(np.array(ends[name], np.float64), axis=0) for name in ("opacities", "scales", "sh0")]
    opacity, scale, color = (span / 255 for span in spans)
    log_extent = np.ptp(signed_log(np.array(ends["means"])), axis=0)
    rotation = np.full(3, 2.0)  # a change of a quaternion by 1 is a rotation by 2 radians
    paper = (opacity, scale, rotation * 2 / 99, color, log_extent / 65535)
    defaults = {name: field.default for name, field in EncodeSettings.model_fields.items()}
    levels = 2 ** means_bits(splats, kept, defaults["means_tolerance"]) - 1
    scale, color = (np.full(3, defaults[name]) for name in ("scale_step", "sh0_step"))
    fast = (np.float64(defaults["opacity_step"]), scale, rotation * defaults["quat_step"], color, log_extent / levels)
    fast_ratio = defaults["gaussians_per_codebook_entry"]
    return min(_error(paper, PAPER_RATIO, costs, sh_model), _error(fast, fast_ratio, costs, sh_model))


def _error(steps: Sequence[np.ndarray | np.float64], ratio: float, costs: Costs, sh_model: CodebookErrorModel) -> float:
    """Estimate the mean squared error of rounding to such steps of opacity, scale, rotation, colour and position. A
    Gaussian's error is at most twice that of its removal: one copy too few, and one where there should be none. The
    Hessian alone overestimates the rotation of long, thin Gaussians, a few of which would then decide. The share of
    positions is bounded by that of as many other numbers: far from the origin, even 16 bits are coarse, at any
    lambda."""
    each = (costs.opacity, costs.scale, costs.rotation, costs.color, costs.position)
    squares = [float(np.sum(np.square(step, dtype=np.float64))) for step in steps]

    def bounded(rows: slice) -> float:
        errors = np.stack([cost[rows] * (square / 12) for cost, square in zip(each[:-1], squares[:-1], strict=True)])
        return float(np.minimum(errors.sum(axis=0), 2 * costs.removal[rows]).sum())

    total = sum(for_each_block(len(costs.color), bounded))
    total += min(float(costs.position.sum()) * squares[-1] / 12, total * 3 / (DIMENSIONS - 3))
    entries = max(len(costs.color) / ratio, 1)
    return total + PAPER_SH_GROWTH * sh_model.unweighted * (sh_model.entries / entries) ** sh_codebook.SH_SHRINK


def implied_lambda(error: float, count: int) -> float:
    """Return the lambda for which ``error`` is the expected mean squared error of rounding ``count`` Gaussians."""
    return 2 * float(np.log(2)) * error / (GROWTH * DIMENSIONS * max(count, 1))


# Function that returns better base colours for the decoded Gaussians and their indices in the scene.
ColorRefit = Callable[[Splats, Int[np.ndarray, " M"]], Float32[np.ndarray, "M 3"]]
MAX_COMPENSATION = np.float32(0.5 / SH_C0)  # of lost SH coefficients by a base colour: half of a colour's range
MANY_PRUNED = 0.2  # share of pruned Gaussians above which the report explains why they were pruned


def plan_rate_distortion(
    splats: Splats,
    kept: Int[np.ndarray, " M"],
    sensitivity: Sensitivity,
    recolor: ColorRefit | None,
    planning: Planning,
    keep_costs: bool,
    groups: UInt16[np.ndarray, " N"] | None,
) -> EncodingPlan:
    """Plan the Gaussians ``kept``, at least one of which a camera has seen, for a container."""
    settings, container, pool = planning.settings, planning.container, planning.pool
    planning.report("rate_distortion")
    scene = PlannedScene(len(splats), len(kept), splats.sh_degree, splats.origin, splats.antialiased)
    uncertainty = sensitivity.view_uncertainty
    costs = Costs.of(sensitivity, splats, pool)
    return_free_memory()
    costs = costs.keep(kept) if len(kept) < len(splats) else costs
    sh_model = sh_codebook.codebook_error_model(splats, kept, sensitivity, settings, pool)
    refits = settings.color_refit_iterations if recolor is not None else 0
    prune_bits = settings.prune_threshold_bits * (1 - uncertainty)
    model = ErrorModel(costs, sh_model, prune_bits, uncertainty)
    usual = default_error(costs, splats, kept, sh_model)
    rd_lambda, default_lambda = choose_lambda(usual, model, settings, refits)
    step_growth = max(1.0, float(np.sqrt(rd_lambda / default_lambda)))
    pruned = costs.pruned_by_rd(rd_lambda, prune_bits, default_lambda)
    note = _pruning_note(pruned, costs)
    if pruned.any():
        remaining = np.flatnonzero(~pruned).astype(np.int32)
        kept, costs = kept.take(remaining), costs.keep(remaining)
        del remaining
    del pruned, model
    keeps = container.tables is not None or keep_costs
    if not keeps:
        costs = costs.of_rounding()
    classes = costs.classes(settings.step_classes, selected(splats.means, kept))
    criterion = RdCriterion.of(costs, classes, rd_lambda, keep=keeps)
    del costs
    return_free_memory()

    report = planning.report("order")
    grid = layout_grid(splats.means, kept, 16, settings, pool, report, criterion.classes, groups)
    grid = grid.with_padding_last() if container.padding_last else grid
    order = grid.cells[grid.mask]
    criterion = criterion.take(_ranks(order, kept, len(splats)))
    del kept
    return_free_memory()

    shapes, form_error = choose_forms(splats, grid.cells, grid.side, planning)
    shapes = shapes.take(grid.mask)
    size = sh_model.best_size(rd_lambda, len(order), container.entry_bits)
    size = sh_codebook.nearest_square(size) if container.tables is None else size
    metric = ShMetric.of(sensitivity, splats.sh_degree)
    codebook = sh_codebook.fit_codebook(
        splats, order, sensitivity_weights(sensitivity, order, splats), size, planning, metric=metric
    )
    return_free_memory()

    planning.report("rounding")
    captured = sensitivity.captured.take(order)
    largest = largest_changes(sensitivity.coverage.take(order), captured, step_growth)
    quantizer = RdFields(planning, criterion, largest)
    fields = quantizer.shapes(shapes, selected(sensitivity.shape_hessian, order))
    fields["means"] = quantizer.means(splats, order, np.rint(captured + np.log2(step_growth)).astype(np.int8))
    fields["f_dc"], clipped = quantizer.colors(
        _base_colors(splats, order, sensitivity, fields, codebook, recolor, pool)
    )
    errors = largest_errors(fields, shapes, selected(splats.means, order), selected(splats.sh0, order), pool)
    fields = {name: field.take(grid.cell_to_gaussian) for name, field in fields.items()}  # one row for every cell
    return EncodingPlan(
        scene=scene,
        grid=grid,
        fields={**fields, "f_rest_centroids": codebook.centroids},
        codebook=codebook,
        classes=criterion.classes,
        form_error=form_error,
        clipped_colors=clipped,
        errors={**errors, "f_rest_centroids": codebook.errors},
        costs=criterion.costs if keep_costs else None,
        rd_lambda=rd_lambda,
        note=note,
    )


def _ranks(order: Int[np.ndarray, " M"], kept: Int[np.ndarray, " M"], count: int) -> Int[np.ndarray, " M"]:
    """Return the place in ``kept`` of each Gaussian of ``order``; the scene has ``count`` Gaussians."""
    place = np.empty(count, np.int32)
    place[kept] = np.arange(len(kept), dtype=np.int32)
    return place.take(order)


def _base_colors(
    splats: Splats,
    order: Int[np.ndarray, " M"],
    sensitivity: Sensitivity,
    fields: dict[str, Quantized],
    codebook: Codebook,
    recolor: ColorRefit | None,
    pool: Workers,
) -> Float32[np.ndarray, "M 3"]:
    """Return base colours that make up for what the codebook loses of each Gaussian's shN, where cameras see it; or
    those that ``recolor`` makes of them."""
    entries, labels = decoded_entries(codebook, splats.shN.shape[1]), codebook.labels
    base = splats.sh0.take(order, axis=0)

    def compensate(rows: slice) -> None:
        some = order[rows]
        lost = splats.shN.take(some, axis=0) - entries.take(labels[rows], axis=0)
        basis = sensitivity.mean_harmonics.take(some, axis=0)
        change = np.einsum("nk,nkc->nc", basis, lost) / np.float32(SH_C0)
        base[rows] += np.clip(change, -MAX_COMPENSATION, MAX_COMPENSATION)

    if splats.sh_degree > 0:
        for_each_block(len(order), compensate, pool)
    return base if recolor is None else recolor(decoded_scene(fields, base, entries[labels[: len(order)]]), order)


def _pruning_note(pruned_by_rd: Bool[np.ndarray, " M"], costs: Costs) -> str:
    """Return a sentence if more than a fifth of the Gaussians are pruned, else an empty string."""
    count = int(pruned_by_rd.sum())
    if count <= MANY_PRUNED * len(pruned_by_rd):
        return ""
    seen = float((costs.coverage[pruned_by_rd] >= SEEN).mean())
    return (
        f"{count:,} of {len(pruned_by_rd):,} Gaussians were pruned because removing each costs less than its bits; "
        f"cameras saw {seen:.0%} of them from nearby (prune_threshold_bits of 0 keeps all)"
    )


def refine_order(
    plan: EncodingPlan, groups: UInt16[np.ndarray, " N"] | None, pool: Workers, progress: Progress
) -> EncodingPlan:
    """Reorder a plan along the Hilbert curve within each class, and within each of ``groups``; reports "reorder".
    Padding, at the end, repeats the last Gaussian, which stays."""
    count = len(plan.classes)
    if count == 0:
        return plan
    runs = plan.classes if groups is None else groups[plan.grid.cells[:count]].astype(np.int32) * 256 + plan.classes
    progress("reorder", 0.0)
    means, colors = (plan.fields[name].levels[:count] for name in ("means", "f_dc"))
    order = refined_order(means, colors, runs, pool, lambda fraction: progress("reorder", fraction))
    cells = np.concatenate([order, np.arange(count, len(plan.grid.cells), dtype=np.int32)])
    rows = {name: field.take(cells) for name, field in plan.fields.items() if name != "f_rest_centroids"}
    return replace(
        plan,
        grid=replace(plan.grid, cells=plan.grid.cells[cells]),
        fields={**plan.fields, **rows},
        codebook=replace(plan.codebook, labels=plan.codebook.labels[order]),
        classes=plan.classes[order],
        costs=None if plan.costs is None else plan.costs.take(order),
    )


# Uniform planning: the steps of the settings for all Gaussians, without rendering the scene.

FINEST = 1e-4  # step of values that may take all levels of a table


def plan_uniform(
    splats: Splats, kept: Int[np.ndarray, " M"], planning: Planning, groups: UInt16[np.ndarray, " N"] | None = None
) -> EncodingPlan:
    """Plan the Gaussians ``kept``, which may be none, for a container."""
    settings, container, pool = planning.settings, planning.container, planning.pool
    most = 16 if container.tables is None else 32
    bits = settings.means_bits or quantize.means_bits(splats, kept, settings.means_tolerance, pool, most=most)
    grid = layout_grid(splats.means, kept, min(bits, 16), settings, pool, planning.report("order"), None, groups)
    grid = grid.with_padding_last() if container.padding_last else grid
    # Padding repeats Gaussians of the scene; in a scene without any, padding is a neutral Gaussian.
    source, cells = (splats, grid.cells) if len(kept) else (_neutral(splats.sh_degree), grid.cells * 0)
    shared, sh0 = settings.shared_step_size, source.sh0
    if shared and container.tables is None:
        sh0 = quantize.clip_outliers(sh0, step=settings.sh0_step, share=OUTLIERS)
    shapes, form_error = choose_forms(source, cells, grid.side, planning)
    chosen = cells[grid.mask]
    weights = np.ones(len(chosen), np.float32)
    if source.sh_degree > 0:
        weights = size_weights(source, settings.sh_weight_power)[chosen]
    size = max(len(chosen) / settings.gaussians_per_codebook_entry, FEW)
    codebook = fit_codebook(source, chosen, weights, size, planning)
    return_free_memory()
    own = settings.opacity_step, settings.scale_step, settings.quat_step, settings.sh0_step
    steps = dict(zip(("opacities", "scales", "quaternions", "f_dc"), own, strict=True))
    if container.tables is not None:
        if not shared:
            steps = dict.fromkeys(steps, FINEST)
        means, colors = source.means[cells], source.sh0[cells]
        fields, errors = _table_fields(means, colors, shapes[:], bits, steps, container.tables)
    else:
        rows: dict[str, Rows] = {name: shapes.field(name) for name in SHAPE_COLUMNS}
        rows["f_dc"] = selected(sh0, cells)
        fields = {"means": quantize.quantize_means(selected(source.means, cells), bits=bits, pool=pool)}
        for name, step in steps.items():
            top = settings.quat_levels - 1 if name == "quaternions" and not shared else 255
            fields[name] = quantize.quantize(rows[name], step=step, shared=shared, max_top=top, pool=pool)
        errors = {name: quantize.half_steps(field) for name, field in fields.items()}
        errors["means"] = quantize.half_steps(fields["means"], 1 << (16 - bits))
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
    steps: Mapping[str, float],
    tables: ByteTables,
) -> tuple[dict[str, Quantized], dict[str, list[float]]]:
    """Return the levels by field, and the largest errors, for a container with tables."""
    equal = np.ones(len(means))
    each = {name: step * equal for name, step in steps.items()}
    unit = quantize.log_extent(means) / quantize.MEANS_TOP
    wanted = rd_fields.stored_values(values, tables)
    shapes = rd_fields.rounded_shapes(wanted, equal, each, tables)
    fields = {
        **rd_fields.finished_shapes(shapes, values[:, 0], tables),
        "means": rd_fields.means_field(means, max(unit, 1e-30) * 2.0 ** (16 - bits)),
        "f_dc": rd_fields.color_field(colors.astype(np.float64), each["f_dc"], equal),
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


INVISIBLE_LOGIT = -5.5373  # logit of opacity 1/255, rounded up; no renderer draws Gaussians of this opacity or less
SAMPLED = 1 << 18  # number of Gaussians whose sizes are compared with the steps of positions
MAX_GROUPS = 1 << 14  # in a container: group and class of steps together are a number of 16 bits


def plan_encoding(
    splats: Splats,
    settings: EncodeSettings,
    context: Context = DEFAULT_CONTEXT,
    *,
    sensitivity: Sensitivity | None = None,
    recolor: ColorRefit | None = None,
    container: ContainerModel = EVEN_LEVELS,
    keep_costs: bool = True,
    groups: UInt16[np.ndarray, " N"] | None = None,
) -> EncodingPlan:
    """Choose order, rotation forms, codebook and levels for a clean scene. Without sensitivity, or if no camera saw any
    Gaussian, planning is uniform, with the steps of the settings. With ``groups``, the Gaussians of each follow one
    another in the container, the groups in ascending order."""
    if groups is not None and settings.order == "plas":
        raise UnsupportedError("a container with groups of Gaussians needs order=hilbert or order=refined")
    if groups is not None and int(groups.max(initial=0)) >= MAX_GROUPS:
        raise UnsupportedError(f"a container holds up to {MAX_GROUPS:,} groups of Gaussians; make them larger")
    if sensitivity is not None:
        sensitivity.check(splats)
    kept = visible_gaussians(splats, settings)
    with blas_workers(context.threads) as pool:
        planning = Planning(settings, container, pool, context.progress)
        if sensitivity is not None and (sensitivity.color_weight[kept] > 0).any():
            plan = plan_rate_distortion(splats, kept, sensitivity, recolor, planning, keep_costs, groups)
        else:
            plan = plan_uniform(splats, kept, planning, groups)
        if settings.order == "refined":
            plan = refine_order(plan, groups, pool, context.progress)
        order, means = plan.grid.cells[plan.grid.mask], plan.fields["means"]
        some = order[:: 1 + len(order) // SAMPLED]
        note = coarse_note(splats.means[some], splats.scales[some], means.low, means.high, len(order))
        return replace(plan, coarse=note)


def visible_gaussians(splats: Splats, settings: EncodeSettings) -> Int32[np.ndarray, " K"]:
    """Return the indices of the Gaussians that a renderer draws, or of all if ``prune_invisible`` is off."""
    if not settings.prune_invisible:
        return np.arange(len(splats), dtype=np.int32)
    return np.flatnonzero(splats.opacities > np.float32(INVISIBLE_LOGIT)).astype(np.int32)
