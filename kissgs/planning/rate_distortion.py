"""Rate-distortion planning: order, steps, codebook, levels and pruning, all with one lambda."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from kissgs.core.array_types import Bool, Float32, Int
from kissgs.core.free_memory import return_free_memory
from kissgs.core.progress import Progress
from kissgs.core.sensitivity import Sensitivity
from kissgs.core.splats import SH_C0, Splats
from kissgs.core.threads import Workers
from kissgs.planning import kmeans
from kissgs.planning.container_model import ContainerModel
from kissgs.planning.encoding_plan import EncodingPlan, PlannedScene
from kissgs.planning.layout import layout_grid
from kissgs.planning.rd_fields import RdFields, decoded_entries, decoded_scene, largest_errors
from kissgs.planning.rd_model import (
    FEW,
    SEEN,
    SH_MEAN_SQUARE,
    CodebookErrorModel,
    Costs,
    RdCriterion,
    default_error,
    lambda_for,
)
from kissgs.planning.rdo_quantize import largest_changes
from kissgs.planning.rotation_forms import choose_forms
from kissgs.planning.rows import for_each_block, selected
from kissgs.planning.sh_codebook import bounded_weights, fit_codebook, size_weights
from kissgs.settings import EncodeSettings

ColorRefit = Callable[[Splats, Int[np.ndarray, " M"]], Float32[np.ndarray, "M 3"]]
"""Function that returns better base colours for the decoded Gaussians and their indices in the scene."""

SAMPLE, SAMPLE_ENTRIES = 1 << 15, 1024
"""Number of Gaussians and of codebook entries from which the codebook's error is estimated."""

MAX_DISPLAYED_ERROR = 3.0
"""Largest squared error of a displayed colour, summed over RGB from 0 to 1."""

MAX_COMPENSATION = np.float32(0.5 / SH_C0)
"""Largest change of a base colour that compensates lost SH coefficients: half of a colour's range."""

SENSITIVITY_SHRINK, SIZE_POWER = 0.55, 0.64
"""Exponents of the codebook's weights: colour sensitivity to the power of 1 - SENSITIVITY_SHRINK · view uncertainty,
times (opacity × cross-section) to the power of SIZE_POWER · view uncertainty (:func:`size_weights`)."""

SH_WEIGHTS = (1e-2, 1e2)
"""Bounds of the codebook's weights, in units of their median."""

MANY_PRUNED = 0.2
"""Share of pruned Gaussians above which the report explains why they were pruned."""

REFIT_GAIN = 0.17
"""PSNR gain per iteration of the colour refit, decibels: below the measured mean, so that it holds for most scenes."""


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
) -> EncodingPlan:
    """Plan the Gaussians ``kept``, at least one of which a camera has seen, for a container."""
    progress("rate_distortion", 0.0)
    scene = PlannedScene(len(splats), len(kept), splats.sh_degree)
    costs = Costs.of(sensitivity, splats, pool)
    return_free_memory()
    if len(kept) < len(splats):
        costs = costs.keep(kept)
    sh_model = _codebook_error_model(splats, kept, sensitivity, settings, pool)
    threshold_bits = settings.prune_threshold_bits * (1 - sensitivity.view_uncertainty)
    lambdas = _LambdaEstimate(
        costs,
        sh_model,
        threshold_bits,
        settings,
        sensitivity.view_uncertainty,
        settings.color_refit_iterations if recolor is not None else 0,
    )
    rd_lambda, default_lambda = lambdas.choose(default_error(costs, splats, kept, sh_model))
    slack = max(1.0, float(np.sqrt(rd_lambda / default_lambda)))
    pruned_by_rd = costs.pruned_by_rd(rd_lambda, threshold_bits, default_lambda)
    note = _pruning_note(pruned_by_rd, costs)
    del lambdas  # it holds the costs of what is pruned now
    if pruned_by_rd.any():
        remaining = np.flatnonzero(~pruned_by_rd).astype(np.int32)
        kept, costs = kept.take(remaining), costs.keep(remaining)
        del remaining
    del pruned_by_rd
    condense = container.tables is None and not keep_costs
    if condense:
        costs = costs.of_rounding()
    classes = costs.classes(settings.step_classes, selected(splats.means, kept))
    criterion = RdCriterion(costs, classes, rd_lambda)
    criterion = criterion.condensed() if condense else criterion
    del costs
    return_free_memory()
    progress("order", 0.0)
    grid = layout_grid(splats.means, kept, 16, settings, pool, lambda fraction: progress("order", fraction), classes)
    grid = grid.with_padding_last() if container.padding_last else grid
    order = grid.cells[grid.mask]
    place = np.empty(len(splats), np.int32)
    place[kept] = np.arange(len(kept), dtype=np.int32)
    rank = place.take(order)
    del place, kept
    criterion = criterion.take(rank)
    del classes, rank
    return_free_memory()

    progress("forms", 0.0)
    shapes, form_error = choose_forms(
        splats, grid.cells, grid.side, settings, pool, lambda fraction: progress("forms", fraction)
    )
    shapes = shapes.take(grid.mask)
    weights, size = (
        _sh_weights(sensitivity, order, splats),
        sh_model.best_size(rd_lambda, len(order), settings.gaussians_per_codebook_entry, container.entry_bits),
    )
    codebook = fit_codebook(splats, order, weights, size, settings, container, pool, progress)
    del weights
    return_free_memory()
    progress("rounding", 0.0)
    captured = sensitivity.captured.take(order)
    largest = largest_changes(sensitivity.coverage.take(order), captured, slack)
    quantizer = RdFields(container, settings, criterion, largest, pool)
    fields = quantizer.shapes(shapes, selected(sensitivity.shape_hessian, order))
    fields["means"] = quantizer.means(splats, order, np.rint(captured + np.log2(slack)).astype(np.int8))

    rest = decoded_entries(codebook, splats.shN.shape[1])
    base = _compensated_colors(splats, order, sensitivity, rest, codebook.labels, pool)
    if recolor is not None:
        base = recolor(decoded_scene(fields, base, rest[codebook.labels[: len(order)]]), order)
    fields["f_dc"], clipped = quantizer.colors(base)
    errors = largest_errors(fields, shapes, selected(splats.means, order), selected(splats.sh0, order), pool)
    return EncodingPlan(
        scene=scene,
        grid=grid,
        fields={
            **{name: field.take(grid.cell_to_gaussian) for name, field in fields.items()},  # one row for every cell
            "f_rest_centroids": codebook.centroids,
        },
        codebook=codebook,
        classes=criterion.classes,
        form_error=form_error,
        clipped_colors=clipped,
        errors={**errors, "f_rest_centroids": codebook.errors},
        costs=criterion.costs if keep_costs else None,
        rd_lambda=rd_lambda,
        note=note,
    )


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
        basis = sensitivity.mean_sh_basis.take(some, axis=0)
        change = np.einsum("nk,nkc->nc", basis, lost) / np.float32(SH_C0)
        base[rows] += np.clip(change, -MAX_COMPENSATION, MAX_COMPENSATION)

    if splats.sh_degree > 0:
        for_each_block(len(order), compensate, pool)
    return base


@dataclass(frozen=True, slots=True, eq=False)
class _LambdaEstimate:
    """Estimate of lambda for a given error of the scene."""

    costs: Costs
    sh_model: CodebookErrorModel
    threshold_bits: float
    settings: EncodeSettings
    view_uncertainty: float
    refits: int

    def choose(self, usual: float) -> tuple[float, float]:
        """Return the lambda of the settings, and that of the default quality, of mean squared error ``usual``."""
        default_lambda = self.for_error(usual, 0.0)
        if self.settings.rd_lambda is not None:
            return self.settings.rd_lambda, default_lambda
        if self.settings.psnr is not None:
            return self.for_error(10 ** (-self.settings.psnr / 10), 0.0), default_lambda
        return self.for_error(usual, self.settings.quality_offset_db), default_lambda

    def for_error(self, error: float, quality_offset_db: float) -> float:
        """Return the lambda at which the squared error is about ``quality_offset_db`` decibels below ``error``."""
        error *= 10 ** (-(quality_offset_db - REFIT_GAIN * self.refits) / 10)
        return lambda_for(
            error,
            self.costs,
            self.sh_model,
            self.threshold_bits,
            self.settings.gaussians_per_codebook_entry,
            self.view_uncertainty,
        )


def _pruning_note(pruned_by_rd: Bool[np.ndarray, " M"], costs: Costs) -> str:
    """Return a sentence if more than a fifth of the Gaussians are pruned, else an empty string."""
    count = int(pruned_by_rd.sum())
    if count <= MANY_PRUNED * len(pruned_by_rd):
        return ""
    seen = float((costs.coverage[pruned_by_rd] >= SEEN).mean())
    return (
        f"{count:,} of {len(pruned_by_rd):,} Gaussians were pruned because removing each costs less than its bits; "
        f"cameras saw {seen:.0%} of them from nearby (--set prune_threshold_bits=0 keeps all)"
    )


def _codebook_error_model(
    splats: Splats, kept: Int[np.ndarray, " M"], sensitivity: Sensitivity, settings: EncodeSettings, pool: Workers
) -> CodebookErrorModel:
    """Estimate the codebook's error from a small codebook for a sample of the Gaussians."""
    if splats.sh_degree == 0 or len(kept) < FEW:
        return CodebookErrorModel()
    rng = np.random.Generator(np.random.PCG64(settings.seed))
    some = np.sort(rng.choice(kept, min(SAMPLE, len(kept)), replace=False))
    vectors = splats.shN.reshape(len(splats), -1)
    entries = min(SAMPLE_ENTRIES, len(some) // 16)
    clusters = kmeans.fit(
        vectors,
        some,
        _sh_weights(sensitivity, some, splats),
        entries,
        pool,
        kmeans.KMeansOptions(
            seed=settings.seed,
            iterations=settings.sh_kmeans_iterations,
            neighbors=settings.sh_neighbors,
            tolerance=settings.sh_tolerance,
            lattice=0.0,
        ),
    )
    squared = np.square(vectors[some] - clusters.centroids[clusters.labels], dtype=np.float64).sum(axis=1)
    squared = np.minimum(squared, MAX_DISPLAYED_ERROR / SH_MEAN_SQUARE)
    colors = sensitivity.color_weight[kept].astype(np.float64).sum() * SH_MEAN_SQUARE
    share = sensitivity.color_weight[some].astype(np.float64)
    weighted = float(squared @ share / max(share.sum(), 1e-300) * colors)
    return CodebookErrorModel(entries, weighted, float(squared.mean() * colors))


def _sh_weights(sensitivity: Sensitivity, chosen: Int[np.ndarray, " M"], splats: Splats) -> Float32[np.ndarray, " M"]:
    """Return the weight of each Gaussian's SH vector in the codebook."""
    if splats.sh_degree == 0:
        return np.ones(len(chosen), np.float32)
    power = np.float32(max(1 - SENSITIVITY_SHRINK * sensitivity.view_uncertainty, 0.0))
    sizes = size_weights(splats, SIZE_POWER * sensitivity.view_uncertainty)[chosen]
    return bounded_weights(sensitivity.color_weight[chosen] ** power * sizes, *SH_WEIGHTS)
