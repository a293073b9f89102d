"""Numba kernels of local scale: leaves of a k-d tree, and distances within each."""

from __future__ import annotations

import numpy as np
from numba import njit

from kissgs.core.numba_kernels import compiled


@njit(nogil=True, error_model="numpy")
def _before(values: np.ndarray, a: int, b: int) -> bool:
    """Return whether point ``a`` is before ``b``: by value, and by number if values are equal."""
    return values[a] < values[b] or (values[a] == values[b] and a < b)


@njit(nogil=True, error_model="numpy")
def _partition(values: np.ndarray, order: np.ndarray, first: int, last: int, middle: int) -> None:
    """Permute ``order[first:last]`` so that the points before position ``middle`` are those of the smallest values.

    Hoare's selection; the set of points before ``middle`` does not depend on their order on entry.
    """
    low, high = first, last - 1
    while low < high:
        centre = (low + high) // 2
        if _before(values, order[centre], order[low]):
            order[low], order[centre] = order[centre], order[low]
        if _before(values, order[high], order[low]):
            order[low], order[high] = order[high], order[low]
        if _before(values, order[high], order[centre]):
            order[centre], order[high] = order[high], order[centre]
        pivot, i, j = order[centre], low, high
        while i <= j:
            while _before(values, order[i], pivot):
                i += 1
            while _before(values, pivot, order[j]):
                j -= 1
            if i <= j:
                order[i], order[j] = order[j], order[i]
                i += 1
                j -= 1
        if middle <= j:
            high = j
        elif middle >= i:
            low = i
        else:
            return


@compiled("int64(float32[:, ::1], int64, int32[::1], int64[::1])")
def split_into_leaves(columns: np.ndarray, leaf: int, order: np.ndarray, edges: np.ndarray) -> int:
    """Split points into the leaves of a k-d tree of equal counts: at the median of a part's longest side.

    Args:
        columns: ``(3, N)`` positions.
        leaf: largest number of points in a leaf.
        order: ``(N,)`` numbers of the points; permuted so that a leaf's points follow each other.
        edges: out, first position of each leaf, and the number of points; long enough.

    Returns:
        The number of leaves.
    """
    firsts, lasts = np.empty(64, np.int64), np.empty(64, np.int64)
    firsts[0], lasts[0] = 0, order.shape[0]
    depth, found = 1, 0
    edges[0] = 0
    while depth > 0:
        depth -= 1
        first, last = firsts[depth], lasts[depth]
        if last - first <= leaf:
            found += 1
            edges[found] = last
            continue
        axis, longest = 0, np.float64(-1.0)
        for c in range(3):
            values = columns[c]
            low = high = values[order[first]]
            for i in range(first, last):
                low, high = min(low, values[order[i]]), max(high, values[order[i]])
            side = np.float64(high) - np.float64(low)
            if side > longest:
                axis, longest = c, side
        middle = first + (last - first) // 2
        _partition(columns[axis], order, first, last, middle)
        firsts[depth], lasts[depth] = middle, last  # the lower half is next, so that leaves come in order
        firsts[depth + 1], lasts[depth + 1] = first, middle
        depth += 2
    return found


@njit(nogil=True, error_model="numpy")
def _at_rank(bits: np.ndarray, rank: int, low: int, high: int) -> int:
    """Return the bits of the float at this rank, 0 or more, to 11 bits of the mantissa, by bisection of counts.

    Args:
        bits: bits of positive floats, which sort as the floats do.
        rank: rank of the float that is sought.
        low: bits of the smallest.
        high: bits at or above the one that is sought.
    """
    while high - low > 4096:
        middle = low + (high - low) // 2
        bound, count = np.int32(middle), np.int32(0)
        for j in range(bits.shape[0]):
            count += np.int32(bits[j] <= bound)
        if count > rank:
            high = middle
        else:
            low = middle + 1
    return high


@compiled("void(float32[:, ::1], int32[::1], int64[::1], int64, int64, int64, int64, float64, float32[::1])")
def leaf_scales(
    columns: np.ndarray,
    order: np.ndarray,
    edges: np.ndarray,
    first: int,
    last: int,
    stride: int,
    neighbours: int,
    gap: float,
    scales: np.ndarray,
) -> None:
    """Compute the local scales of the points in leaves ``first`` to ``last`` (exclusive).

    Args:
        columns: ``(3, N)`` positions.
        order, edges: as :func:`split_into_leaves` made them.
        first: first leaf.
        last: end of the leaves, exclusive.
        stride: distances are measured to every ``stride``-th point of the leaf.
        neighbours: the scale is the distance within which one in ``neighbours`` of these points lie.
        gap: if the nearest half, quarter or eighth of them is nearer than this share of what a surface of uniform
            density would have, their distance is used.
        scales: out, ``(N,)``.
    """
    for leaf in range(first, last):
        members = np.sort(order[edges[leaf] : edges[leaf + 1]])
        count = members.shape[0]
        points = np.empty((3, count), np.float64)
        for i in range(count):
            for c in range(3):
                points[c, i] = columns[c, members[i]]
        some = np.ascontiguousarray(points[:, ::stride])
        number = some.shape[1]
        squared, rank = np.empty(number, np.float32), min(number // neighbours, number - 1)
        bits, value = squared.view(np.int32), np.empty(1, np.int32)
        for i in range(count):
            x, y, z = points[0, i], points[1, i], points[2, i]
            for j in range(number):
                dx, dy, dz = x - some[0, j], y - some[1, j], z - some[2, j]
                squared[j] = dx * dx + dy * dy + dz * dz
            low, high = bits[0], bits[0]
            for j in range(number):
                low, high = min(low, bits[j]), max(high, bits[j])
            at = _at_rank(bits, rank, low, high)
            value[0] = at
            usual = np.float64(value.view(np.float32)[0])
            smallest, few = usual, rank // 2
            for _ in range(3):
                if few > 1:
                    at = _at_rank(bits, few, low, at)
                    value[0] = at
                    smallest = min(smallest, np.float64(value.view(np.float32)[0]) * (rank / few))
                few //= 2
            if rank == 0:
                smallest = usual = np.float64(0.0)
            scales[members[i]] = np.sqrt(smallest if smallest < gap * gap * usual else usual)
