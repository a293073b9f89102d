"""Quantisation: the values that a container can hold, levels, tables of values, and blocks of rows."""

from __future__ import annotations

import heapq
from collections.abc import Callable
from dataclasses import dataclass, replace
from math import ceil
from typing import Protocol, TypeVar, runtime_checkable

import numpy as np

from kissgs.core.array_types import Bool, Float, Float32, Float64, Int, Int32, Integer, Shaped, UInt8, UInt16, UInt64
from kissgs.core.context import Progress, Workers
from kissgs.core.positions import signed_log
from kissgs.core.splats import BLOCK, Splats, blocks
from kissgs.settings import EncodeSettings

# ``ContainerModel``: the values that a container can hold; ``Planning``: inputs that all steps of planning share.


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ByteTables:
    """Eight-bit levels that stand for the values of tables, as SOG has them. Scales, base colours and SH coefficients
    have one free table of 256 values each, for all their channels. Rotations are three of the quaternion's components,
    255 steps from -1/sqrt(2) to 1/sqrt(2), and which one is left out. Positions have 65,536 levels over a range of
    their own per axis."""

    opacity_logits: Float64[np.ndarray, " 256"]  # opacity logit of each level, ascending
    first_drawn: int  # smallest level of opacity that renderers draw
    last_drawn: int  # largest level of opacity to use


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ContainerModel:
    """Description of the values that a container can hold."""

    tables: ByteTables | None = None  # None for even levels over a range per channel, and whole quaternions
    padding_last: bool = False  # whether cells without a Gaussian must follow all others
    entry_bits: float = 112  # typical size of an entry of the SH codebook, bits, at 45 dimensions


EVEN_LEVELS = ContainerModel()  # evenly spaced levels, and a mask that says which cells hold a Gaussian: the default


@dataclass(frozen=True, slots=True, eq=False)
class Planning:
    """Inputs that all steps of one planning share."""

    settings: EncodeSettings
    container: ContainerModel
    pool: Workers
    progress: Progress

    def report(self, stage: str) -> Callable[[float], None]:
        """Report that a stage begins, and return what reports the fraction of it that is done."""
        self.progress(stage, 0.0)
        return lambda fraction: self.progress(stage, fraction)


# Rows of attributes that are made block by block, so that no whole copy of a scene is needed.

R = TypeVar("R")


@runtime_checkable
class Rows(Protocol):
    """Array, or what gives the rows of one when asked: ``values[first:last]`` is ``(last - first, C)``."""

    def __len__(self) -> int: ...
    def __getitem__(self, rows: slice, /) -> np.ndarray: ...


@dataclass(frozen=True, slots=True, eq=False)
class Computed:
    """Rows that a function computes."""

    count: int
    of: Callable[[slice], np.ndarray]

    def __len__(self) -> int:
        return self.count

    def __getitem__(self, rows: slice) -> np.ndarray:
        return self.of(rows)


def selected(array: Shaped[np.ndarray, "N C"], index: Int[np.ndarray, " M"]) -> Computed:
    """Return the rows of ``array`` at ``index``, in that order."""
    return Computed(len(index), lambda rows: array.take(index[rows], axis=0))


def for_each_block(
    count: int, work: Callable[[slice], R], pool: Workers | None = None, *, block: int = BLOCK
) -> list[R]:
    """Call ``work`` for the slices that cover ``count`` rows; return its results in their order."""
    slices = blocks(count, block)
    return [work(rows) for rows in slices] if pool is None else pool.map(work, slices)


def row_range(values: Rows, pool: Workers | None = None) -> tuple[np.ndarray, np.ndarray]:
    """Return the smallest and the largest value of each column, of at least one row."""

    def ends(rows: slice) -> tuple[np.ndarray, np.ndarray]:
        columns = values[rows].T  # NumPy is slow at the ends of short rows
        return np.array([column.min() for column in columns]), np.array([column.max() for column in columns])

    found = for_each_block(len(values), ends, pool)
    return np.min([low for low, _ in found], axis=0), np.max([high for _, high in found], axis=0)


def sorted_order(keys: UInt64[np.ndarray, " N"], bits: int = 64) -> Int32[np.ndarray, " N"]:
    """Sort ``keys``, below 2^``bits``, in place; return the permutation that does, stably."""
    from kissgs.planning import kernels

    order, scratch = np.empty(len(keys), np.int32), np.empty(len(keys), np.int32)
    kernels.sort_keys(keys, order, np.empty_like(keys), scratch, 2 * -(-bits // 24))
    return order


# Levels and the values that they stand for; uniform quantisers, and the ranges that decoders need to invert them.

MEANS_TOP = 65_535  # top level of positions; it must occur, as some readers of meta.json divide by it


@dataclass(frozen=True, slots=True, eq=False)
class Quantized:
    """Levels of one field, and the table of the values that they stand for, ascending in every column."""

    levels: UInt8[np.ndarray, "N C"] | UInt16[np.ndarray, "N C"]
    table: Float64[np.ndarray, "values _"]  # a column for each channel, or one for all
    # With level_offset added, the levels of a row are multiples of its level_stride. Single levels may be exceptions.
    level_stride: int | Integer[np.ndarray, " N"] | Integer[np.ndarray, "N C"] = 1
    level_offset: int = 0

    @property
    def top(self) -> int:
        """Largest level, whether it occurs or not."""
        return len(self.table) - 1

    @property
    def low(self) -> Float32[np.ndarray, " C"]:
        """Value of level 0, per column of the table."""
        return self.table[0].astype(np.float32)

    @property
    def high(self) -> Float32[np.ndarray, " C"]:
        """Value of the largest level, per column of the table."""
        return self.table[-1].astype(np.float32)

    def values(self) -> Float64[np.ndarray, "N C"]:
        """Return the values that the levels stand for."""
        shared = self.table.shape[1] == 1
        return np.asarray(self.table[self.levels, 0 if shared else np.arange(self.levels.shape[1])])

    def take(self, rows: Int[np.ndarray, " M"] | Bool[np.ndarray, " N"] | slice) -> Quantized:
        """Return the rows ``rows``, in that order; those of a slice are not copied."""
        spacing = self.level_stride if isinstance(self.level_stride, int) else self.level_stride[rows]
        return replace(self, levels=self.levels[rows], level_stride=spacing)

    def from_zero(self) -> Quantized:
        """Return the same values with the levels that do not occur left out at both ends; ends are float32 numbers."""
        first = int(self.levels.min(initial=self.top))
        last = min(max(int(self.levels.max(initial=0)), first + 1), self.top)
        table = even_table(self.table[first].astype(np.float32), self.table[last].astype(np.float32), last - first)
        return Quantized((self.levels - first).astype(np.uint8), table, self.level_stride, self.level_offset + first)


def even_table(
    low: Float[np.ndarray, " C"], high: Float[np.ndarray, " C"], top: int
) -> Float64[np.ndarray, "values C"]:
    """Return evenly spaced values from ``low`` to ``high``, per channel."""
    low, high = low.astype(np.float64), high.astype(np.float64)
    table = low + np.arange(top + 1)[:, None] * ((high - low) / max(top, 1))
    table[-1] = high  # exact, as decoders have it
    return np.asarray(table)


def quantize(
    values: Float[np.ndarray, "N C"] | Rows,
    *,
    step: float,
    shared: bool = True,
    max_top: int = 255,
    pool: Workers | None = None,
) -> Quantized:
    """Round to uniform steps of at most ``step``, unless ``max_top`` steps do not span the widest channel. One step for
    all channels has the least error for a given entropy. If it is not shared, every channel spreads ``max_top`` levels
    over its own range."""
    ends = row_range(values, pool) if len(values) else (np.zeros(values[:0].shape[1]),) * 2
    # The float32 numbers that are written; + 0.0 turns -0.0 into 0.0, so that equal scenes give equal bytes.
    low, high = (end.astype(np.float32) + np.float32(0) for end in ends)
    extent = high.astype(np.float64) - low
    widest = float(extent.max(initial=0.0))
    top = max_top
    if shared and widest > 0:
        top = int(min(max(ceil(widest / step - 1e-3), 1), max_top))  # exactly k steps need k levels
        high = np.where(extent > 0, (low + widest).astype(np.float32), low)
    levels = np.empty((len(values), len(low)), np.uint8)

    def work(rows: slice) -> None:
        levels[rows] = _levels(values[rows].astype(np.float64), low, high, top)

    for_each_block(len(values), work, pool)
    return Quantized(levels, even_table(low, high, top))


def clip_outliers(values: Float[np.ndarray, "N C"], *, step: float, share: float) -> Float[np.ndarray, "N C"]:
    """Clip outliers that 256 levels of ``step`` cannot span, so that they do not make the step coarse for all. Values
    that the levels span are returned unchanged. Else each channel keeps the span of all but the outermost ``share`` of
    its values at either end, or the span of the levels if that is larger; values beyond are clipped to it."""
    low, high = values.min(axis=0, initial=np.inf), values.max(axis=0, initial=-np.inf)
    if len(values) == 0 or float((high.astype(np.float64) - low).max(initial=0)) <= 255 * step:
        return values
    inner_low = np.quantile(values, share, axis=0, method="lower").astype(np.float64)
    inner_high = np.quantile(values, 1 - share, axis=0, method="higher").astype(np.float64)
    span = max(float((inner_high - inner_low).max()), 255 * step)
    middle = (inner_low + inner_high) / 2
    # The span's room beyond the inner values is used on the sides that need it.
    first = np.clip(low, middle - span / 2, None)
    last = np.clip(high, None, middle + span / 2)
    return np.clip(values, first.astype(values.dtype), last.astype(values.dtype))


def quantize_means(
    means: Float32[np.ndarray, "N 3"] | Rows, *, bits: int | Int[np.ndarray, " N"], pool: Workers | None = None
) -> Quantized:
    """Quantise positions to 16-bit levels of their signed logarithm, with one range for all three axes. Below 16
    ``bits``, of all or of each, levels are multiples of a power of two, so that low bytes compress; the outermost level
    stays 65535."""
    stride = 1 << (16 - bits) if isinstance(bits, int) else np.left_shift(1, 16 - bits.astype(np.int16))
    if len(means) == 0:
        return Quantized(np.empty((0, 3), np.uint16), np.zeros((MEANS_TOP + 1, 3)), stride)
    smallest, largest = (end(values) for end, values in zip((np.min, np.max), row_range(means, pool), strict=True))
    ends = signed_log(np.array([smallest, largest])).astype(np.float32) + np.float32(0)
    low, high = np.repeat(ends[:1], 3), np.repeat(ends[1:], 3)
    levels = np.empty((len(means), 3), np.uint16)

    def work(rows: slice) -> None:
        some = means[rows]
        spacing = np.exp2(16 - np.asarray(bits if isinstance(bits, int) else bits[rows], np.float64))
        found = _levels(signed_log(some), low, high, MEANS_TOP, spacing.reshape(-1, 1))
        if high[0] > low[0]:
            found[some == largest] = MEANS_TOP  # rounding of the level or of the range could miss it
        levels[rows] = found

    for_each_block(len(means), work, pool)
    return Quantized(levels, even_table(low, high, MEANS_TOP), stride)


def means_bits(
    splats: Splats, kept: Int[np.ndarray, " M"], tolerance: float, pool: Workers | None = None, *, most: int = 16
) -> int:
    """Return the position bits, 8 to ``most``, with which the median Gaussian moves at most ``tolerance`` of its size.
    The step of a signed logarithm grows as 1 + |x|; size is the geometric mean of the two longest axes. More than 16
    bits of the range of all axes are for containers with a range of each axis, which may be smaller."""
    if len(kept) == 0:
        return 16
    ratio = np.empty(len(kept))

    def work(rows: slice) -> None:
        some = kept[rows]
        x, y, z = np.abs(splats.means.take(some, axis=0)).T
        reach = 1 + np.maximum(np.maximum(x, y), z).astype(np.float64)
        a, b, c = splats.scales.take(some, axis=0).T
        largest, smaller = np.maximum(a, b), np.minimum(a, b)
        second = np.maximum(smaller, np.minimum(largest, c))
        ratio[rows] = (np.maximum(largest, c).astype(np.float64) + second) / 2 - np.log(reach)

    for_each_block(len(kept), work, pool)
    allowed = tolerance * np.exp(np.median(ratio, overwrite_input=True))
    levels = log_extent(selected(splats.means, kept), pool) / (2 * allowed)  # half a step is the largest error
    return int(np.clip(np.ceil(np.log2(max(levels, 1))), 8, most))


def log_extent(means: Float32[np.ndarray, "N 3"] | Rows, pool: Workers | None = None) -> float:
    """Return the difference of the largest and the smallest signed logarithm of a coordinate."""
    low, high = row_range(means, pool)
    return float(np.ptp(signed_log(np.array([low.min(), high.max()]))))


def observed_range(quantized: Quantized) -> tuple[Float32[np.ndarray, " C"], Float32[np.ndarray, " C"]]:
    """Return the range to write: values of the smallest and the largest level that occur, over all channels. A SOG-XT
    decoder does not know the number of levels: it maps the smallest level of an image to one end and the largest to the
    other (docs/reference/format.md). An image of a single level decodes to the first everywhere."""
    if quantized.levels.size == 0:
        return quantized.low, quantized.low
    first, last = int(quantized.levels.min()), int(quantized.levels.max())
    return quantized.table[first].astype(np.float32), quantized.table[last].astype(np.float32)


def half_steps(quantized: Quantized, stride: int = 1) -> list[float]:
    """Return half the distance of levels that are multiples of ``stride``, per channel."""
    extent = quantized.table[-1] - quantized.table[0]
    return [float(step) for step in extent / quantized.top * stride / 2]


def _levels(
    wide: Float64[np.ndarray, "N C"],
    low: Float32[np.ndarray, " C"],
    high: Float32[np.ndarray, " C"],
    top: int,
    spacing: float | Float64[np.ndarray, "M 1"] = 1,
) -> Float64[np.ndarray, "N C"]:
    """Return the nearest multiples of ``spacing`` in the rounded ranges, at most ``top``."""
    low64 = low.astype(np.float64)
    extent = high.astype(np.float64) - low64
    levels = wide - low64
    levels *= top / np.where(extent > 0, extent, np.inf)
    levels /= spacing
    np.rint(levels, out=levels)
    levels *= spacing
    return np.clip(levels, 0, top, out=levels)


# Tables of at most 256 values that all channels of an attribute share, and the nearest levels.

SIZE = 256  # largest number of values of a table
WIDEST = 120  # joined points span at most this fraction of the whole range: a bound of the error
DIGITS = 6  # significant digits of the values of a table, which its container stores as text
MAX_POINTS = 1 << 14  # lattice points before joining; beyond, the lattice is coarser


def fit_table(
    values: Float[np.ndarray, " V"], weights: Float64[np.ndarray, " V"], step: float, *, with_zero: bool = False
) -> Float32[np.ndarray, " levels"]:
    """Return ascending values of a table for at least one value: the occupied points of a lattice of this ``step``. So
    outliers cost no step of the others. If more than 256 points are occupied, the neighbours whose union adds the least
    weighted squared error are joined."""
    wide = np.asarray(values, np.float64)
    span = float(np.ptp(wide))
    step = max(step, span * 2.0**-40, 1e-30)
    while True:
        points, index = np.unique(np.rint(wide / step), return_inverse=True)
        if len(points) <= MAX_POINTS:
            break
        step *= 2
    centers = points * step
    if len(points) > SIZE - with_zero:
        mass = np.bincount(index, np.maximum(weights, weights.mean() * 1e-3 + 1e-300), minlength=len(points))
        centers = _join(centers, mass, SIZE - with_zero, (centers[-1] - centers[0]) / WIDEST)
    if with_zero and not (centers == 0).any():
        centers = np.append(centers, 0.0)
    return np.unique(centers.astype(np.float32) + np.float32(0))


def _join(
    centers: Float64[np.ndarray, " points"], mass: Float64[np.ndarray, " points"], size: int, widest: float
) -> Float64[np.ndarray, " levels"]:
    """Join neighbours, the cheapest first, until ``size`` groups remain; return the weighted mean of each."""
    count = len(centers)
    mean, total = centers.copy(), mass.copy()
    first, last = centers.copy(), centers.copy()
    before, after = np.arange(count) - 1, np.arange(count) + 1
    version = np.zeros(count, np.int64)
    queue: list[tuple[float, int, int, int]] = []

    def offer(a: int, b: int) -> None:
        if last[b] - first[a] <= widest:
            cost = total[a] * total[b] / (total[a] + total[b]) * (mean[b] - mean[a]) ** 2
            heapq.heappush(queue, (float(cost), a, int(version[a]), int(version[b])))

    for a in range(count - 1):
        offer(a, a + 1)
    alive = count
    while alive > size and queue:
        _, a, made_a, made_b = heapq.heappop(queue)
        b = int(after[a])
        if version[a] != made_a or b >= count or version[b] != made_b:
            continue
        mean[a] = (mean[a] * total[a] + mean[b] * total[b]) / (total[a] + total[b])
        total[a] += total[b]
        last[a], after[a] = last[b], after[b]
        version[a] += 1
        version[b] = -1
        alive -= 1
        if after[a] < count:
            before[after[a]] = a
            offer(a, int(after[a]))
        if before[a] >= 0:
            offer(int(before[a]), a)
    return mean[version >= 0]


def nearest_levels(table: Float[np.ndarray, " levels"], values: Float[np.ndarray, "N C"]) -> UInt8[np.ndarray, "N C"]:
    """Return the index of the nearest value of the ascending ``table``."""
    wide = table.astype(np.float64)
    return np.asarray(np.searchsorted((wide[1:] + wide[:-1]) / 2, values, side="right").astype(np.uint8))


def table_field(table: Float32[np.ndarray, " levels"], levels: UInt8[np.ndarray, "N C"]) -> Quantized:
    """Return levels that stand for the values of a table, which are rounded to the digits that are stored."""
    return Quantized(levels, short_values(table).astype(np.float64)[:, None])


def short_values(table: Float32[np.ndarray, " levels"]) -> Float32[np.ndarray, " levels"]:
    """Return the values with the digits that are stored."""
    return np.array([float(f"{value:.{DIGITS}g}") for value in table.tolist()], np.float32)


def refit_table(
    table: Float32[np.ndarray, " levels"],
    levels: Integer[np.ndarray, "N C"],
    values: Float64[np.ndarray, "N C"],
    weights: Float64[np.ndarray, " N"],
    largest: tuple[Float64[np.ndarray, " N"], Float64[np.ndarray, " N"]],
) -> Float32[np.ndarray, " levels"]:
    """Move each value of a table to the weighted mean of what it stands for, within the largest changes down and up."""
    size, rows = len(table), np.broadcast_to(weights[:, None], levels.shape).ravel()
    index, flat = levels.ravel(), values.ravel()
    mass = np.bincount(index, rows, minlength=size)
    mean = np.bincount(index, rows * flat, minlength=size) / np.where(mass > 0, mass, 1)
    floor, ceiling = np.full(size, -np.inf), np.full(size, np.inf)
    np.maximum.at(floor, index, (values - largest[0][:, None]).ravel())
    np.minimum.at(ceiling, index, (values + largest[1][:, None]).ravel())
    moved = np.where((mass > 0) & (floor <= ceiling), np.clip(mean, floor, np.maximum(floor, ceiling)), table)
    moved = moved.astype(np.float32)
    return moved if (np.diff(moved) > 0).all() else table


def without_unused(
    table: Float32[np.ndarray, " levels"], levels: Integer[np.ndarray, "N C"]
) -> tuple[Float32[np.ndarray, " used"], UInt8[np.ndarray, "N C"]]:
    """Return the table without the values that no level uses, and the levels in it."""
    used, index = np.unique(levels, return_inverse=True)
    return table[used], index.reshape(levels.shape).astype(np.uint8)
