"""Rate-distortion planning: order, steps, codebook, levels and pruning, all with one lambda."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from kissgs.core.array_types import Bool, Float32, Int, Int32, UInt16
from kissgs.core.free_memory import return_free_memory
from kissgs.core.progress import Progress
from kissgs.core.sensitivity import Sensitivity
from kissgs.core.splats import SH_C0, Splats
from kissgs.core.threads import Workers
from kissgs.planning.codebook_error import codebook_error_model
from kissgs.planning.container_model import ContainerModel
from kissgs.planning.encoding_plan import EncodingPlan, PlannedScene
from kissgs.planning.gaussian_costs import SEEN, Costs
from kissgs.planning.layout import layout_grid
from kissgs.planning.quality_estimate import choose_lambda, default_error, prune_threshold
from kissgs.planning.quantize import Quantized
from kissgs.planning.rd_criterion import RdCriterion
from kissgs.planning.rd_fields import RdFields, decoded_entries, decoded_scene, largest_errors
from kissgs.planning.rdo_quantize import largest_changes
from kissgs.planning.rotation_forms import choose_forms
from kissgs.planning.rows import for_each_block, selected
from kissgs.planning.sh_codebook import Codebook, fit_codebook, nearest_square, sensitivity_weights
from kissgs.planning.sh_metric import ShMetric
from kissgs.settings import EncodeSettings

ColorRefit = Callable[[Splats, Int[np.ndarray, " M"]], Float32[np.ndarray, "M 3"]]
"""Function that returns better base colours for the decoded Gaussians and their indices in the scene."""

MAX_COMPENSATION = np.float32(0.5 / SH_C0)
"""Largest change of a base colour that compensates lost SH coefficients: half of a colour's range."""

MANY_PRUNED = 0.2
"""Share of pruned Gaussians above which the report explains why they were pruned."""


def plan_rate_distortion(
    splats: Splats,
    kept: Int[np.ndarray, " M"],
    sensitivity: Sensitivity,
    recolor: ColorRefit | None,
    settings: EncodeSettings,
    container: ContainerModel,
    pool: Workers,
    progress: Progress,
    *,
    keep_costs: bool = True,
    groups: UInt16[np.ndarray, " N"] | None = None,
) -> EncodingPlan:
    """Plan the Gaussians ``kept``, at least one of which a camera has seen, for a container."""
    progress("rate_distortion", 0.0)
    scene = PlannedScene(len(splats), len(kept), splats.sh_degree, splats.origin, splats.antialiased)
    uncertainty = sensitivity.view_uncertainty
    costs = _costs_of(splats, kept, sensitivity, pool)
    sh_model = codebook_error_model(splats, kept, sensitivity, settings, pool)
    refits = settings.color_refit_iterations if recolor is not None else 0
    usual = default_error(costs, splats, kept, sh_model)
    rd_lambda, default_lambda = choose_lambda(usual, costs, sh_model, settings, uncertainty, refits)
    slack = max(1.0, float(np.sqrt(rd_lambda / default_lambda)))
    pruned = costs.pruned_by_rd(rd_lambda, prune_threshold(settings, uncertainty), default_lambda)
    note = _pruning_note(pruned, costs)
    kept, costs = _without(pruned, kept, costs)
    del pruned
    condense = container.tables is None and not keep_costs
    if condense:
        costs = costs.of_rounding()
    criterion = RdCriterion(costs, costs.classes(settings.step_classes, selected(splats.means, kept)), rd_lambda)
    criterion = criterion.condensed() if condense else criterion
    del costs
    return_free_memory()

    progress("order", 0.0)
    grid = layout_grid(
        splats.means, kept, 16, settings, pool, lambda fraction: progress("order", fraction), criterion.classes, groups
    )
    grid = grid.with_padding_last() if container.padding_last else grid
    order = grid.cells[grid.mask]
    rank = _ranks(order, kept, len(splats))
    del kept
    criterion = criterion.take(rank)
    del rank
    return_free_memory()

    progress("forms", 0.0)
    shapes, form_error = choose_forms(
        splats, grid.cells, grid.side, settings, pool, lambda fraction: progress("forms", fraction), container
    )
    shapes = shapes.take(grid.mask)
    size = sh_model.best_size(rd_lambda, len(order), settings.gaussians_per_codebook_entry, container.entry_bits)
    codebook = _codebook(splats, order, sensitivity, size, settings, container, pool, progress)
    return_free_memory()

    progress("rounding", 0.0)
    captured = sensitivity.captured.take(order)
    largest = largest_changes(sensitivity.coverage.take(order), captured, slack)
    quantizer = RdFields(container, settings, criterion, largest, pool)
    fields = quantizer.shapes(shapes, selected(sensitivity.shape_hessian, order))
    fields["means"] = quantizer.means(splats, order, np.rint(captured + np.log2(slack)).astype(np.int8))
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


def _costs_of(splats: Splats, kept: Int[np.ndarray, " M"], sensitivity: Sensitivity, pool: Workers) -> Costs:
    """Return the costs of the Gaussians ``kept``."""
    costs = Costs.of(sensitivity, splats, pool)
    return_free_memory()
    return costs.keep(kept) if len(kept) < len(splats) else costs


def _without(
    pruned: Bool[np.ndarray, " M"], kept: Int[np.ndarray, " M"], costs: Costs
) -> tuple[Int[np.ndarray, " k"], Costs]:
    """Return the remaining Gaussians and their costs, in the memory of ``costs``."""
    if not pruned.any():
        return kept, costs
    remaining = np.flatnonzero(~pruned).astype(np.int32)
    return kept.take(remaining), costs.keep(remaining)


def _ranks(order: Int[np.ndarray, " M"], kept: Int[np.ndarray, " M"], count: int) -> Int32[np.ndarray, " M"]:
    """Return the place in ``kept`` of each Gaussian of ``order``; the scene has ``count`` Gaussians."""
    place = np.empty(count, np.int32)
    place[kept] = np.arange(len(kept), dtype=np.int32)
    return place.take(order)


def _codebook(
    splats: Splats,
    order: Int[np.ndarray, " M"],
    sensitivity: Sensitivity,
    size: int,
    settings: EncodeSettings,
    container: ContainerModel,
    pool: Workers,
    progress: Progress,
) -> Codebook:
    """Return the SH codebook of about ``size`` entries, fitted to what cameras see of each colour."""
    weights = sensitivity_weights(sensitivity, order, splats)
    metric = ShMetric.of(sensitivity, splats.sh_degree)
    most = nearest_square(size) if container.tables is None else size
    return fit_codebook(splats, order, weights, most, settings, container, pool, progress, metric=metric)


def _base_colors(
    splats: Splats,
    order: Int[np.ndarray, " M"],
    sensitivity: Sensitivity,
    fields: dict[str, Quantized],
    codebook: Codebook,
    recolor: ColorRefit | None,
    pool: Workers,
) -> Float32[np.ndarray, "M 3"]:
    """Return the base colours that fit the decoded shapes and view-dependent colours."""
    rest = decoded_entries(codebook, splats.shN.shape[1])
    base = _compensated_colors(splats, order, sensitivity, rest, codebook.labels, pool)
    if recolor is None:
        return base
    return recolor(decoded_scene(fields, base, rest[codebook.labels[: len(order)]]), order)


def _compensated_colors(
    splats: Splats,
    order: Int[np.ndarray, " M"],
    sensitivity: Sensitivity,
    entries: Float32[np.ndarray, "entries K 3"],
    labels: Int[np.ndarray, " M"],
    pool: Workers,
) -> Float32[np.ndarray, "M 3"]:
    """Return base colours that make up for what the codebook loses of each Gaussian's shN, where cameras see it."""
    base = splats.sh0.take(order, axis=0)

    def compensate(rows: slice) -> None:
        some = order[rows]
        lost = splats.shN.take(some, axis=0) - entries.take(labels[rows], axis=0)
        basis = sensitivity.mean_harmonics.take(some, axis=0)
        change = np.einsum("nk,nkc->nc", basis, lost) / np.float32(SH_C0)
        base[rows] += np.clip(change, -MAX_COMPENSATION, MAX_COMPENSATION)

    if splats.sh_degree > 0:
        for_each_block(len(order), compensate, pool)
    return base


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
