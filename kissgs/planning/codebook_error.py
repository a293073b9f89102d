"""Error of the SH codebook by its number of entries, and its optimal size."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from kissgs.core.array_types import Int
from kissgs.core.sensitivity import Sensitivity
from kissgs.core.splats import Splats
from kissgs.core.threads import Workers
from kissgs.planning import kmeans
from kissgs.planning.sh_codebook import sensitivity_weights
from kissgs.planning.sh_metric import ShMetric
from kissgs.settings import EncodeSettings

SH_SHRINK = 0.42
"""Exponent s of the codebook's error ~ entries^-s, measured on real scenes with 1,000 to 10,000 entries."""

ENTRY_BITS = 112
"""Bits per entry in the codebook's image, measured at 45 dimensions."""

LABEL_SHARE = 0.5
"""Bits per label for each bit of the codebook's size: less than 1, because frequent entries take fewer bits."""

QUICK = 1 << 13
"""Number of codebook entries that k-means finds in a few seconds."""

FEW = 64
"""Number of codebook entries that any scene may have: they take about 1 kB, and SOG-XT has no fewer."""

SAMPLE, SAMPLE_ENTRIES = 1 << 15, 1024
"""Number of Gaussians and of codebook entries from which the codebook's error is estimated."""

MAX_DISPLAYED_ERROR = 3.0
"""Largest squared error of a displayed colour, summed over RGB from 0 to 1."""

METRIC_GROWTH = 1.5
"""Factor on errors under a metric, of Gaussians that a capture has seen. The metric leaves out what base colours
compensate; with the factor, the codebook's size was best for held-out photographs."""

SH_MEAN_SQUARE = 0.0796
"""Mean square of a spherical harmonic over all directions, 1 / (4 pi)."""


@dataclass(frozen=True, slots=True)
class CodebookErrorModel:
    """Error of a scene's shN by codebook size, extrapolated from a small codebook.

    Attributes:
        entries: number of entries of that codebook.
        weighted: its squared image error, weighted by sensitivity.
        unweighted: squared image error of a codebook of that size with equal weights.
    """

    entries: int = 1
    weighted: float = 0.0
    unweighted: float = 0.0

    def error(self, entries: float) -> float:
        """Return the squared image error of a codebook with that number of entries."""
        return self.weighted * (self.entries / entries) ** SH_SHRINK

    def best_size(self, rd_lambda: float, count: int, ratio: float, entry_bits: float = ENTRY_BITS) -> int:
        """Return the optimal number of entries, of ``entry_bits`` each, for ``count`` Gaussians.

        Beyond :data:`QUICK` entries, which would take long to find, there are at least ``ratio`` Gaussians per entry.
        Where no error is known, :data:`FEW` entries are right: k-means makes no more than the scene needs.
        """
        if self.weighted == 0:
            return FEW
        low, high = 0.0, np.log(max(count / ratio, min(count / 2, QUICK), FEW))
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
    clusters = kmeans.fit(
        vectors,
        some,
        sensitivity_weights(sensitivity, some, splats),
        entries,
        pool,
        kmeans.KMeansOptions(
            seed=settings.seed,
            iterations=settings.sh_kmeans_iterations,
            neighbors=settings.sh_neighbors,
            tolerance=settings.sh_tolerance,
            lattice=0.0,
        ),
        metric=metric,
    )
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
