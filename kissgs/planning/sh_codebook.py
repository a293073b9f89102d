"""The SH codebook: its entries, their order in the codebook's image, and its optimal size."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import numpy as np

from kissgs.core.array_types import Float32, Int
from kissgs.core.resources import Workers
from kissgs.core.sensitivity import Sensitivity
from kissgs.core.splats import MAX_CODEBOOK_SIDE, SH_REST_COUNTS, Splats
from kissgs.planning import kmeans
from kissgs.planning.clustering import ShMetric
from kissgs.planning.layout import axes_order, plas, principal_axes
from kissgs.planning.quantize import Planning, Quantized, fit_table, half_steps, nearest_levels, quantize, table_field
from kissgs.settings import EncodeSettings

COEFFICIENTS = SH_REST_COUNTS[-1]
MIN_SIDE = 8  # smallest side of a codebook in SOG-XT
WEIGHT_FLOOR, WEIGHT_CEILING = 0.1, 20.0  # in units of the median: none is ignored, none dominates

# Exponents of the codebook's weights: colour sensitivity to the power of 1 - SENSITIVITY_SHRINK · view uncertainty,
# times (opacity × cross-section) to the power of SIZE_POWER · view uncertainty (size_weights).
SENSITIVITY_SHRINK, SIZE_POWER = 0.55, 0.64
SH_WEIGHTS = (1e-2, 1e2)  # bounds of the codebook's weights, in units of their median
SORTED_AXES, SORTED_RADIUS = 16, 16  # principal axes, and first filter radius, with which PLAS refines their order
PAPER_TOP = 99  # largest level of the paper's codebook: 100 levels in every channel


@dataclass(frozen=True, slots=True)
class Codebook:
    """Codebook of S × S entries, and the entry of each Gaussian."""

    side: int
    centroids: Quantized  # 15 of red, 15 of green, 15 of blue; entries are row-major, or a list
    labels: Int[np.ndarray, " M"]  # entry of each Gaussian; a scene without Gaussians has one label, for padding
    errors: list[float]  # largest error of the entries by rounding, per channel


def fit_codebook(
    splats: Splats,
    chosen: Int[np.ndarray, " M"],
    weights: Float32[np.ndarray, " M"],
    size: float,
    planning: Planning,
    *,
    metric: ShMetric | None = None,
) -> Codebook:
    """Build the codebook for the Gaussians ``chosen``. Bands that are missing, or zero in all Gaussians, take almost no
    bytes: their tiles are constant."""
    settings, pool, is_list = planning.settings, planning.pool, planning.container.tables is not None
    dimensions = splats.shN.shape[1] * 3
    if dimensions == 0 or len(chosen) == 0:
        nothing = quantize(np.zeros((MIN_SIDE**2, 3 * COEFFICIENTS)), step=1)
        return Codebook(MIN_SIDE, nothing, np.zeros(max(len(chosen), 1), dtype=np.int32), half_steps(nothing))
    most = min(size, settings.sh_codebook_size)
    wanted = max(round(most), 1) if is_list else codebook_side(most) ** 2
    lattice, report = settings.sh_step if settings.shared_step_size else 0.0, planning.report("codebook")
    fit = partial(kmeans.fit, lattice=lattice, from_zero=is_list, metric=metric, report=report)
    clusters = fit(splats.shN.reshape(len(splats), dimensions), chosen, weights, wanted, settings, pool)
    # The smallest square that holds the entries; unused places repeat some of them.
    side = next(s for s in range(MIN_SIDE, MAX_CODEBOOK_SIDE + 1, 8) if s * s >= len(clusters.centroids))
    report = planning.report("sort codebook")
    if is_list:  # in a list, similar neighbours save less than small labels of frequent entries
        entries = clusters.centroids
        placed = np.argsort(-np.bincount(clusters.labels), kind="stable")
    else:
        entries = clusters.centroids[np.arange(side * side) % len(clusters.centroids)]
        placed = _sort(entries, settings, pool, report)
    position = np.empty(len(placed), dtype=np.int32)
    position[placed] = np.arange(len(placed), dtype=np.int32)
    full = np.zeros((len(placed), 3, COEFFICIENTS), dtype=np.float32)
    full[:, :, : dimensions // 3] = entries[placed].reshape(len(placed), -1, 3).transpose(0, 2, 1)
    rows = full.reshape(len(placed), 3 * COEFFICIENTS)
    if is_list:
        used = rows.reshape(-1, COEFFICIENTS)[:, : dimensions // 3]
        worth = np.bincount(clusters.labels, weights, minlength=len(placed))[placed]
        table = fit_table(used.ravel(), np.repeat(worth, dimensions), max(clusters.step, 1e-4), with_zero=True)
        levels = table_field(table, nearest_levels(table, rows))
        lost = np.abs(levels.values() - rows).max(axis=0) + clusters.step / 2
        return Codebook(side, levels, position[clusters.labels], lost.tolist())
    if settings.shared_step_size:
        levels = quantize(rows, step=max(clusters.step, 1e-30))
    else:
        levels = quantize(rows, step=1, shared=False, max_top=PAPER_TOP)
    return Codebook(side, levels, position[clusters.labels], half_steps(levels))


def nearest_square(size: float) -> int:
    """Return S · S entries, as many as SOG-XT can hold, for the multiple S of 8 nearest to the root of ``size``."""
    return codebook_side((size**0.5 + 4) ** 2) ** 2


def codebook_side(size: float) -> int:
    """Return S for at most ``size`` entries: a multiple of 8, rounded down, from 8 to 256."""
    side = int(size**0.5) // 8 * 8
    return min(max(side, MIN_SIDE), MAX_CODEBOOK_SIDE)


def _sort(
    entries: Float32[np.ndarray, "cells D"], settings: EncodeSettings, pool: Workers, report: Callable[[float], None]
) -> Int[np.ndarray, " cells"]:
    """Return the entry of each pixel of a tile, sorted so that neighbours are similar and the image compresses."""
    if (entries == entries[0]).all():
        return np.arange(len(entries), dtype=np.int32)
    sort = partial(plas, pool=pool, seed=settings.seed, decay=settings.plas_radius_decay, report=report)
    if settings.codebook_order == "plas":
        return sort(np.ascontiguousarray(entries))
    coordinates = principal_axes(entries, SORTED_AXES)
    order = axes_order(coordinates)
    return order if settings.codebook_order == "axes" else order[sort(coordinates[order], start_radius=SORTED_RADIUS)]


def size_weights(splats: Splats, power: float) -> Float32[np.ndarray, " N"]:
    """Return weights by size: (opacity × largest cross-section) to ``power``, bounded, in units of the median."""
    area = np.sort(splats.scales, axis=1)[:, 1:].sum(axis=1, dtype=np.float64)
    logs = area - np.logaddexp(0, -splats.opacities.astype(np.float64))
    logs = power * (logs - np.median(logs))
    return np.exp(np.clip(logs, np.log(WEIGHT_FLOOR), np.log(WEIGHT_CEILING))).astype(np.float32)


def sensitivity_weights(
    sensitivity: Sensitivity, chosen: Int[np.ndarray, " M"], splats: Splats
) -> Float32[np.ndarray, " M"]:
    """Return the weight of each Gaussian's SH vector in the codebook, by how much cameras see of its colour."""
    if splats.sh_degree == 0:
        return np.ones(len(chosen), np.float32)
    power = np.float32(max(1 - SENSITIVITY_SHRINK * sensitivity.view_uncertainty, 0.0))
    sizes = size_weights(splats, SIZE_POWER * sensitivity.view_uncertainty)[chosen]
    weights = sensitivity.color_weight[chosen] ** power * sizes
    seen = weights[weights > 0].astype(np.float64)
    return np.clip(weights / (np.median(seen) if len(seen) else 1.0), *SH_WEIGHTS).astype(np.float32)


# Error of the SH codebook by its number of entries, and its optimal size.

SH_SHRINK = 0.42  # error ~ entries^-this, measured on real scenes with 1,000 to 10,000 entries
ENTRY_BITS = 112  # bits per entry in the codebook's image, measured at 45 dimensions
LABEL_SHARE = 0.5  # bits per label for each bit of the codebook's size: frequent entries take fewer
FEW = 64  # number of codebook entries that any scene may have: they take about 1 kB, and SOG-XT has no fewer
SAMPLE, SAMPLE_ENTRIES = 1 << 15, 1024  # Gaussians and entries from which the codebook's error is estimated
MAX_DISPLAYED_ERROR = 3.0  # largest squared error of a displayed colour, summed over RGB from 0 to 1

# Factor on errors under a metric, of Gaussians that a capture has seen. The metric leaves out what base colours
# compensate; with the factor, the codebook's size was best for held-out photographs.
METRIC_GROWTH = 1.5
SH_MEAN_SQUARE = 0.0796  # mean square of a spherical harmonic over all directions, 1 / (4 pi)


@dataclass(frozen=True, slots=True)
class CodebookErrorModel:
    """Error of a scene's shN by codebook size, extrapolated from a small codebook."""

    entries: int = 1
    weighted: float = 0.0  # its squared image error, weighted by sensitivity
    unweighted: float = 0.0  # squared image error of a codebook of that size with equal weights

    def error(self, entries: float) -> float:
        """Return the squared image error of a codebook with that number of entries."""
        return self.weighted * (self.entries / entries) ** SH_SHRINK

    def best_size(self, rd_lambda: float, count: int, entry_bits: float = ENTRY_BITS) -> int:
        """Return the optimal number of entries, of ``entry_bits`` each, for ``count`` Gaussians. Where no error is
        known, :data:`FEW` entries are right: k-means makes no more than the scene needs."""
        if self.weighted == 0:
            return FEW
        low, high = 0.0, np.log(max(count, FEW))
        for _ in range(50):
            middle = 0.5 * (low + high)
            size = np.exp(middle)
            worth = SH_SHRINK * self.error(size) > rd_lambda * (entry_bits * size + LABEL_SHARE * count / np.log(2))
            low, high = (middle, high) if worth else (low, middle)
        return round(float(np.exp(low)))


def codebook_error_model(
    splats: Splats, kept: Int[np.ndarray, " M"], sensitivity: Sensitivity, settings: EncodeSettings, pool: Workers
) -> CodebookErrorModel:
    """Estimate the codebook's error from a small codebook for a sample of the Gaussians."""
    if splats.sh_degree == 0 or len(kept) < FEW:
        return CodebookErrorModel()
    rng = np.random.Generator(np.random.PCG64(settings.seed))
    some = np.sort(rng.choice(kept, min(SAMPLE, len(kept)), replace=False))
    vectors = splats.shN.reshape(len(splats), -1)
    entries = min(SAMPLE_ENTRIES, len(some) // 16)
    metric = ShMetric.of(sensitivity, splats.sh_degree)
    weights = sensitivity_weights(sensitivity, some, splats)
    clusters = kmeans.fit(vectors, some, weights, entries, settings, pool, lattice=0.0, metric=metric)
    lost, most = vectors[some] - clusters.centroids[clusters.labels], MAX_DISPLAYED_ERROR / SH_MEAN_SQUARE
    squared = np.minimum(np.square(lost, dtype=np.float64).sum(axis=1), most)
    seen = squared
    if metric is not None:
        growth = 1 + (METRIC_GROWTH - 1) * sensitivity.captured[some]
        seen = np.minimum(growth * metric.errors(lost, some), most)
    colors = sensitivity.color_weight[kept].astype(np.float64).sum() * SH_MEAN_SQUARE
    share = sensitivity.color_weight[some].astype(np.float64)
    weighted = float(seen @ share / max(share.sum(), 1e-300) * colors)
    return CodebookErrorModel(entries, weighted, float(squared.mean() * colors))
