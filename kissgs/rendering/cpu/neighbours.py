"""A k-d tree of points: its leaves, distances within each, and exact nearest neighbours."""

from __future__ import annotations

import numpy as np
from numba import njit

from kissgs.core.array_types import Float64, Int32, Int64, Shaped
from kissgs.core.context import Workers
from kissgs.core.numba_kernels import compiled
from kissgs.rendering.cpu.tiles import each_part, even

SEARCH_LEAF = 16  # largest number of points in a leaf in which nearest neighbours are searched


@njit(nogil=True, error_model="numpy")
def _before(values: np.ndarray, a: int, b: int) -> bool:
    """Return whether point ``a`` is before ``b``: by value, and by number if values are equal."""
    return values[a] < values[b] or (values[a] == values[b] and a < b)


@njit(nogil=True, error_model="numpy")
def _partition(values: np.ndarray, order: np.ndarray, first: int, last: int, middle: int) -> None:
    """Permute ``order[first:last]`` so that the points before position ``middle`` are those of the smallest values.
    Hoare's selection; the set of points before ``middle`` does not depend on their order on entry."""
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
def _split(columns: np.ndarray, leaf: int, order: np.ndarray, edges: np.ndarray) -> int:
    """Split points ``(3, N)`` into leaves, see :func:`leaves_of`; return their number. ``edges`` are long enough."""
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
    """Return the bits of the float at this rank, to 11 bits of the mantissa, by bisection of counts. Bits of positive
    floats sort as the floats do; ``low`` are those of the smallest, ``high`` at or above the result."""
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


@njit(nogil=True, error_model="numpy")
def _squared_scale(squared: np.ndarray, rank: int) -> float:
    """Return the square of the local scale, given squared distances and the rank at which it usually lies."""
    bits, value = squared.view(np.int32), np.empty(1, np.int32)
    low, high = bits[0], bits[0]
    for j in range(bits.shape[0]):
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
        return 0.0
    return smallest if smallest < 0.2 * 0.2 * usual else usual


@compiled("void(float32[:, ::1], int32[::1], int64[::1], int64, int64, float32[::1])")
def leaf_scales(
    means: np.ndarray, order: np.ndarray, edges: np.ndarray, first: int, last: int, scales: np.ndarray
) -> None:
    """Compute the local scales of the points in leaves ``first`` to ``last`` (exclusive). The scale is the distance
    within which one in four of every fourth point of the leaf lies. If the nearest half, quarter or eighth of these is
    nearer than a fifth of what a surface of uniform density would have, the object has no more points, and their
    distance is used."""
    for leaf in range(first, last):
        members = np.sort(order[edges[leaf] : edges[leaf + 1]])
        count = members.shape[0]
        points = np.empty((3, count), np.float64)
        for i in range(count):
            for c in range(3):
                points[c, i] = means[members[i], c]
        some = np.ascontiguousarray(points[:, ::4])
        number = some.shape[1]
        squared, rank = np.empty(number, np.float32), min(number // 4, number - 1)
        for i in range(count):
            x, y, z = points[0, i], points[1, i], points[2, i]
            for j in range(number):
                dx, dy, dz = x - some[0, j], y - some[1, j], z - some[2, j]
                squared[j] = dx * dx + dy * dy + dz * dz
            scales[members[i]] = np.sqrt(_squared_scale(squared, rank))


@compiled("void(float64[:, ::1], int32[::1], int64[::1], float64[:, :, ::1])")
def _fill_boxes(means: np.ndarray, order: np.ndarray, edges: np.ndarray, boxes: np.ndarray) -> None:
    """Compute the bounding boxes ``(2 * S, 2, 3)`` of a binary tree over the leaves, S being a power of two. They are
    the lowest and highest coordinates of node n, whose children are 2 n and 2 n + 1; node S + i is leaf i. Nodes
    without points have inverted boxes."""
    side = boxes.shape[0] // 2
    boxes[:, 0] = np.inf
    boxes[:, 1] = -np.inf
    for leaf in range(edges.shape[0] - 1):
        box = boxes[side + leaf]
        for at in range(edges[leaf], edges[leaf + 1]):
            for c in range(3):
                value = means[order[at], c]
                box[0, c], box[1, c] = min(box[0, c], value), max(box[1, c], value)
    for node in range(side - 1, 0, -1):
        for c in range(3):
            boxes[node, 0, c] = min(boxes[2 * node, 0, c], boxes[2 * node + 1, 0, c])
            boxes[node, 1, c] = max(boxes[2 * node, 1, c], boxes[2 * node + 1, 1, c])


@njit(nogil=True, error_model="numpy")
def _distance_to_box(box: np.ndarray, x: float, y: float, z: float) -> float:
    """Return the squared distance from a point to a box; infinity for an inverted one."""
    dx = max(box[0, 0] - x, x - box[1, 0], 0.0)
    dy = max(box[0, 1] - y, y - box[1, 1], 0.0)
    dz = max(box[0, 2] - z, z - box[1, 2], 0.0)
    return dx * dx + dy * dy + dz * dz


@njit(nogil=True, error_model="numpy")
def _insert(squared: np.ndarray, found: np.ndarray, value: float, index: int) -> None:
    """Insert a neighbour into a list sorted by distance, of which the last one is dropped."""
    at = found.shape[0] - 1
    if value >= squared[at]:
        return
    while at > 0 and value < squared[at - 1]:
        squared[at], found[at] = squared[at - 1], found[at - 1]
        at -= 1
    squared[at], found[at] = value, index


@compiled(
    "void(float64[:, ::1], int32[::1], int64[::1], float64[:, :, ::1], int64, int64, int64, int32[:, ::1], "
    "float64[::1])"
)
def _nearest(
    means: np.ndarray,
    order: np.ndarray,
    edges: np.ndarray,
    boxes: np.ndarray,
    first: int,
    last: int,
    rank: int,
    found: np.ndarray,
    distances: np.ndarray,
) -> None:
    """Find the K nearest of the points in leaves ``first`` to ``last`` (exclusive), see :func:`nearest_neighbours`."""
    side, near = boxes.shape[0] // 2, found.shape[1]
    squared, waiting, away = np.empty(near), np.empty(64, np.int64), np.empty(64)
    for home in range(first, last):
        for at_home in range(edges[home], edges[home + 1]):
            point = order[at_home]
            x, y, z = means[point, 0], means[point, 1], means[point, 2]
            mine = found[point]
            squared[:] = np.inf
            mine[:] = 2147483647
            # The own leaf comes first: of many points at one place, each then has neighbours of its own.
            waiting[0], away[0], waiting[1], away[1], depth = 1, 0.0, side + home, -1.0, 2
            while depth > 0:
                depth -= 1
                node = waiting[depth]
                if away[depth] >= squared[near - 1] or (node == side + home and away[depth] >= 0):
                    continue
                if node >= side:
                    for at in range(edges[node - side], edges[node - side + 1]):
                        other = order[at]
                        if other != point:
                            dx, dy, dz = x - means[other, 0], y - means[other, 1], z - means[other, 2]
                            _insert(squared, mine, dx * dx + dy * dy + dz * dz, other)
                    continue
                a = _distance_to_box(boxes[2 * node], x, y, z)
                b = _distance_to_box(boxes[2 * node + 1], x, y, z)
                closer, farther = (2 * node, 2 * node + 1) if a <= b else (2 * node + 1, 2 * node)
                for child, distance in ((farther, max(a, b)), (closer, min(a, b))):
                    if distance < squared[near - 1]:
                        waiting[depth], away[depth] = child, distance
                        depth += 1
            distances[point] = squared[rank]


@compiled("int64(int32[:, ::1], int32[:, ::1])")
def unique_pairs(found: np.ndarray, pairs: np.ndarray) -> int:
    """List each pair of neighbours ``(N, K)`` once, the lower index first, in ``(N * K, 2)``; return their number."""
    count = 0
    for i in range(found.shape[0]):
        for j in found[i]:
            both = False
            for k in found[j]:
                both |= k == i
            if i < j or not both:
                pairs[count, 0], pairs[count, 1] = min(i, j), max(i, j)
                count += 1
    return count


def leaves_of(points: Shaped[np.ndarray, "N 3"], leaf: int) -> tuple[Int32[np.ndarray, " N"], Int64[np.ndarray, " e"]]:
    """Split points into the leaves of a k-d tree of equal counts: at the median of a part's longest side. Returned are
    the numbers of the points, leaf after leaf, and the edges of the leaves of at most ``leaf`` points in it."""
    order, edges = np.arange(len(points), dtype=np.int32), np.empty(4 * len(points) // leaf + 2, np.int64)
    found = _split(np.array(points.T, np.float32, order="C"), leaf, order, edges)
    return order, edges[: found + 1]


def nearest_neighbours(
    points: Float64[np.ndarray, "N 3"], count: int, rank: int, pool: Workers
) -> tuple[Int32[np.ndarray, "N K"], Float64[np.ndarray, " N"]]:
    """Return the ``count`` nearest other points of each, nearest first, and the squared distance to that of ``rank``.
    Of equally near ones, any; there must be more than ``count`` points, and ranks are from 0."""
    order, edges = leaves_of(points, SEARCH_LEAF)
    leaves = len(edges) - 1
    boxes = np.empty((2 << (leaves - 1).bit_length(), 2, 3))
    _fill_boxes(points, order, edges, boxes)
    found, squared = np.empty((len(points), count), np.int32), np.empty(len(points))
    each_part(
        lambda first, last: _nearest(points, order, edges, boxes, first, last, rank, found, squared),
        even(leaves, pool),
        pool,
    )
    return found, squared
