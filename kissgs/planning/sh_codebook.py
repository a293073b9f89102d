"""The SH codebook: its entries and their order in the codebook's image."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import numpy as np

from kissgs.core.array_types import Float32, Int
from kissgs.core.limits import MAX_CODEBOOK_SIDE
from kissgs.core.progress import Progress
from kissgs.core.sensitivity import Sensitivity
from kissgs.core.splats import SH_REST_COUNTS, Splats
from kissgs.core.threads import Workers
from kissgs.planning import kmeans
from kissgs.planning.axes_order import axes_order, principal_axes
from kissgs.planning.container_model import ContainerModel
from kissgs.planning.plas import plas
from kissgs.planning.quantize import Quantized, half_steps, quantize
from kissgs.planning.sh_metric import ShMetric
from kissgs.planning.value_table import fit_table, nearest_levels, table_field
from kissgs.settings import EncodeSettings

COEFFICIENTS = SH_REST_COUNTS[-1]
MIN_SIDE = 8
"""Smallest side of a codebook in SOG-XT."""

WEIGHT_FLOOR, WEIGHT_CEILING = 0.1, 20.0
"""Bounds of weights, in units of the median, so that no Gaussian is ignored and none dominates."""

SENSITIVITY_SHRINK, SIZE_POWER = 0.55, 0.64
"""Exponents of the codebook's weights: colour sensitivity to the power of 1 - SENSITIVITY_SHRINK · view uncertainty,
times (opacity × cross-section) to the power of SIZE_POWER · view uncertainty (:func:`size_weights`)."""

SH_WEIGHTS = (1e-2, 1e2)
"""Bounds of the codebook's weights, in units of their median."""

SORTED_AXES, SORTED_RADIUS = 16, 16
"""Number of principal axes, and first filter radius, with which PLAS refines an order along the axes."""

PAPER_TOP = 99
"""Largest level of the paper's codebook: 100 levels in every channel."""


@dataclass(frozen=True, slots=True)
class Codebook:
    """Codebook of S × S entries, and the entry of each Gaussian.

    Attributes:
        side: S.
        centroids: ``(S*S, 45)`` levels, channel-major (15 of red, 15 of green, 15 of blue), entries row-major; at most
            S × S rows where the container's entries are a list.
        labels: ``(M,)`` entry of each Gaussian; a scene without Gaussians has one label, for padding.
        errors: ``(45,)`` largest error of the entries by rounding, per channel.
    """

    side: int
    centroids: Quantized
    labels: Int[np.ndarray, " M"]
    errors: list[float]


def fit_codebook(
    splats: Splats,
    chosen: Int[np.ndarray, " M"],
    weights: Float32[np.ndarray, " M"],
    size: float,
    settings: EncodeSettings,
    container: ContainerModel,
    pool: Workers,
    progress: Progress,
    *,
    metric: ShMetric | None = None,
) -> Codebook:
    """Build the codebook for the Gaussians ``chosen``.

    Bands that are missing, or zero in all Gaussians, take almost no bytes: their tiles are constant.

    Args:
        splats: the scene.
        chosen: indices of the Gaussians.
        weights: weight of each Gaussian's squared shN error.
        size: largest number of entries. In SOG-XT the image's side is a multiple of 8 and unused entries repeat
            others; in SOG any number will do.
        settings: settings of the encoder.
        container: what the container can hold.
        pool: threads.
        progress: receives "codebook" and "sort codebook" events.
        metric: forms of the errors; by default every coefficient counts alike.
    """
    dimensions = splats.shN.shape[1] * 3
    if dimensions == 0 or len(chosen) == 0:
        nothing = quantize(np.zeros((MIN_SIDE**2, 3 * COEFFICIENTS)), step=1)
        return Codebook(MIN_SIDE, nothing, np.zeros(max(len(chosen), 1), dtype=np.int32), half_steps(nothing))
    progress("codebook", 0.0)
    most = min(size, settings.sh_codebook_size)
    clusters = kmeans.fit(
        splats.shN.reshape(len(splats), dimensions),
        chosen,
        weights,
        codebook_side(most) ** 2 if container.tables is None else max(round(most), 1),
        pool,
        kmeans.KMeansOptions(
            seed=settings.seed,
            iterations=settings.sh_kmeans_iterations,
            neighbors=settings.sh_neighbors,
            tolerance=settings.sh_tolerance,
            lattice=settings.sh_step if settings.shared_step_size else 0.0,
            from_zero=container.tables is not None,
        ),
        metric=metric,
        report=lambda fraction: progress("codebook", fraction),
    )
    # The smallest square that holds the entries; unused places repeat some of them.
    side = next(s for s in range(MIN_SIDE, MAX_CODEBOOK_SIDE + 1, 8) if s * s >= len(clusters.centroids))
    progress("sort codebook", 0.0)
    if container.tables is not None:  # in a list, similar neighbours save less than small labels of frequent entries
        entries = clusters.centroids
        placed = np.argsort(-np.bincount(clusters.labels), kind="stable")
    else:
        entries = clusters.centroids[np.arange(side * side) % len(clusters.centroids)]
        placed = _sort(entries, settings, pool, lambda fraction: progress("sort codebook", fraction))
    position = np.empty(len(placed), dtype=np.int32)
    position[placed] = np.arange(len(placed), dtype=np.int32)
    full = np.zeros((len(placed), 3, COEFFICIENTS), dtype=np.float32)
    full[:, :, : dimensions // 3] = entries[placed].reshape(len(placed), -1, 3).transpose(0, 2, 1)
    rows = full.reshape(len(placed), 3 * COEFFICIENTS)
    if container.tables is not None:
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
    entries: Float32[np.ndarray, "cells D"],
    settings: EncodeSettings,
    pool: Workers,
    report: Callable[[float], None],
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
