"""Numba kernels of nearest neighbours: exact, by a tree of boxes over the leaves of a k-d tree."""

from __future__ import annotations

import numpy as np
from numba import njit

from kissgs.core.numba_kernels import compiled


@compiled("void(float64[:, ::1], int32[::1], int64[::1], int64, float64[:, :, ::1])")
def fill_boxes(means: np.ndarray, order: np.ndarray, edges: np.ndarray, leaves: int, boxes: np.ndarray) -> None:
    """Compute the bounding boxes of a binary tree over the leaves.

    Args:
        means: ``(N, 3)`` positions.
        order, edges: as :func:`kissgs.rendering.cpu.neighbours.split_into_leaves` made them.
        leaves: number of leaves.
        boxes: out, ``(2 * S, 2, 3)``, S the power of two at or above ``leaves``: lowest and highest coordinates of node
            n, whose children are 2 n and 2 n + 1; node S + i is leaf i. Nodes without points have inverted boxes.
    """
    side = boxes.shape[0] // 2
    boxes[:, 0] = np.inf
    boxes[:, 1] = -np.inf
    for leaf in range(leaves):
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
def nearest(
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
    """Find the nearest neighbours of the points in leaves ``first`` to ``last`` (exclusive).

    Args:
        means: ``(N, 3)`` positions.
        order, edges, boxes: tree, see :func:`fill_boxes`.
        first: first leaf.
        last: end of the leaves, exclusive.
        rank: which neighbour's distance is kept, from 0.
        found: out, ``(N, K)`` indices of the K nearest other points, nearest first; of equally near ones, any. There
            must be more than K points.
        distances: out, ``(N,)`` squared distance to the neighbour of that rank.
    """
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
    """List each pair of neighbours once, the lower index first; return their number.

    Args:
        found: ``(N, K)`` neighbours, see :func:`nearest`.
        pairs: out, ``(N * K, 2)``.
    """
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
