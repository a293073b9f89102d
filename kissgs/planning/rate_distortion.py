"""Choices weighed by what they cost in pictures: order, steps, codebook, levels, omissions; one price for all bits."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from kissgs.core.array_types import Bool, Float, Float32, Float64, Int
from kissgs.core.progress import Progress
from kissgs.core.sensitivity import Sensitivity
from kissgs.core.signed_log import signed_exp, signed_log
from kissgs.core.splats import SH_C0, Splats
from kissgs.core.threads import Workers
from kissgs.planning import kmeans
from kissgs.planning.encoding_plan import EncodingPlan
from kissgs.planning.layout import layout_grid
from kissgs.planning.quantize import MEANS_TOP, Quantized, clip_outliers, means_bits, quantize_means
from kissgs.planning.rd_model import GLOSS, SEEN, CodebookErrorModel, Costs, default_error, lambda_for, step
from kissgs.planning.rdo_quantize import largest_changes, quantize_by_class, rdo_quantize_shapes
from kissgs.planning.rotation_forms import canonicalize
from kissgs.planning.sh_codebook import COEFFICIENTS, Codebook, bounded_weights, fit_codebook, guessed_weights
from kissgs.settings import EncodeSettings

ColorRefit = Callable[[Splats, Int[np.ndarray, " M"]], Float32[np.ndarray, "M 3"]]
"""Given what a decoder will find, and which Gaussians of the scene these are: better base colours for them."""

TRIAL, TRIAL_ENTRIES = 1 << 15, 1024
"""Gaussians, and entries of the codebook, from which the cost of gloss is told."""

DISPLAYED = 3.0
"""Largest squared error of a colour that a display can show, summed over RGB from 0 to 1."""

MADE_UP = np.float32(0.5 / SH_C0)
"""Largest change of a base colour for the sake of lost SH coefficients: half of a colour's range."""

SH_HEDGE, SIZE_HEDGE = 0.55, 0.64
"""Weights of the codebook: colour sensitivity to the power of 1 minus the first times the view uncertainty, times what
large and opaque Gaussians show anywhere (:func:`guessed_weights`) to the second times the view uncertainty; bounded:"""

SH_WEIGHTS = (1e-2, 1e2)
"""in units of the median."""

OUTLIERS = 1e-4

MANY_DROPPED = 0.2
"""Share of the Gaussians from which on the report says why they were left out."""

REFIT_GAIN = 0.25
"""Decibels by a step of refitting base colours: less than what is measured on average, for the sake of the worst."""


def plan_rate_distortion(
    splats: Splats,
    kept: Int[np.ndarray, " M"],
    sensitivity: Sensitivity,
    recolor: ColorRefit | None,
    settings: EncodeSettings,
    pool: Workers,
    progress: Progress,
) -> EncodingPlan:
    """Choose everything for the Gaussians ``kept``, at least one of which is seen."""
    progress("rate_distortion", 0.0)
    costs, gloss = Costs.of(sensitivity, splats).take(kept), _trial(splats, kept, sensitivity, settings, pool)
    drop = settings.prune_threshold_bits * (1 - sensitivity.view_uncertainty)
    prices = _Prices(
        costs,
        gloss,
        drop,
        settings,
        sensitivity.view_uncertainty,
        settings.color_refit_iterations if recolor is not None else 0,
    )
    rd_lambda, usual_price = prices.wanted(default_error(costs, splats, kept, gloss))
    slack = max(1.0, float(np.sqrt(rd_lambda / usual_price)))
    pruned_by_rd = costs.pruned_by_rd(rd_lambda, drop, usual_price)
    note = _why_dropped(pruned_by_rd, costs)
    worth = np.flatnonzero(~pruned_by_rd)
    kept, costs = kept[worth], costs.take(worth)
    classes = costs.classes(settings.step_classes, splats.means[kept])
    progress("order", 0.0)
    grid = layout_grid(splats.means, kept, 16, settings, pool, lambda fraction: progress("order", fraction), classes)
    order = grid.cells[grid.mask]
    rank = np.searchsorted(kept, order)
    classes, costs, shown = classes[rank], costs.take(rank), splats.select(order)

    progress("forms", 0.0)
    quats, scales, form_error, forms = canonicalize(
        splats, grid.cells, grid.side, settings, pool, lambda fraction: progress("forms", fraction)
    )
    quats, scales, forms = quats[grid.mask], scales[grid.mask], forms[grid.mask]
    weights, size = (
        _sh_weights(sensitivity, order, splats),
        gloss.best_size(rd_lambda, len(order), settings.gaussians_per_codebook_entry),
    )
    codebook = fit_codebook(shown, np.arange(len(order)), weights, size, settings, pool, progress)
    progress("rounding", 0.0)
    values = np.concatenate([shown.opacities[:, None], scales, quats], axis=1).astype(np.float64)
    captured = sensitivity.captured[order]
    largest = largest_changes(sensitivity.coverage[order], captured, slack)
    parts = (
        quantize_by_class(values[:, :1], costs.opacity, classes, rd_lambda, largest["opacities"]),
        quantize_by_class(values[:, 1:4], costs.scale, classes, rd_lambda, largest["scales"]),
        quantize_by_class(values[:, 4:], 3 * costs.rotation, classes, rd_lambda, largest["quaternions"]),
    )
    if settings.rdo_quantization:
        parts = rdo_quantize_shapes(
            values, parts, sensitivity.shape_hessian[order], forms, costs, classes, rd_lambda, largest, pool
        )
    fields = dict(zip(("opacities", "scales", "quaternions"), parts, strict=True))
    coarser = np.rint(captured + np.log2(slack))
    fields["means"] = _means(shown, costs, classes, rd_lambda, settings.means_tolerance, coarser)

    rest = _gloss_of(codebook, shown)
    made_up = np.einsum("nk,nkc->nc", sensitivity.mean_sh_basis[order], shown.shN - rest) / np.float32(SH_C0)
    base = shown.sh0 + np.clip(made_up, -MADE_UP, MADE_UP)
    if recolor is not None:
        base = recolor(_decoded(fields, base.astype(np.float32), rest), order)
    fields["f_dc"], tamed = _colors(base.astype(np.float64), costs, classes, rd_lambda, largest["f_dc"])
    wanted = {
        "means": signed_log(shown.means),
        "opacities": values[:, :1],
        "scales": values[:, 1:4],
        "quaternions": values[:, 4:],
        "f_dc": shown.sh0,
    }
    errors = {name: np.abs(fields[name].values() - wanted[name]).max(axis=0).tolist() for name in wanted}
    half = (codebook.centroids.high - codebook.centroids.low).astype(np.float64) / codebook.centroids.top / 2
    return EncodingPlan(
        grid=grid,
        fields={
            **{name: field.take(grid.cell_to_gaussian) for name, field in fields.items()},  # one row for every cell
            "f_rest_centroids": codebook.centroids,
        },
        codebook=codebook,
        classes=classes,
        form_error=form_error,
        clipped_colors=tamed,
        errors={**errors, "f_rest_centroids": half.tolist()},
        costs=costs,
        rd_lambda=rd_lambda,
        note=note,
    )


@dataclass(frozen=True, slots=True, eq=False)
class _Prices:
    """Prices at which a scene is left at a given error."""

    costs: Costs
    gloss: CodebookErrorModel
    drop: float
    settings: EncodeSettings
    view_uncertainty: float
    refits: int

    def wanted(self, usual: float) -> tuple[float, float]:
        """The price that the settings ask for, and that of default quality, whose mean squared error is ``usual``."""
        by_default = self.leaving(usual, 0.0)
        if self.settings.rd_lambda is not None:
            return self.settings.rd_lambda, by_default
        if self.settings.psnr is not None:
            return self.leaving(10 ** (-self.settings.psnr / 10), 0.0), by_default
        return self.leaving(usual, self.settings.quality_offset_db), by_default

    def leaving(self, error: float, quality_offset_db: float) -> float:
        """The price at which the mean squared error is about ``quality_offset_db`` decibels less than ``error``."""
        error *= 10 ** (-(quality_offset_db - REFIT_GAIN * self.refits) / 10)
        return lambda_for(
            error, self.costs, self.gloss, self.drop, self.settings.gaussians_per_codebook_entry, self.view_uncertainty
        )


def _why_dropped(pruned_by_rd: Bool[np.ndarray, " M"], costs: Costs) -> str:
    """A sentence about a drop of more than a fifth of the Gaussians, or nothing."""
    count = int(pruned_by_rd.sum())
    if count <= MANY_DROPPED * len(pruned_by_rd):
        return ""
    seen = float((costs.coverage[pruned_by_rd] >= SEEN).mean())
    return (
        f"{count:,} of {len(pruned_by_rd):,} Gaussians were left out because each shows less than its bytes are worth; "
        f"{seen:.0%} of them were looked at from nearby (--set prune_threshold_bits=0 keeps all)"
    )


def _trial(
    splats: Splats, kept: Int[np.ndarray, " M"], sensitivity: Sensitivity, settings: EncodeSettings, pool: Workers
) -> CodebookErrorModel:
    """What gloss costs, told from a small codebook for some of the Gaussians."""
    if splats.sh_degree == 0 or len(kept) < 64:
        return CodebookErrorModel()
    rng = np.random.Generator(np.random.PCG64(settings.seed))
    some = np.sort(rng.choice(kept, min(TRIAL, len(kept)), replace=False))
    vectors = np.ascontiguousarray(splats.shN[some].reshape(len(some), -1))
    entries = min(TRIAL_ENTRIES, len(some) // 16)
    clusters = kmeans.fit(
        vectors,
        _sh_weights(sensitivity, some, splats),
        entries,
        pool,
        seed=settings.seed,
        rounds=2,
        reach=12,
        tolerance=settings.sh_tolerance,
        lattice=0.0,
    )
    squared = np.square(vectors - clusters.centroids[clusters.labels], dtype=np.float64).sum(axis=1)
    squared = np.minimum(squared, DISPLAYED / GLOSS)
    colors = sensitivity.color_weight[kept].astype(np.float64).sum() * GLOSS
    share = sensitivity.color_weight[some].astype(np.float64)
    weighed = float(squared @ share / max(share.sum(), 1e-300) * colors)
    return CodebookErrorModel(entries, weighed, float(squared.mean() * colors))


def _sh_weights(sensitivity: Sensitivity, chosen: Int[np.ndarray, " M"], splats: Splats) -> Float32[np.ndarray, " M"]:
    """How much the gloss of each counts."""
    power = np.float32(max(1 - SH_HEDGE * sensitivity.view_uncertainty, 0.0))
    sizes = guessed_weights(splats, SIZE_HEDGE * sensitivity.view_uncertainty)[chosen]
    return bounded_weights(sensitivity.color_weight[chosen] ** power * sizes, *SH_WEIGHTS)


def _means(
    shown: Splats,
    costs: Costs,
    classes: Int[np.ndarray, " M"],
    rd_lambda: float,
    tolerance: float,
    coarser: Float[np.ndarray, " M"],
) -> Quantized:
    """Positions, in each class as many bits as the price asks for.

    Each has at most its number in ``coarser`` less than the same step for all would give them, at which the median
    Gaussian moves by ``tolerance`` of its size.
    """
    means = shown.means
    most = np.clip(16 - means_bits(shown, np.arange(len(shown)), tolerance) + coarser, 0, 8)
    logs = signed_log(means)
    unit = max(float(np.ptp(logs)), 1e-30) / MEANS_TOP
    coarse = [
        max(np.floor(np.log2(step(float(costs.position[classes == c].mean()), rd_lambda) / unit) + 0.5), 0)
        for c in range(int(classes.max()) + 1)
    ]
    return quantize_means(means, bits=16 - np.minimum(np.array(coarse)[classes], most).astype(np.int64))


def _colors(
    base: Float64[np.ndarray, "M 3"],
    costs: Costs,
    classes: Int[np.ndarray, " M"],
    rd_lambda: float,
    coarsest: Float64[np.ndarray, " M"],
) -> tuple[Quantized, int]:
    """Base colours, and how many of them are outliers that were pulled in."""
    finest = min(step(float(costs.color[classes == c].mean()), rd_lambda) for c in range(int(classes.max()) + 1))
    tamed = clip_outliers(base, step=finest, share=OUTLIERS)
    levels = quantize_by_class(tamed, costs.color, classes, rd_lambda, coarsest)
    return levels, int((tamed != base).any(axis=1).sum())


def _gloss_of(codebook: Codebook, shown: Splats) -> Float32[np.ndarray, "M K 3"]:
    """SH rest as a decoder will find it."""
    kinds = shown.shN.shape[1]
    entries = codebook.centroids.values().reshape(-1, 3, COEFFICIENTS)[:, :, :kinds].transpose(0, 2, 1)
    return np.ascontiguousarray(entries.astype(np.float32)[codebook.labels[: len(shown)]])


def _decoded(
    fields: dict[str, Quantized], sh0: Float32[np.ndarray, "M 3"], shN: Float32[np.ndarray, "M K 3"]
) -> Splats:
    """As a decoder will find it."""
    quats = fields["quaternions"].values()
    norms = np.linalg.norm(quats, axis=1, keepdims=True)
    return Splats(
        means=signed_exp(fields["means"].values()).astype(np.float32),
        quats=(quats / np.where(norms > 0, norms, 1)).astype(np.float32),
        scales=fields["scales"].values().astype(np.float32),
        opacities=fields["opacities"].values()[:, 0].astype(np.float32),
        sh0=sh0,
        shN=shN,
    )
