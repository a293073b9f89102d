"""Order along the Hilbert curve, refined by the local search of the travelling-salesman problem (2-opt and Or-opt).

WebP codes the differences of a pixel from the one on its left, which then take fewer bits for what resembles that of
neighbours: high bytes of positions and base colours.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from itertools import pairwise

import numpy as np

from kissgs.core.array_types import Int32, Integer, UInt8, UInt16
from kissgs.core.progress import Progress
from kissgs.core.resources import Workers
from kissgs.planning.encoding_plan import EncodingPlan
from kissgs.planning.layout import hilbert_order
from kissgs.planning.rows import sorted_order

BLOCK, SMALLEST = 1 << 13, 64
"""Largest and smallest number of Gaussians that are reordered together: reversals in larger blocks take longer, and
smaller ones have too few differences to count."""

ROUNDS, PASSES = 2, 2
"""Number of times that bits are counted and near Gaussians found, each time in blocks that begin elsewhere, and the
largest number of passes of the local search in each."""

NEAR, REACH = 8, 16
"""Number of Gaussians that each one may be joined to, and places on the curves among which they are found."""

CURVES = ((0, 1, 2, 0), (1, 2, 0, 21845), (2, 0, 1, 43690))
"""Axes and shift of the Hilbert curves on which near Gaussians are found: where one has a gap, another has none."""

SMOOTHING = ((-2, 1 / 9), (-1, 2 / 9), (0, 3 / 9), (1, 2 / 9), (2, 1 / 9))
"""Shifts and weights of the average of the counts of similar differences."""

UNIT = 256
"""Fractions of a bit that the local search counts in, so that no rounding of a machine changes the order."""


def refine_order(
    plan: EncodingPlan, groups: UInt16[np.ndarray, " N"] | None, pool: Workers, progress: Progress
) -> EncodingPlan:
    """Reorder a plan along the Hilbert curve within each class, and within each of ``groups``; reports "reorder".

    Padding, at the end, repeats the last Gaussian, which stays.
    """
    count = len(plan.classes)
    if count == 0:
        return plan
    runs = plan.classes if groups is None else groups[plan.grid.cells[:count]].astype(np.int32) * 256 + plan.classes
    progress("reorder", 0.0)
    means, colors = (plan.fields[name].levels[:count] for name in ("means", "f_dc"))
    order = refined_order(means, colors, runs, pool, lambda fraction: progress("reorder", fraction))
    cells = np.concatenate([order, np.arange(count, len(plan.grid.cells), dtype=np.int32)])
    fields = {name: field.take(cells) for name, field in plan.fields.items() if name != "f_rest_centroids"}
    return replace(
        plan,
        grid=replace(plan.grid, cells=plan.grid.cells[cells]),
        fields={name: fields.get(name, field) for name, field in plan.fields.items()},
        codebook=replace(plan.codebook, labels=plan.codebook.labels[order]),
        classes=plan.classes[order],
        costs=None if plan.costs is None else plan.costs.take(order),
    )


def refined_order(
    means: UInt16[np.ndarray, "M 3"],
    colors: UInt8[np.ndarray, "M 3"],
    runs: Integer[np.ndarray, " M"],
    pool: Workers,
    report: Callable[[float], None] = lambda fraction: None,
) -> Int32[np.ndarray, " M"]:
    """Return the index of the Gaussian for every place.

    Gaussians at the same position keep their order, because renderers blend them in it. The first and the last Gaussian
    of a run stay.
    """
    pixels, order = _pixels(means, colors), np.arange(len(means), dtype=np.int32)
    ends = np.concatenate([np.flatnonzero(np.diff(runs)) + 1, [len(runs)]]).tolist()

    def refine(places: slice) -> None:
        chosen = order[places]
        order[places] = chosen[_block_order(means[chosen], pixels[chosen])]

    for done in range(ROUNDS):
        blocks = _blocks(ends, BLOCK if done % 2 == 0 else BLOCK // 2)
        pool.map(refine, blocks, partial(_report_round, report, done))
    return _with_equal_positions_in_order(order, means)


def _report_round(report: Callable[[float], None], done: int, fraction: float) -> None:
    """Report a fraction of a round, after so many rounds."""
    report((done + fraction) / ROUNDS)


def _pixels(means: UInt16[np.ndarray, "M 3"], colors: UInt8[np.ndarray, "M 3"]) -> UInt8[np.ndarray, "M 6"]:
    """Return what WebP predicts from the left: high bytes of positions; green, and red and blue without it."""
    red, green, blue = colors.T
    return np.ascontiguousarray(np.column_stack([(means >> 8).astype(np.uint8), green, red - green, blue - green]))


def _blocks(ends: list[int], first_size: int) -> list[slice]:
    """Return blocks of runs with these ends: in each run, one of at most ``first_size`` places, then larger ones.

    What is left of a run may be too small to count differences in, and is no block.
    """
    blocks = []
    for start, end in pairwise([0, *ends]):
        edges = [start, *range(start + first_size, end, BLOCK), end]
        blocks += [slice(a, b) for a, b in pairwise(edges) if b - a >= SMALLEST]
    return blocks


def _block_order(means: UInt16[np.ndarray, "B 3"], pixels: UInt8[np.ndarray, "B 6"]) -> Int32[np.ndarray, " B"]:
    """Return the refined order of some Gaussians, of which the first and the last stay."""
    from kissgs.planning import tour_kernels

    order = np.arange(len(means), dtype=np.int32)
    bits = _difference_bits(pixels)
    curves = np.stack([hilbert_order(means[:, axes] + np.uint16(shift)) for *axes, shift in CURVES])
    near = np.empty((len(means), NEAR), np.int32)
    tour_kernels.near_pixels(pixels, bits, curves, REACH, near)
    tour_kernels.improve(pixels, bits, near, PASSES, order)
    return order


def _difference_bits(pixels: UInt8[np.ndarray, "B C"]) -> Int32[np.ndarray, "C 256"]:
    """Return the bits of each difference of a channel from the pixel before, modulo 256, by how often it occurs.

    The counts of differences that are alike are averaged. A difference and its negative take the same bits.
    """
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
