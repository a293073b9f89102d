"""Order of the Gaussians in the grid: row-major along a 3D Hilbert curve, or sorted by PLAS or by principal axes."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise
from math import isqrt

import numpy as np

from kissgs.core.array_types import Bool, Float32, Int, Int32, Integer, UInt8, UInt16
from kissgs.core.context import Workers
from kissgs.core.errors import UnsupportedError
from kissgs.core.splats import MAX_GRID_SIDE
from kissgs.planning.quantize import for_each_block, quantize_means, selected, sorted_order
from kissgs.settings import EncodeSettings

# PLAS: arrange vectors on a square grid so that neighbours are similar.
#
# Parallel Linear Assignment Sorting (Morgenstern et al., "Compact 3D Scene Representation via Self-Organizing Gaussian
# Grids", ECCV 2024). The grid is low-pass filtered; random groups of four items inside blocks are permuted to be as
# close as possible to the filtered grid; this repeats with ever smaller filter radii.
#
# Differences from the public implementation: the cheapest of the 24 permutations is applied as such (not inverted);
# each block stops once it has converged; the filter is a box, which approximates the wide, truncated Gaussian used
# there.

MIN_BLOCK = 8
MIN_CONFIGURATIONS = 4
CHANNELS_PER_TASK = 4
CONVERGED = 1e-4  # share of its squared distance by which a pass must reduce a block's, or be its last


def plas(
    items: Float32[np.ndarray, "cells C"],
    pool: Workers,
    *,
    seed: int,
    decay: float,
    start_radius: int | None = None,
    report: Callable[[float], None] = lambda fraction: None,
) -> Int32[np.ndarray, " cells"]:
    """Arrange ``S*S`` vectors on an S × S grid."""
    side = round(len(items) ** 0.5)
    placed = np.arange(len(items), dtype=np.int32)
    rng = np.random.Generator(np.random.PCG64(seed))
    start = start_radius or side // 2 - 1
    radii, smaller = [max(start, 1)], float(start)
    while (smaller := smaller * decay) >= 1:
        radii.append(int(smaller))
    for step, radius in enumerate(radii):
        report(step / len(radii))
        width = min(side - 1, 2 * radius + 1)
        target = box_blur(items[placed].reshape(side, side, -1), width // 2, pool).reshape(len(items), -1)
        size = max(min(width + 1, side) // 2 * 2, MIN_BLOCK)
        for configuration in range(1, 3 * MIN_CONFIGURATIONS + 1):
            gained = _improve(items, placed, target, side, size, rng, pool)
            if configuration >= MIN_CONFIGURATIONS and gained <= 0:
                break
    return placed


def _improve(
    items: np.ndarray,
    placed: np.ndarray,
    target: np.ndarray,
    side: int,
    size: int,
    rng: np.random.Generator,
    pool: Workers,
) -> float:
    """Sort every block of one randomly shifted tiling to convergence; modify ``placed``, return the improvement."""
    from kissgs.planning import kernels

    down, right = rng.integers(0, size, 2)
    seed = np.uint64(rng.integers(0, 2**63))
    blocks = (side // size) ** 2
    edges = np.linspace(0, blocks, min(blocks, 4 * pool.threads) + 1).astype(np.int64)

    def work(task: int) -> float:
        tiling = np.array([side, down, right, size, edges[task], edges[task + 1]], dtype=np.int64)
        return float(kernels.plas_blocks(items, placed, target, tiling, seed, CONVERGED))

    return sum(pool.map(work, range(len(edges) - 1)))


def box_blur(image: Float32[np.ndarray, "H W C"], radius: int, pool: Workers) -> Float32[np.ndarray, "H W C"]:
    """Average squares of ``2*radius + 1`` cells, wrapping around horizontally and mirrored vertically."""
    from kissgs.planning import kernels

    height, width, channels = image.shape
    wrapped = np.arange(-radius, width + radius + 1) % width
    period = max(2 * (height - 1), 1)
    mirrored = np.abs(np.arange(-radius, height + radius + 1)) % period
    mirrored = np.minimum(mirrored, period - mirrored)

    def work(first: int) -> np.ndarray:
        part = image[:, :, first : first + CHANNELS_PER_TASK]
        for places in (wrapped, mirrored):
            part = np.ascontiguousarray(part.transpose(1, 0, 2))
            blurred = np.empty_like(part)
            kernels.box_blur(part, places, blurred)
            part = blurred
        return part

    return np.concatenate(pool.map(work, range(0, channels, CHANNELS_PER_TASK)), axis=2)


# Arrange vectors on a square grid by their principal axes, so that neighbours are similar.
#
# The first axis decides the band of rows, the second the block of columns in it, and inside a block the third the row
# and the fourth the column. Four sorts take milliseconds where PLAS, which moves vectors until neighbours are as
# similar as possible, takes seconds.

BLOCK = 8  # side of a block, cells; sides of codebooks are multiples of it


def principal_axes(vectors: Float32[np.ndarray, "N D"], number: int) -> Float32[np.ndarray, "N axes"]:
    """Return the coordinates of the vectors along the ``number`` axes, or all, of their largest variances."""
    centred = vectors - vectors.mean(axis=0, dtype=np.float64)
    axes = np.linalg.eigh(centred.T @ centred)[1][:, ::-1][:, :number]
    return (centred @ axes).astype(np.float32)


def axes_order(coordinates: Float32[np.ndarray, "cells axes"]) -> Int[np.ndarray, " cells"]:
    """Arrange ``S*S`` vectors on an S × S grid."""
    cells = len(coordinates)
    side = round(cells**0.5)
    order = np.arange(cells)[None]
    for axis, group in enumerate((cells, BLOCK * side, BLOCK * BLOCK, BLOCK)):
        order = order.reshape(-1, group)
        if axis < coordinates.shape[1]:
            ranks = np.argsort(coordinates[order, axis], axis=1, kind="stable")
            order = np.take_along_axis(order, ranks, axis=1)
    blocks = order.reshape(side // BLOCK, side // BLOCK, BLOCK, BLOCK)
    return blocks.transpose(0, 2, 1, 3).reshape(-1)


# Order of the Gaussians in the grid: row-major along a 3D Hilbert curve, or sorted by PLAS.
#
# WebP predicts a pixel from its left and upper neighbours and repeats earlier runs; with a one-dimensional curve
# through space, planes are smaller than with any two-dimensional arrangement that was measured. The grid is described
# in docs/reference/format.md.

PLAS_HIGH, PLAS_LOW = 1.0, 0.2  # weights of high and low position bytes, as in the paper's public encoder
CURVE_BITS = 48  # bits of a position along the Hilbert curve


@dataclass(frozen=True, slots=True)
class Grid:
    """Cells of the grid and their Gaussians, row-major."""

    side: int  # G, cells per axis
    cells: Int[np.ndarray, " cells"]  # index in the scene of each cell's Gaussian; padding repeats a Gaussian
    mask: Bool[np.ndarray, " cells"]  # true for cells with a Gaussian, false for padding
    cell_to_gaussian: Int[np.ndarray, " cells"]  # for each cell, the rank of its Gaussian among the cells with ``mask``

    def with_padding_last(self) -> Grid:
        """Move the last Gaussians into the padding before them, so that all padding is at the end."""
        count = int(self.mask.sum())
        holes = np.flatnonzero(~self.mask[:count])
        if len(holes) == 0:
            return self
        cells, index = self.cells.copy(), np.arange(len(self.cells), dtype=np.int32)
        cells[holes] = cells[count + np.flatnonzero(self.mask[count:])]
        cells[count:] = cells[count - 1]
        return Grid(self.side, cells, index < count, np.minimum(index, count - 1))


def layout_grid(
    means: Float32[np.ndarray, "N 3"],
    kept: Int[np.ndarray, " M"],
    bits: int,
    settings: EncodeSettings,
    pool: Workers,
    report: Callable[[float], None],
    classes: Integer[np.ndarray, " M"] | None = None,
    groups: UInt16[np.ndarray, " N"] | None = None,
) -> Grid:
    """Assign a cell to every Gaussian of ``kept``. With ``classes`` and the Hilbert order, the Gaussians of class 0
    come first, then those of class 1 and so on, each class along its own curve. With ``groups``, all this is done for
    group 0, then for group 1 and so on."""
    side = grid_side(len(kept))
    if len(kept) == 0:
        nothing = np.zeros(side * side, dtype=np.int32)
        return Grid(side, nothing, nothing.astype(bool), nothing)
    levels = quantize_means(selected(means, kept), bits=bits, pool=pool).levels
    if settings.order != "plas":
        if groups is not None:  # which follow one another, and the classes within each
            own = groups[kept]
            classes = own if classes is None else own * np.uint16(classes.max(initial=0) + 1) + classes
        order = hilbert_order(levels, classes, pool)
        order = np.concatenate([order, np.repeat(order[-1:], side * side - len(order))])
        mask = np.arange(side * side) < len(kept)
    else:
        order, mask = _plas_order(levels, side, settings, pool, report)
    del levels
    rank = np.empty(len(kept), dtype=np.int32)
    rank[order[mask]] = np.arange(len(kept), dtype=np.int32)
    return Grid(side, kept.astype(np.int32, copy=False).take(order), mask, rank[order])


def _plas_order(
    levels: UInt16[np.ndarray, "M 3"],
    side: int,
    settings: EncodeSettings,
    pool: Workers,
    report: Callable[[float], None],
) -> tuple[Int[np.ndarray, " cells"], Bool[np.ndarray, " cells"]]:
    """Return order and mask of the cells sorted by PLAS on both position bytes; all padding is the first Gaussian."""
    count = len(levels)
    rng = np.random.Generator(np.random.PCG64(settings.seed))
    index = np.concatenate([np.arange(count), np.zeros(side * side - count)]).astype(np.int32)
    radius = settings.plas_start_radius
    start = rng.permutation(side * side) if radius is None else hilbert_order(levels[index])
    index = index[start]
    high, low = (_standardized(part) for part in (levels[index] >> 8, levels[index] & 255))
    items = np.concatenate([PLAS_HIGH * high, PLAS_LOW * low], axis=1).astype(np.float32)
    placed = plas(items, pool, seed=settings.seed, decay=settings.plas_radius_decay, start_radius=radius, report=report)
    return index[placed], start[placed] < count


def _standardized(values: np.ndarray) -> np.ndarray:
    """Scale to zero mean and unit deviation over all channels together."""
    deviation = values.std()
    return (values - values.mean()) / (deviation if deviation > 0 else 1)


def grid_side(count: int) -> int:
    """Return the side of the square grid for ``count`` Gaussians: the smallest multiple of 8 that fits, at least 8."""
    side = isqrt(max(count, 1) - 1) + 1
    side = -(-side // 8) * 8
    if side > MAX_GRID_SIDE:
        raise UnsupportedError(
            f"{count} Gaussians do not fit into one container; at most {MAX_GRID_SIDE**2} do: split the scene"
        )
    return side


def hilbert_order(
    levels: UInt16[np.ndarray, "N 3"], classes: Integer[np.ndarray, " N"] | None = None, pool: Workers | None = None
) -> Int32[np.ndarray, " N"]:
    """Return the order in which a 3D Hilbert curve visits the positions, the smallest class first."""
    from kissgs.planning import kernels

    count = len(levels)
    keys = np.empty(count, np.uint64)

    def work(rows: slice) -> None:
        kernels.hilbert_keys(np.ascontiguousarray(levels[rows]), keys[rows])
        if classes is not None:
            keys[rows] |= classes[rows].astype(np.uint64) << np.uint64(CURVE_BITS)

    for_each_block(count, work, pool)
    return sorted_order(keys, CURVE_BITS if classes is None else 64)


# Order along the Hilbert curve, refined by the local search of the travelling-salesman problem (2-opt and Or-opt).
#
# WebP codes the differences of a pixel from the one on its left, which then take fewer bits for what resembles that of
# neighbours: high bytes of positions and base colours.

REORDERED, SMALLEST = 1 << 13, 64  # Gaussians reordered together; fewer have too few differences to count
ROUNDS, PASSES = 2, 2  # rounds of counting bits, in blocks that begin elsewhere, and most passes in each
NEAR, REACH = 8, 16  # Gaussians that each may be joined to, and places on the curves where they are found
CURVES = ((0, 1, 2, 0), (1, 2, 0, 21845), (2, 0, 1, 43690))  # axes and shift: where one has a gap, another has none
SMOOTHING = ((-2, 1 / 9), (-1, 2 / 9), (0, 3 / 9), (1, 2 / 9), (2, 1 / 9))  # average of counts: shifts, weights
UNIT = 256  # fractions of a bit that the local search counts in, so that no rounding of a machine changes the order


def refined_order(
    means: UInt16[np.ndarray, "M 3"],
    colors: UInt8[np.ndarray, "M 3"],
    runs: Integer[np.ndarray, " M"],
    pool: Workers,
    report: Callable[[float], None] = lambda fraction: None,
) -> Int32[np.ndarray, " M"]:
    """Return the index of the Gaussian for every place. Gaussians at the same position keep their order, because
    renderers blend them in it. The first and the last Gaussian of a run stay."""
    pixels, order = _pixels(means, colors), np.arange(len(means), dtype=np.int32)
    ends = np.concatenate([np.flatnonzero(np.diff(runs)) + 1, [len(runs)]]).tolist()

    def refine(places: slice) -> None:
        chosen = order[places]
        order[places] = chosen[_block_order(means[chosen], pixels[chosen])]

    for done in range(ROUNDS):

        def report_done(fraction: float, done: int = done) -> None:
            report((done + fraction) / ROUNDS)

        pool.map(refine, _blocks(ends, REORDERED if done % 2 == 0 else REORDERED // 2), report_done)
    return _with_equal_positions_in_order(order, means)


def _pixels(means: UInt16[np.ndarray, "M 3"], colors: UInt8[np.ndarray, "M 3"]) -> UInt8[np.ndarray, "M 6"]:
    """Return what WebP predicts from the left: high bytes of positions; green, and red and blue without it."""
    red, green, blue = colors.T
    return np.ascontiguousarray(np.column_stack([(means >> 8).astype(np.uint8), green, red - green, blue - green]))


def _blocks(ends: list[int], first_size: int) -> list[slice]:
    """Return blocks of runs with these ends: in each run, one of at most ``first_size`` places, then larger ones. What
    is left of a run may be too small to count differences in, and is no block."""
    blocks = []
    for start, end in pairwise([0, *ends]):
        edges = [start, *range(start + first_size, end, REORDERED), end]
        blocks += [slice(a, b) for a, b in pairwise(edges) if b - a >= SMALLEST]
    return blocks


def _block_order(means: UInt16[np.ndarray, "B 3"], pixels: UInt8[np.ndarray, "B 6"]) -> Int32[np.ndarray, " B"]:
    """Return the refined order of some Gaussians, of which the first and the last stay."""
    from kissgs.planning import kernels

    order = np.arange(len(means), dtype=np.int32)
    bits = _difference_bits(pixels)
    curves = np.stack([hilbert_order(means[:, axes] + np.uint16(shift)) for *axes, shift in CURVES])
    near = np.empty((len(means), NEAR), np.int32)
    kernels.near_pixels(pixels, bits, curves, REACH, near)
    kernels.improve(pixels, bits, near, PASSES, order)
    return order


def _difference_bits(pixels: UInt8[np.ndarray, "B C"]) -> Int32[np.ndarray, "C 256"]:
    """Return the bits of each difference of a channel from the pixel before, modulo 256, by how often it occurs. The
    counts of differences that are alike are averaged. A difference and its negative take the same bits."""
    counts = np.stack([np.bincount(channel, minlength=256) for channel in np.diff(pixels, axis=0).T]).astype(np.float64)
    counts += counts[:, -np.arange(256)]
    counts = (counts + sum(weight * np.roll(counts, shift, axis=1) for shift, weight in SMOOTHING)) / 2 + 1
    return np.rint(UNIT * np.log2(counts.sum(axis=1, keepdims=True) / counts)).astype(np.int32)


def _with_equal_positions_in_order(
    order: Int32[np.ndarray, " M"], means: UInt16[np.ndarray, "M 3"]
) -> Int32[np.ndarray, " M"]:
    """Return an order in which Gaussians of equal position have ascending indices."""
    x, y, z = means[order].T
    keys = x | y.astype(np.uint64) << np.uint64(16) | z.astype(np.uint64) << np.uint64(32)
    places = sorted_order(keys, 48)
    group = np.cumsum(np.diff(keys, prepend=keys[:1]) > 0)
    shared = np.bincount(group, minlength=1)[group] > 1
    places, group = places[shared], group[shared]
    order = order.copy()
    order[places] = order[places][np.lexsort((order[places], group))]
    return order
