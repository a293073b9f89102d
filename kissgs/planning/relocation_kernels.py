"""Compiled inner loops by which k-means merges clusters and gives their numbers to halves of others."""

from __future__ import annotations

import numpy as np

from kissgs.core.numba_kernels import compiled


@compiled("void(float32[:, ::1], float64[::1], uint16[:, ::1], int64, int64, int32[::1], float64[::1])")
def merge_costs(
    centroids: np.ndarray,
    totals: np.ndarray,
    near: np.ndarray,
    first: int,
    last: int,
    partners: np.ndarray,
    costs: np.ndarray,
) -> None:
    """Find for the clusters ``first`` to ``last`` the near cluster with which they merge at the smallest cost.

    Args:
        centroids: ``(K, D)``, the means of the clusters.
        totals: ``(K,)`` weights of the clusters.
        near: ``(K, k)`` near centroids of each, itself first.
        first: first cluster.
        last: the one after the last.
        partners: ``(K,)`` receives the other cluster; of clusters without vectors, and where there is none, themselves.
        costs: ``(K,)`` receives the growth of the squared error (Ward): 0 for clusters without vectors.
    """
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
    table: np.ndarray,
    rows: np.ndarray,
    weights: np.ndarray,
    distances: np.ndarray,
    members: np.ndarray,
    edges: np.ndarray,
    centroids: np.ndarray,
    totals: np.ndarray,
    errors: np.ndarray,
    least: float,
    first: int,
    last: int,
    second: np.ndarray,
    gains: np.ndarray,
) -> None:
    """Split the clusters ``first`` to ``last`` in two, by 2-means that starts from the mean and the worst vector.

    Args:
        table: ``(R, D)`` vectors.
        rows: ``(N,)`` row of each vector.
        weights: ``(N,)`` weights.
        distances: ``(N,)`` squared distance of each vector, by which the worst is found.
        members: ``(N,)`` vectors sorted by cluster.
        edges: ``(K + 1,)`` where the members of each cluster begin.
        centroids: ``(K, D)``, the means of the clusters.
        totals: ``(K,)`` weights of the clusters.
        errors: ``(K,)`` errors of the clusters.
        least: error from which on a cluster is split.
        first: first cluster.
        last: the one after the last.
        second: ``(N,)`` receives whether a vector belongs to the second half.
        gains: ``(K,)`` receives by how much the squared error shrinks; 0 for clusters that are not split.
    """
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
    merged: np.ndarray,
    split: np.ndarray,
    partners: np.ndarray,
    costs: np.ndarray,
    gains: np.ndarray,
    second: np.ndarray,
    members: np.ndarray,
    edges: np.ndarray,
    labels: np.ndarray,
    near: np.ndarray,
) -> None:
    """Merge clusters into their partners and give their numbers to halves of others, while that lowers the error.

    A cluster takes part once at most.

    Args:
        merged: clusters by rising cost.
        split: clusters by falling gain.
        partners: ``(K,)`` cluster that takes the vectors of a merged one.
        costs: ``(K,)`` growth of the error by merging.
        gains: ``(K,)`` shrinkage of the error by splitting.
        second: ``(N,)`` whether a vector belongs to the half that gets another number.
        members: ``(N,)`` vectors sorted by cluster.
        edges: ``(K + 1,)`` where the members of each cluster begin.
        labels: ``(N,)`` cluster of each vector; modified.
        near: ``(K, k)`` near centroids of each, itself first; modified: of the cluster with a new place, of the one
            that was split, and of those near to it.
    """
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
        row[:] = near[source]
        near[moved, 0] = moved
        filled = 1
        for j in range(count):
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
