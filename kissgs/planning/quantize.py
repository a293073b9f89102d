"""Levels and the values that they stand for; uniform quantisers, and the ranges that decoders need to invert them."""

from __future__ import annotations

from dataclasses import dataclass, replace
from math import ceil

import numpy as np

from kissgs.core.array_types import Bool, Float, Float32, Float64, Int, Integer, UInt8, UInt16
from kissgs.core.resources import Workers
from kissgs.core.signed_log import signed_log
from kissgs.core.splats import Splats
from kissgs.planning.rows import Rows, for_each_block, row_range, selected

MEANS_TOP = 65_535
"""Top level of positions. It must occur, because some readers of meta.json divide by it, not by the observed one."""


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
    """Round to uniform steps of at most ``step``, unless ``max_top`` steps do not span the widest channel.

    One step for all channels has the least error for a given entropy. If it is not shared, every channel spreads
    ``max_top`` levels over its own range.
    """
    low, high = _range(values, pool)
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
    """Clip outliers that 256 levels of ``step`` cannot span, so that they do not make the step coarse for all.

    Values that the levels span are returned unchanged. Else each channel keeps the span of all but the outermost
    ``share`` of its values at either end, or the span of the levels if that is larger; values beyond are clipped to it.
    """
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
    """Quantise positions to 16-bit levels of their signed logarithm, with one range for all three axes.

    Below 16 ``bits``, of all or of each, levels are multiples of a power of two, so that low bytes compress; the
    outermost level stays 65535.
    """
    if len(means) == 0:
        return Quantized(np.empty((0, 3), np.uint16), np.zeros((MEANS_TOP + 1, 3)), *_strides(bits))
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
    return Quantized(levels, even_table(low, high, MEANS_TOP), *_strides(bits))


def _strides(bits: int | Int[np.ndarray, " N"]) -> tuple[int | Int[np.ndarray, " N"]]:
    """Return the distance of levels of 16 bits of which only ``bits`` are used."""
    return (1 << (16 - bits),) if isinstance(bits, int) else (np.left_shift(1, 16 - bits.astype(np.int16)),)


def means_bits(
    splats: Splats, kept: Int[np.ndarray, " M"], tolerance: float, pool: Workers | None = None, *, most: int = 16
) -> int:
    """Return the position bits, 8 to ``most``, with which the median Gaussian moves at most ``tolerance`` of its size.

    The step of a signed logarithm grows as 1 + |x|; size is the geometric mean of the two longest axes. More than 16
    bits of the range of all axes are for containers with a range of each axis, which may be smaller.
    """
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
    """Return the range to write: values of the smallest and the largest level that occur, over all channels.

    A SOG-XT decoder does not know the number of levels: it maps the smallest level of an image to one end and the
    largest to the other (docs/reference/format.md). An image of a single level decodes to the first everywhere.
    """
    if quantized.levels.size == 0:
        return quantized.low, quantized.low
    first, last = int(quantized.levels.min()), int(quantized.levels.max())
    return quantized.table[first].astype(np.float32), quantized.table[last].astype(np.float32)


def half_steps(quantized: Quantized, stride: int = 1) -> list[float]:
    """Return half the distance of levels that are multiples of ``stride``, per channel."""
    extent = quantized.table[-1] - quantized.table[0]
    return [float(step) for step in extent / quantized.top * stride / 2]


def _range(
    values: Float[np.ndarray, "N C"] | Rows, pool: Workers | None
) -> tuple[Float32[np.ndarray, " C"], Float32[np.ndarray, " C"]]:
    """Return each channel's minimum and maximum as the float32 numbers that are written (zeros without rows)."""
    if len(values) == 0:
        zeros = np.zeros(values[:0].shape[1], dtype=np.float32)
        return zeros, zeros
    low, high = row_range(values, pool)
    # + 0.0 turns -0.0 into 0.0, so that equal scenes give equal bytes.
    return low.astype(np.float32) + np.float32(0), high.astype(np.float32) + np.float32(0)


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
