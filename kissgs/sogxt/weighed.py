"""Choices weighed by what they cost in pictures: order, steps, codebook, levels, omissions; one price for all bits."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from kissgs._typing import Float32, Float64, Int
from kissgs.importance import Importance
from kissgs.parallel import Workers
from kissgs.progress import Progress
from kissgs.settings import EncodeSettings
from kissgs.sogxt import kmeans
from kissgs.sogxt.choice import Choice
from kissgs.sogxt.codebook import COEFFICIENTS, Codebook, bounded, fit_codebook
from kissgs.sogxt.economy import GLOSS, Costs, Gloss, paper_error, price_for, step
from kissgs.sogxt.order import place
from kissgs.sogxt.pras import choose_forms
from kissgs.sogxt.quantize import MEANS_TOP, Quantized, quantize_means, signed_exp, signed_log, tame
from kissgs.sogxt.rounding import COARSEST, quantize_by_class, round_shapes
from kissgs.splats import SH_C0, Splats

Recolor = Callable[[Splats, Int[np.ndarray, " M"]], Float32[np.ndarray, "M 3"]]
"""Given what a decoder will find, and which Gaussians of the scene these are: better base colours for them."""

TRIAL, TRIAL_ENTRIES = 1 << 15, 1024
"""Gaussians, and entries of the codebook, from which the cost of gloss is told."""

SH_HEDGE = 1.5
"""Weights of the codebook are colours' importance to the power of 1 minus this times the hedge, and bounded:"""

SH_WEIGHTS = (1e-2, 1e2)
"""in units of the median."""

OUTLIERS = 1e-4

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
    drop, price = settings.drop * (1 - importance.hedge), settings.price
    if price is None:
        error = 10 ** (-settings.psnr / 10) if settings.psnr is not None else paper_error(costs, splats, kept, gloss)
        gain = settings.fidelity if settings.psnr is None else 0.0
        gain -= REFIT_GAIN * settings.refit if recolor is not None else 0.0
        price = price_for(error * 10 ** (-gain / 10), costs, gloss, drop, settings.sh_ratio, importance.hedge)
    worth = np.flatnonzero(~costs.negligible(price, drop))
    kept, costs = kept[worth], costs.take(worth)
    classes = costs.classes(settings.classes)
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
    weights, size = _sh_weights(importance, order), gloss.best_size(price, len(order), settings.sh_ratio)
    codebook = fit_codebook(shown, np.arange(len(order)), weights, size, settings, pool, progress)
    progress("rounding", 0.0)
    values = np.concatenate([shown.opacities[:, None], scales, quats], axis=1).astype(np.float64)
    parts = (
        quantize_by_class(values[:, :1], costs.opacity, classes, price, COARSEST["opacities"]),
        quantize_by_class(values[:, 1:4], costs.scale, classes, price, COARSEST["scales"]),
        quantize_by_class(values[:, 4:], 3 * costs.turn, classes, price, COARSEST["quaternions"]),
    )
    if settings.round_by_price:
        parts = round_shapes(values, parts, importance.shapes[order], forms, costs, classes, price, pool)
    fields = dict(zip(("opacities", "scales", "quaternions"), parts, strict=True))
    fields["means"] = _means(shown.means, costs, classes, price)

    rest = _gloss_of(codebook, shown)
    base = shown.sh0 + np.einsum("nk,nkc->nc", importance.directions[order], shown.shN - rest) / np.float32(SH_C0)
    if recolor is not None:
        base = recolor(_decoded(fields, base.astype(np.float32), rest), order)
    fields["f_dc"], tamed = _colors(base.astype(np.float64), costs, classes, price)
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
        _sh_weights(importance, some),
        entries,
        pool,
        seed=settings.seed,
        rounds=2,
        reach=12,
        tolerance=settings.sh_tolerance,
        lattice=0.0,
    )
    squared = np.square(vectors - clusters.centroids[clusters.labels], dtype=np.float64).sum(axis=1)
    colors = importance.colors[kept].astype(np.float64).sum() * GLOSS
    share = importance.colors[some].astype(np.float64)
    weighed = float(squared @ share / max(share.sum(), 1e-300) * colors)
    return Gloss(entries, weighed, float(squared.mean() * colors))


def _sh_weights(importance: Importance, chosen: Int[np.ndarray, " M"]) -> Float32[np.ndarray, " M"]:
    """How much the gloss of each counts."""
    power = max(1 - SH_HEDGE * importance.hedge, 0.0)
    return bounded(importance.colors[chosen] ** np.float32(power), *SH_WEIGHTS)


def _means(means: Float32[np.ndarray, "M 3"], costs: Costs, classes: Int[np.ndarray, " M"], price: float) -> Quantized:
    """Positions, in each class as many bits as the price asks for."""
    logs = signed_log(means)
    unit = max(float(np.ptp(logs)), 1e-30) / MEANS_TOP
    coarse = [
        np.clip(np.floor(np.log2(step(float(costs.place[classes == c].mean()), price) / unit) + 0.5), 0, 8)
        for c in range(int(classes.max()) + 1)
    ]
    return quantize_means(means, bits=16 - np.array(coarse, np.int64)[classes])


def _colors(
    base: Float64[np.ndarray, "M 3"], costs: Costs, classes: Int[np.ndarray, " M"], price: float
) -> tuple[Quantized, int]:
    """Base colours, and how many of them are outliers that were pulled in."""
    finest = min(step(float(costs.color[classes == c].mean()), price) for c in range(int(classes.max()) + 1))
    tamed = tame(base, step=finest, share=OUTLIERS)
    levels = quantize_by_class(tamed, costs.color, classes, price, COARSEST["f_dc"])
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
