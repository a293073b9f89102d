"""Choices weighed by what they cost in pictures: order, steps, codebook, levels, omissions; one price for all bits."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from kissgs._typing import Bool, Float, Float32, Float64, Int
from kissgs.importance import Importance
from kissgs.parallel import Workers
from kissgs.progress import Progress
from kissgs.settings import EncodeSettings
from kissgs.sogxt import kmeans
from kissgs.sogxt.choice import Choice
from kissgs.sogxt.codebook import COEFFICIENTS, Codebook, bounded, fit_codebook, guessed_weights
from kissgs.sogxt.economy import GLOSS, SEEN, Costs, Gloss, default_error, price_for, step
from kissgs.sogxt.order import place
from kissgs.sogxt.pras import choose_forms
from kissgs.sogxt.quantize import MEANS_TOP, Quantized, means_bits, quantize_means, signed_exp, signed_log, tame
from kissgs.sogxt.rounding import largest_changes, quantize_by_class, round_shapes
from kissgs.splats import SH_C0, Splats

Recolor = Callable[[Splats, Int[np.ndarray, " M"]], Float32[np.ndarray, "M 3"]]
"""Given what a decoder will find, and which Gaussians of the scene these are: better base colours for them."""

TRIAL, TRIAL_ENTRIES = 1 << 15, 1024
"""Gaussians, and entries of the codebook, from which the cost of gloss is told."""

DISPLAYED = 3.0
"""Largest squared error of a colour that a display can show, summed over RGB from 0 to 1."""

MADE_UP = np.float32(0.5 / SH_C0)
"""Largest change of a base colour for the sake of lost SH coefficients: half of a colour's range."""

SH_HEDGE, SIZE_HEDGE = 0.55, 0.64
"""Weights of the codebook are colours' importance to the power of 1 minus the first times the hedge, times what large
and opaque Gaussians show anywhere (:func:`guessed_weights`) to the second times the hedge; and bounded:"""

SH_WEIGHTS = (1e-2, 1e2)
"""in units of the median."""

OUTLIERS = 1e-4

MANY_DROPPED = 0.2
"""Share of the Gaussians from which on the report says why they were left out."""

REFIT_GAIN = 0.25
"""Decibels by a step of refitting base colours: less than what is measured on average, for the sake of the worst."""


def weigh(
    splats: Splats,
    kept: Int[np.ndarray, " M"],
    importance: Importance,
    recolor: Recolor | None,
    settings: EncodeSettings,
    pool: Workers,
    progress: Progress,
) -> Choice:
    """Choose everything for the Gaussians ``kept``, at least one of which is seen."""
    progress("price", 0.0)
    costs, gloss = Costs.of(importance, splats).take(kept), _trial(splats, kept, importance, settings, pool)
    drop = settings.drop * (1 - importance.hedge)
    prices = _Prices(costs, gloss, drop, settings, importance.hedge, settings.refit if recolor is not None else 0)
    price, usual_price = prices.wanted(default_error(costs, splats, kept, gloss))
    slack = max(1.0, float(np.sqrt(price / usual_price)))
    negligible = costs.negligible(price, drop, usual_price)
    note = _why_dropped(negligible, costs)
    worth = np.flatnonzero(~negligible)
    kept, costs = kept[worth], costs.take(worth)
    classes = costs.classes(settings.classes, splats.means[kept])
    progress("order", 0.0)
    grid = place(splats.means, kept, 16, settings, pool, lambda fraction: progress("order", fraction), classes)
    order = grid.cells[grid.mask]
    rank = np.searchsorted(kept, order)
    classes, costs, shown = classes[rank], costs.take(rank), splats.select(order)

    progress("forms", 0.0)
    quats, scales, form_error, forms = choose_forms(
        splats, grid.cells, grid.side, settings, pool, lambda fraction: progress("forms", fraction)
    )
    quats, scales, forms = quats[grid.mask], scales[grid.mask], forms[grid.mask]
    weights, size = _sh_weights(importance, order, splats), gloss.best_size(price, len(order), settings.sh_ratio)
    codebook = fit_codebook(shown, np.arange(len(order)), weights, size, settings, pool, progress)
    progress("rounding", 0.0)
    values = np.concatenate([shown.opacities[:, None], scales, quats], axis=1).astype(np.float64)
    captured = importance.captured[order]
    largest = largest_changes(importance.coverage[order], captured, slack)
    parts = (
        quantize_by_class(values[:, :1], costs.opacity, classes, price, largest["opacities"]),
        quantize_by_class(values[:, 1:4], costs.scale, classes, price, largest["scales"]),
        quantize_by_class(values[:, 4:], 3 * costs.turn, classes, price, largest["quaternions"]),
    )
    if settings.round_by_price:
        parts = round_shapes(values, parts, importance.shapes[order], forms, costs, classes, price, largest, pool)
    fields = dict(zip(("opacities", "scales", "quaternions"), parts, strict=True))
    coarser = np.rint(captured + np.log2(slack))
    fields["means"] = _means(shown, costs, classes, price, settings.means_tolerance, coarser)

    rest = _gloss_of(codebook, shown)
    made_up = np.einsum("nk,nkc->nc", importance.directions[order], shown.shN - rest) / np.float32(SH_C0)
    base = shown.sh0 + np.clip(made_up, -MADE_UP, MADE_UP)
    if recolor is not None:
        base = recolor(_decoded(fields, base.astype(np.float32), rest), order)
    fields["f_dc"], tamed = _colors(base.astype(np.float64), costs, classes, price, largest["f_dc"])
    wanted = {
        "means": signed_log(shown.means),
        "opacities": values[:, :1],
        "scales": values[:, 1:4],
        "quaternions": values[:, 4:],
        "f_dc": shown.sh0,
    }
    errors = {name: np.abs(fields[name].values() - wanted[name]).max(axis=0).tolist() for name in wanted}
    half = (codebook.centroids.high - codebook.centroids.low).astype(np.float64) / codebook.centroids.top / 2
    return Choice(
        grid=grid,
        fields={
            **{name: field.take(grid.rows) for name, field in fields.items()},  # one row for every cell
            "f_rest_centroids": codebook.centroids,
        },
        codebook=codebook,
        classes=classes,
        form_error=form_error,
        tamed=tamed,
        errors={**errors, "f_rest_centroids": half.tolist()},
        costs=costs,
        price=price,
        note=note,
    )


@dataclass(frozen=True, slots=True, eq=False)
class _Prices:
    """Prices at which a scene is left at a given error."""

    costs: Costs
    gloss: Gloss
    drop: float
    settings: EncodeSettings
    hedge: float
    refits: int

    def wanted(self, usual: float) -> tuple[float, float]:
        """The price that the settings ask for, and that of default quality, whose mean squared error is ``usual``."""
        by_default = self.leaving(usual, 0.0)
        if self.settings.price is not None:
            return self.settings.price, by_default
        if self.settings.psnr is not None:
            return self.leaving(10 ** (-self.settings.psnr / 10), 0.0), by_default
        return self.leaving(usual, self.settings.fidelity), by_default

    def leaving(self, error: float, fidelity: float) -> float:
        """The price at which the mean squared error is about ``fidelity`` decibels less than ``error``."""
        error *= 10 ** (-(fidelity - REFIT_GAIN * self.refits) / 10)
        return price_for(error, self.costs, self.gloss, self.drop, self.settings.sh_ratio, self.hedge)


def _why_dropped(negligible: Bool[np.ndarray, " M"], costs: Costs) -> str:
    """A sentence about a drop of more than a fifth of the Gaussians, or nothing."""
    count = int(negligible.sum())
    if count <= MANY_DROPPED * len(negligible):
        return ""
    seen = float((costs.coverage[negligible] >= SEEN).mean())
    return (
        f"{count:,} of {len(negligible):,} Gaussians were left out because each shows less than its bytes are worth; "
        f"{seen:.0%} of them were looked at from nearby (--set drop=0 keeps all)"
    )


def _trial(
    splats: Splats, kept: Int[np.ndarray, " M"], importance: Importance, settings: EncodeSettings, pool: Workers
) -> Gloss:
    """What gloss costs, told from a small codebook for some of the Gaussians."""
    if splats.sh_degree == 0 or len(kept) < 64:
        return Gloss()
    rng = np.random.Generator(np.random.PCG64(settings.seed))
    some = np.sort(rng.choice(kept, min(TRIAL, len(kept)), replace=False))
    vectors = np.ascontiguousarray(splats.shN[some].reshape(len(some), -1))
    entries = min(TRIAL_ENTRIES, len(some) // 16)
    clusters = kmeans.fit(
        vectors,
        _sh_weights(importance, some, splats),
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
    colors = importance.colors[kept].astype(np.float64).sum() * GLOSS
    share = importance.colors[some].astype(np.float64)
    weighed = float(squared @ share / max(share.sum(), 1e-300) * colors)
    return Gloss(entries, weighed, float(squared.mean() * colors))


def _sh_weights(importance: Importance, chosen: Int[np.ndarray, " M"], splats: Splats) -> Float32[np.ndarray, " M"]:
    """How much the gloss of each counts."""
    power = np.float32(max(1 - SH_HEDGE * importance.hedge, 0.0))
    sizes = guessed_weights(splats, SIZE_HEDGE * importance.hedge)[chosen]
    return bounded(importance.colors[chosen] ** power * sizes, *SH_WEIGHTS)


def _means(
    shown: Splats,
    costs: Costs,
    classes: Int[np.ndarray, " M"],
    price: float,
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
        max(np.floor(np.log2(step(float(costs.place[classes == c].mean()), price) / unit) + 0.5), 0)
        for c in range(int(classes.max()) + 1)
    ]
    return quantize_means(means, bits=16 - np.minimum(np.array(coarse)[classes], most).astype(np.int64))


def _colors(
    base: Float64[np.ndarray, "M 3"],
    costs: Costs,
    classes: Int[np.ndarray, " M"],
    price: float,
    coarsest: Float64[np.ndarray, " M"],
) -> tuple[Quantized, int]:
    """Base colours, and how many of them are outliers that were pulled in."""
    finest = min(step(float(costs.color[classes == c].mean()), price) for c in range(int(classes.max()) + 1))
    tamed = tame(base, step=finest, share=OUTLIERS)
    levels = quantize_by_class(tamed, costs.color, classes, price, coarsest)
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
