"""Compiled inner loops of the k-means of the SH codebook: means, near centroids, assignment, merging and splitting."""

from __future__ import annotations

import numpy as np
from numba import njit

from kissgs.core.array_types import Bool, Float32, Float64, Int32, Int64, UInt16
from kissgs.core.numba_kernels import compiled

_FAST = {"contract", "nnan", "ninf", "nsz", "reassoc"}


@compiled("void(int32[::1], int64[::1], int32[::1])")
def sort_by_label(
    labels: Int32[np.ndarray, " N"], edges: Int64[np.ndarray, " K"], members: Int32[np.ndarray, " N"]
) -> None:
    """Write the numbers of the vectors, sorted by label, to ``members``; vectors of equal label keep their order.
    ``edges`` are the numbers of vectors of smaller labels; they are modified."""
    for n in range(labels.shape[0]):
        label = labels[n]
        members[edges[label]] = n
        edges[label] += 1


@compiled(
    "void(float32[:, ::1], int64[::1], float32[::1], float32[::1], int32[::1], int64[::1], int64, int64, "
    "float32[:, ::1], float64[::1], float64[::1])"
)
def means(
    table: Float32[np.ndarray, "R D"],
    rows: Int64[np.ndarray, " N"],  # row of each vector
    weights: Float32[np.ndarray, " N"],
    distances: Float32[np.ndarray, " N"],  # squared distances to the centroids before
    members: Int32[np.ndarray, " N"],  # vectors sorted by cluster
    edges: Int64[np.ndarray, " K+1"],  # where the members of each cluster begin
    first: int,
    last: int,  # exclusive
    centroids: Float32[np.ndarray, "K D"],  # modified
    totals: Float64[np.ndarray, " K"],  # receives the sums of the weights
    errors: Float64[np.ndarray, " K"],  # receives the weighted sums of the distances
) -> None:
    """Move the centroids ``first`` to ``last`` to the weighted means of their vectors; one without vectors stays."""
    dimensions = table.shape[1]
    total = np.empty(dimensions)
    for k in range(first, last):
        total[:] = 0.0
        weight = 0.0
        error = 0.0
        for i in range(edges[k], edges[k + 1]):
            n = members[i]
            row = rows[n]
            w = np.float64(weights[n])
            weight += w
            error += w * distances[n]
            for d in range(dimensions):
                total[d] += w * table[row, d]
        totals[k] = weight
        errors[k] = error
        if weight > 0:
            for d in range(dimensions):
                centroids[k, d] = total[d] / weight


@compiled("void(float32[:, ::1], uint16[:, ::1], int64, int64, int64, uint16[:, ::1])", fastmath=_FAST)
def find_near(
    centroids: Float32[np.ndarray, "K D"],
    near: UInt16[np.ndarray, "K k"],
    others: int,
    first: int,
    last: int,
    found: UInt16[np.ndarray, "K k"],
) -> None:
    """Find near centroids of the centroids ``first`` to ``last`` in the lists of them and of those near to them. A
    neighbour's neighbour is probably a neighbour (NN-descent: Dong, Moses and Li, WWW 2011). The lists of ``others``
    near ones are searched; ``found`` receives the centroid itself, then others by rising distance."""
    count = near.shape[1]
    seen = np.full(near.shape[0], -1, dtype=np.int32)
    best = np.empty(count, dtype=np.float32)
    for k in range(first, last):
        filled = 0
        for h in range(min(others + 1, count)):
            for j in range(count):
                c = near[near[k, h], j]
                if seen[c] == k:
                    continue
                seen[c] = k
                score = np.float32(0)
                for d in range(centroids.shape[1]):
                    step = centroids[k, d] - centroids[c, d]
                    score += step * step
                score = score if c != k else np.float32(-1)
                if filled == count and score >= best[count - 1]:
                    continue
                filled = min(filled + 1, count)
                at = filled - 1
                while at > 0 and best[at - 1] > score:
                    best[at] = best[at - 1]
                    found[k, at] = found[k, at - 1]
                    at -= 1
                best[at] = score
                found[k, at] = c


@njit(nogil=True, error_model="numpy", fastmath=_FAST, inline="always")
def _lowest(vector: np.ndarray, columns: np.ndarray, norms: np.ndarray, scores: np.ndarray) -> tuple[int, float]:
    """Return the first column of the smallest score, its scalar product with a vector plus its norm, and the score. The
    loops over columns are what the compiler turns into vector code."""
    dimensions, count = columns.shape
    thirds = dimensions - dimensions % 3
    for j in range(count):
        scores[j] = norms[j]
    for d in range(0, thirds, 3):  # three at a time: each score is loaded and stored less often
        x0, x1, x2 = vector[d], vector[d + 1], vector[d + 2]
        for j in range(count):
            scores[j] += x0 * columns[d, j] + x1 * columns[d + 1, j] + x2 * columns[d + 2, j]
    for d in range(thirds, dimensions):
        for j in range(count):
            scores[j] += vector[d] * columns[d, j]
    lowest = scores[0]
    for j in range(1, count):
        lowest = min(lowest, scores[j])
    best = 0
    while scores[best] > lowest:
        best += 1
    return best, lowest


@compiled(
    "void(float32[:, ::1], int64[::1], int32[::1], int64[::1], float32[:, ::1], uint16[:, ::1], int64, int64, "
    "int32[::1], float32[::1])",
    fastmath=_FAST,
)
def assign_near(
    table: Float32[np.ndarray, "R D"],
    rows: Int64[np.ndarray, " N"],  # row of each vector
    members: Int32[np.ndarray, " N"],  # vectors sorted by cluster
    edges: Int64[np.ndarray, " K+1"],  # where the members of each cluster begin
    centroids: Float32[np.ndarray, "K D"],
    near: UInt16[np.ndarray, "K k"],  # near centroids of each cluster; the first wins ties
    first: int,
    last: int,  # exclusive
    labels: Int32[np.ndarray, " N"],  # receives the centroids
    distances: Float32[np.ndarray, " N"],  # receives the squared distances
) -> None:
    """Assign the vectors of the clusters ``first`` to ``last`` to the nearest of their cluster's near centroids."""
    dimensions, count = table.shape[1], near.shape[1]
    columns = np.empty((dimensions, count), dtype=np.float32)  # the near centroids times -2
    norms = np.empty(count, dtype=np.float32)
    scores = np.empty(count, dtype=np.float32)
    for k in range(first, last):
        if edges[k] == edges[k + 1]:
            continue
        for j in range(count):
            norm = np.float32(0)
            for d in range(dimensions):
                x = centroids[near[k, j], d]
                norm += x * x
                columns[d, j] = np.float32(-2) * x
            norms[j] = norm
        for i in range(edges[k], edges[k + 1]):
            n = members[i]
            vector = table[rows[n]]
            best, lowest = _lowest(vector, columns, norms, scores)
            norm = np.float32(0)
            for d in range(dimensions):
                norm += vector[d] * vector[d]
            labels[n] = near[k, best]
            distances[n] = max(lowest + norm, np.float32(0))


@compiled(
    "void(float32[:, ::1], int32[::1], int64[::1], float32[:, ::1], uint16[:, ::1], int64, int32[::1])", fastmath=_FAST
)
def assign_by_form(
    vectors: Float32[np.ndarray, "n P+D"],  # upper triangle of the form of each, row by row, and the form times it
    members: Int32[np.ndarray, " n"],  # numbers of the vectors, sorted by cluster
    edges: Int64[np.ndarray, " C+1"],  # where the vectors of each cluster begin
    centroids: Float32[np.ndarray, "K D"],  # three values of each coefficient in a row
    near: UInt16[np.ndarray, "K k"],  # near centroids of each; the first wins ties
    first: int,
    labels: Int32[np.ndarray, " N"],  # receives the centroids
) -> None:
    """Assign vectors of some clusters to that of their cluster's near centroids at which their own form is smallest.
    The form of a difference x - c is that of c less twice the product of c with the form times x, and a constant."""
    dimensions, count = centroids.shape[1], near.shape[1]
    triangle = vectors.shape[1] - dimensions
    columns = np.empty((vectors.shape[1], count), dtype=np.float32)
    norms, scores = np.zeros(count, dtype=np.float32), np.empty(count, dtype=np.float32)
    for cluster in range(edges.shape[0] - 1):
        if edges[cluster] == edges[cluster + 1]:
            continue
        for j in range(count):
            c = near[first + cluster, j]
            at = 0
            for a in range(0, dimensions, 3):
                for b in range(a, dimensions, 3):
                    product = np.float32(0)
                    for channel in range(3):
                        product += centroids[c, a + channel] * centroids[c, b + channel]
                    columns[at, j] = product if a == b else np.float32(2) * product
                    at += 1
            for d in range(dimensions):
                columns[triangle + d, j] = np.float32(-2) * centroids[c, d]
        for i in range(edges[cluster], edges[cluster + 1]):
            labels[members[i]] = near[first + cluster, _lowest(vectors[i], columns, norms, scores)[0]]


@compiled("void(float32[:, ::1], float64[::1], uint16[:, ::1], int64, int64, int32[::1], float64[::1])")
def merge_costs(
    centroids: Float32[np.ndarray, "K D"],
    totals: Float64[np.ndarray, " K"],
    near: UInt16[np.ndarray, "K k"],  # near centroids of each, itself first
    first: int,
    last: int,  # exclusive
    partners: Int32[np.ndarray, " K"],  # receives the other cluster; itself where there is none
    costs: Float64[np.ndarray, " K"],  # receives the growth of the squared error (Ward): 0 for clusters without vectors
) -> None:
    """Find for the clusters ``first`` to ``last`` the near cluster with which they merge at the smallest cost."""
    for k in range(first, last):
        partners[k] = k
        costs[k] = 0.0
        if totals[k] == 0:
            continue
        costs[k] = np.inf
        for j in range(1, near.shape[1]):
            c = near[k, j]
            if totals[c] == 0:
                continue
            gap = np.float32(0)
            for d in range(centroids.shape[1]):
                step = centroids[k, d] - centroids[c, d]
                gap += step * step
            cost = totals[k] * totals[c] / (totals[k] + totals[c]) * gap
            if cost < costs[k]:
                costs[k] = cost
                partners[k] = c


@compiled(
    "void(float32[:, ::1], int64[::1], float32[::1], float32[::1], int32[::1], int64[::1], float32[:, ::1], "
    "float64[::1], float64[::1], float64, int64, int64, boolean[::1], float64[::1])"
)
def split_gains(
    table: Float32[np.ndarray, "R D"],
    rows: Int64[np.ndarray, " N"],  # row of each vector
    weights: Float32[np.ndarray, " N"],
    distances: Float32[np.ndarray, " N"],  # squared distance of each vector, by which the worst is found
    members: Int32[np.ndarray, " N"],  # vectors sorted by cluster
    edges: Int64[np.ndarray, " K+1"],  # where the members of each cluster begin
    centroids: Float32[np.ndarray, "K D"],
    totals: Float64[np.ndarray, " K"],
    errors: Float64[np.ndarray, " K"],
    least: float,  # error from which on a cluster is split
    first: int,
    last: int,  # exclusive
    second: Bool[np.ndarray, " N"],  # receives whether a vector belongs to the second half
    gains: Float64[np.ndarray, " K"],  # receives by how much the squared error shrinks
) -> None:
    """Split the clusters ``first`` to ``last`` in two, by 2-means that starts from the mean and the worst vector."""
    dimensions = table.shape[1]
    one = np.empty(dimensions)
    two = np.empty(dimensions)
    total = np.empty(dimensions)
    for k in range(first, last):
        gains[k] = 0.0
        if errors[k] < least or edges[k + 1] - edges[k] < 2:
            continue
        worst = members[edges[k]]
        for i in range(edges[k], edges[k + 1]):
            n = members[i]
            if weights[n] * distances[n] > weights[worst] * distances[worst]:
                worst = n
        for d in range(dimensions):
            one[d] = centroids[k, d]
            two[d] = table[rows[worst], d]
        for _ in range(3):
            middle = 0.0
            for d in range(dimensions):
                middle += (two[d] - one[d]) * (two[d] + one[d]) / 2
                total[d] = 0.0
            weight = 0.0
            for i in range(edges[k], edges[k + 1]):
                n = members[i]
                row = rows[n]
                along = 0.0
                for d in range(dimensions):
                    along += table[row, d] * (two[d] - one[d])
                second[n] = along > middle
                if second[n]:
                    weight += weights[n]
                    for d in range(dimensions):
                        total[d] += weights[n] * table[row, d]
            rest = totals[k] - weight
            if weight <= 0 or rest <= 0:
                gains[k] = 0.0
                break
            gap = 0.0
            for d in range(dimensions):
                two[d] = total[d] / weight
                one[d] = (totals[k] * centroids[k, d] - total[d]) / rest
                gap += (two[d] - one[d]) * (two[d] - one[d])
            gains[k] = weight * rest / totals[k] * gap


@compiled(
    "void(int32[::1], int32[::1], int32[::1], float64[::1], float64[::1], boolean[::1], int32[::1], int64[::1], "
    "int32[::1], uint16[:, ::1])"
)
def relocate(
    merged: Int32[np.ndarray, " _"],  # clusters by rising cost
    split: Int32[np.ndarray, " _"],  # clusters by falling gain
    partners: Int32[np.ndarray, " K"],  # cluster that takes the vectors of a merged one
    costs: Float64[np.ndarray, " K"],  # growth of the error by merging
    gains: Float64[np.ndarray, " K"],  # shrinkage of the error by splitting
    second: Bool[np.ndarray, " N"],  # whether a vector belongs to the half that gets another number
    members: Int32[np.ndarray, " N"],  # vectors sorted by cluster
    edges: Int64[np.ndarray, " K+1"],  # where the members of each cluster begin
    labels: Int32[np.ndarray, " N"],  # cluster of each vector; modified
    near: UInt16[np.ndarray, "K k"],  # near centroids of each, itself first; modified
) -> None:
    """Merge clusters into their partners and give their numbers to halves of others, while that lowers the error. A
    cluster takes part once at most."""
    count = near.shape[1]
    used = np.zeros(near.shape[0], dtype=np.bool_)
    row = np.empty(count, dtype=np.uint16)
    at = 0
    for moved in merged:
        partner = partners[moved]
        while at < len(split) and used[split[at]]:
            at += 1
        if at == len(split) or gains[split[at]] <= costs[moved]:
            break
        source = split[at]
        if used[moved] or used[partner] or source in (moved, partner):
            continue
        used[moved] = used[partner] = used[source] = True
        for i in range(edges[moved], edges[moved + 1]):
            labels[members[i]] = partner
        for i in range(edges[source], edges[source + 1]):
            if second[members[i]]:
                labels[members[i]] = moved
        near[moved, 0] = moved
        filled = 1
        for j in range(count):
            row[j] = near[source, j]  # copying a slice would compile for seconds
            if filled < count and row[j] != moved:
                near[moved, filled] = row[j]
                filled += 1
        for j in range(min(count, 16)):
            c = row[j]
            last = 1
            while last < count - 1 and near[c, last] != moved:
                last += 1
            if c != moved and count > 1:  # the new neighbour comes second, in place of itself or of the last
                while last > 1:
                    near[c, last] = near[c, last - 1]
                    last -= 1
                near[c, 1] = moved
