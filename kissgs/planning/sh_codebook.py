"""The SH codebook: its entries, their order in the codebook's image, its optimal size, and errors by directions."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cache, partial

import numpy as np

from kissgs.core.array_types import Float32, Float64, Int, Int32
from kissgs.core.context import Workers
from kissgs.core.sensitivity import Sensitivity
from kissgs.core.splats import MAX_CODEBOOK_SIDE, SH_REST_COUNTS, Splats, blocks
from kissgs.planning import kmeans
from kissgs.planning.kmeans import BLOCK, Clustering
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


# ``ShMetric``: errors of view-dependent colour, measured in the directions from which cameras see each Gaussian.

# Weight of all directions alike, beside those from which cameras see a Gaussian; both add up to 1. It grows with the
# view uncertainty, since that shrinks the measured means, and is 1 for Gaussians that no capture has seen.
UNIFORM_WEIGHT = 0.3
NEIGHBORS = 32  # number of codebook entries, the nearest to a Gaussian's present one, that are compared
SPHERE = 4 * np.pi  # area of the unit sphere: a form is the identity where all directions count alike


@dataclass(frozen=True, slots=True, eq=False)
class ShMetric:
    """Quadratic forms of the errors of shN, one per Gaussian, after base colours have compensated the mean error. The
    colour error in direction d is that of shN times the harmonics at d. Its mean square over the directions from which
    a Gaussian is seen, less the square of its mean, which the base colour takes up, is a form of the covariance of the
    harmonics. Products of harmonics are sums of harmonics of up to twice the degree, so the means of these give all
    covariances. What the base colour's change costs in all other directions is left out: counting it made images worse,
    those of the capture and those from elsewhere."""

    sensitivity: Sensitivity  # with the means of harmonics to twice the scene's degree
    degree: int

    @classmethod
    def of(cls, sensitivity: Sensitivity, degree: int) -> ShMetric | None:
        """Return the metric of a sensitivity that knows directions of view; None for others."""
        return cls(sensitivity, degree) if sensitivity.higher_harmonics.shape[1] > 0 else None

    def quadratic_forms(self, rows: Int[np.ndarray, " n"]) -> Float32[np.ndarray, "n K K"]:
        """Return the forms of some Gaussians: positive definite, the identity where all directions count alike."""
        means, higher = (
            values.take(rows, axis=0) for values in (self.sensitivity.mean_harmonics, self.sensitivity.higher_harmonics)
        )
        number = means.shape[1]
        known = np.float32(SPHERE * (1 - UNIFORM_WEIGHT)) * self.sensitivity.captured.take(rows)[:, None, None]
        form = (np.concatenate([means, higher], axis=1) @ _products(self.degree)).reshape(-1, number, number)
        form -= means[:, :, None] * means[:, None, :]
        form *= known
        diagonal = np.arange(number)
        form[:, diagonal, diagonal] += 1
        return form

    def errors(self, vectors: Float32[np.ndarray, "n D"], rows: Int[np.ndarray, " n"]) -> Float64[np.ndarray, " n"]:
        """Return the squared errors of shN under the forms of these Gaussians; ``vectors`` are the differences."""
        found = np.empty(len(vectors))
        for block in blocks(len(vectors), BLOCK):
            some = vectors[block].reshape(-1, self.coefficients, 3)
            found[block] = np.einsum("nkc,nkc->n", some, self.quadratic_forms(rows[block]) @ some, dtype=np.float64)
        return found

    @property
    def coefficients(self) -> int:
        """Number of coefficients of shN per colour channel."""
        return (self.degree + 1) ** 2 - 1

    def move_centroids(self, state: Clustering, pool: Workers) -> None:
        """Move every centroid to where its vectors' error is smallest; one without vectors stays."""
        data, number = state.data, self.coefficients

        def work(part: tuple[int, int]) -> None:
            first, last = part
            counts = np.diff(state.edges[first : last + 1])
            left, right = np.zeros((last - first, number, number)), np.zeros((last - first, number, 3))
            for members, _ in _blocks(state, part):
                vectors = data.take(members).reshape(-1, number, 3)
                forms = self.quadratic_forms(data.rows[members]) * data.weights[members, None, None]
                clusters, starts = np.unique(state.labels[members] - first, return_index=True)
                left[clusters] += np.add.reduceat(forms, starts, axis=0, dtype=np.float64)
                right[clusters] += np.add.reduceat(forms @ vectors, starts, axis=0, dtype=np.float64)
            several, single = np.flatnonzero(counts > 1), np.flatnonzero(counts == 1)
            moved = np.linalg.solve(left[several], right[several])
            state.centroids[first + several] = moved.reshape(-1, 3 * number)
            state.centroids[first + single] = data.take(state.members[state.edges[first + single]])

        pool.map(work, state.parts())

    def reassign(self, state: Clustering, pool: Workers) -> None:
        """Assign every vector to the one of the centroids near its present one at which its error is smallest."""
        from kissgs.planning import kmeans_kernels as kernels

        data, number = state.data, self.coefficients
        near = np.ascontiguousarray(state.near[:, :NEIGHBORS])
        upper = np.triu_indices(number)

        def work(part: tuple[int, int]) -> None:
            for members, edges in _blocks(state, part):
                forms = self.quadratic_forms(data.rows[members])
                products = forms @ data.take(members).reshape(-1, number, 3)
                rows = np.concatenate([forms[:, *upper], products.reshape(len(members), -1)], axis=1)
                kernels.assign_by_form(rows, members, edges, state.centroids, near, part[0], state.labels)

        pool.map(work, state.parts())
        state.sort_members()


def _blocks(
    state: Clustering, part: tuple[int, int]
) -> Iterator[tuple[Int32[np.ndarray, " n"], Int[np.ndarray, " edges"]]]:
    """Yield the vectors of a range of clusters in blocks, sorted by cluster, and where each cluster's begin in a block.
    A form takes a kilobyte, and a single cluster may have most of the vectors."""
    edges = state.edges[part[0] : part[1] + 1]
    for first in range(int(edges[0]), int(edges[-1]), BLOCK):
        last = min(first + BLOCK, int(edges[-1]))
        yield state.members[first:last], np.clip(edges, first, last) - first


@cache
def _products(degree: int) -> Float32[np.ndarray, "J P"]:
    """Return the products of all pairs of harmonics to ``degree`` as sums of the harmonics to twice the degree. Column
    a · K + b has the coefficients of the product of harmonics a + 1 and b + 1, without the constant one: that is 1 /
    SPHERE for a = b, and 0 else."""
    from kissgs.core.harmonics_kernel import write_harmonics_of

    number, count = (degree + 1) ** 2 - 1, (2 * degree + 1) ** 2 - 1
    points = 4 * count
    height = 1 - (2 * np.arange(points) + 1) / points
    turn, radius = np.pi * (3 - 5**0.5) * np.arange(points), np.sqrt(1 - height**2)
    values = np.empty((points, count))
    directions = np.stack([radius * np.cos(turn), radius * np.sin(turn), height], axis=1)
    write_harmonics_of(directions, 2 * degree, values)
    pairs = (values[:, :number, None] * values[:, None, :number]).reshape(points, -1)
    with_constant = np.concatenate([np.ones((points, 1)), values], axis=1)
    return np.linalg.lstsq(with_constant, pairs, rcond=None)[0][1:].astype(np.float32)
