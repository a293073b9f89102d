"""Correspondence between the Gaussians of a scene and those of a copy that a tool has reordered or reduced."""

from __future__ import annotations

import numpy as np

from kissgs.core.array_types import Float32, Float64, Int
from kissgs.core.errors import InvalidSceneError, UnsupportedError
from kissgs.core.splats import Splats
from kissgs.evaluation.attributes import sigmoid

NEIGHBOURS = 8
"""Nearest references that each candidate may be assigned to."""


def match_gaussians(reference: Splats, candidate: Splats) -> Int[np.ndarray, " M"]:
    """Find the Gaussian of ``reference`` that each Gaussian of ``candidate`` comes from.

    The result is approximate: a stable matching by position, size, opacity and colour, in which each reference is used
    once. A candidate whose nearest references are all assigned to others gets its nearest one nevertheless. Gaussians
    that are equal in all attributes may be swapped.

    Args:
        reference: N Gaussians, cleaned.
        candidate: M Gaussians, cleaned.

    Returns:
        ``(M,)`` int64 row numbers, for ``reference.select``.

    Raises:
        InvalidSceneError: the reference is empty and the candidate is not.
        UnsupportedError: SciPy is not installed.
    """
    if not len(candidate):
        return np.empty(0, np.int64)
    if not len(reference):
        raise InvalidSceneError("Gaussians cannot be matched with an empty reference; give the original scene")
    try:
        from scipy.spatial import cKDTree
    except ModuleNotFoundError as error:
        raise UnsupportedError(
            "matching Gaussians needs SciPy, which is missing: pip install 'kissgs[bench]'"
        ) from error

    low, high = np.percentile(_symmetric_log(reference.means), (10, 90), axis=0)
    spacing = max(float(np.linalg.norm(high - low)) / np.sqrt(len(reference)), 1e-9)  # as if all were on a surface
    k = np.arange(1, min(NEIGHBOURS, len(reference)) + 1)
    distances, nearest = cKDTree(_features(reference, spacing)).query(_features(candidate, spacing), k=k, workers=-1)
    return _one_to_one(distances, nearest, len(reference))


def _symmetric_log(means: Float32[np.ndarray, "N 3"]) -> Float64[np.ndarray, "N 3"]:
    wide = means.astype(np.float64)
    return np.asarray(np.sign(wide) * np.log1p(np.abs(wide)))


def _features(splats: Splats, spacing: float) -> Float64[np.ndarray, "N 9"]:
    """Return position, two sizes, opacity and colour, in units of about a coarse codec's errors."""
    position = _symmetric_log(splats.means) / (spacing / 5)
    # Sorted sizes are equal in all equivalent forms. Codecs may clamp the smallest, and all tiny ones.
    sizes = np.maximum(np.sort(splats.scales, axis=1)[:, 1:], -9.5) / 0.1
    opacity = sigmoid(splats.opacities)[:, None]
    color = opacity * splats.sh0 / 0.05  # weighted: some codecs scramble the colours of transparent Gaussians
    return np.hstack([position, sizes, opacity / 0.02, color])


def _one_to_one(
    distances: Float64[np.ndarray, "M k"], nearest: Int[np.ndarray, "M k"], references: int
) -> Int[np.ndarray, " M"]:
    """Match by deferred acceptance: candidates propose to their next nearest reference, which keeps the nearest one."""
    holder, held = np.full(references, -1), np.full(references, np.inf)
    rank = np.zeros(len(nearest), np.int64)
    free = np.arange(len(nearest))
    while len(free):
        asked, distance = nearest[free, rank[free]], distances[free, rank[free]]
        order = np.lexsort((distance, asked))
        first = order[np.flatnonzero(np.diff(asked[order], prepend=-1))]
        first = first[distance[first] < held[asked[first]]]
        released = holder[asked[first]]
        holder[asked[first]], held[asked[first]] = free[first], distance[first]
        refused = np.concatenate([np.delete(free, first), released[released >= 0]])
        rank[refused] += 1
        free = refused[rank[refused] < nearest.shape[1]]
    result = nearest[:, 0].astype(np.int64)
    matched = np.flatnonzero(holder >= 0)
    result[holder[matched]] = matched
    return result
