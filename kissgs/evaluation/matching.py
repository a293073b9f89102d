"""Which Gaussian of a rewritten scene is which of the original."""

from __future__ import annotations

import numpy as np

from kissgs.core.array_types import Float32, Float64, Int
from kissgs.core.errors import InvalidSceneError, UnsupportedError
from kissgs.core.splats import Splats
from kissgs.evaluation.attributes import sigmoid

NEIGHBOURS = 8
"""How many references each candidate may ask for."""


def pair(reference: Splats, candidate: Splats) -> Int[np.ndarray, " M"]:
    """For each Gaussian of ``candidate``, the row of ``reference`` that it comes from.

    For scenes out of tools that reorder or drop Gaussians. Approximate: those near in position, size, opacity and
    colour are paired, nearest first, so that no reference serves twice; a candidate whose nearest few references all
    went to others shares its nearest one. Gaussians alike in everything may be swapped.

    Args:
        reference: N Gaussians, cleaned.
        candidate: M Gaussians, cleaned.

    Returns:
        ``(M,)`` int64 row numbers, for ``reference.select``.

    Raises:
        InvalidSceneError: the reference is empty, and the candidate is not.
        UnsupportedError: SciPy is not installed.
    """
    if not len(candidate):
        return np.empty(0, np.int64)
    if not len(reference):
        raise InvalidSceneError("no Gaussian can be paired with an empty reference scene")
    try:
        from scipy.spatial import cKDTree
    except ModuleNotFoundError as error:
        raise UnsupportedError("pairing Gaussians needs SciPy: pip install 'kissgs[bench]'") from error

    low, high = np.percentile(_symmetric_log(reference.means), (10, 90), axis=0)
    spacing = max(float(np.linalg.norm(high - low)) / np.sqrt(len(reference)), 1e-9)  # as if all lay on a surface
    k = np.arange(1, min(NEIGHBOURS, len(reference)) + 1)
    distances, nearest = cKDTree(_features(reference, spacing)).query(_features(candidate, spacing), k=k, workers=-1)
    return _one_to_one(distances, nearest, len(reference))


def _symmetric_log(means: Float32[np.ndarray, "N 3"]) -> Float64[np.ndarray, "N 3"]:
    wide = means.astype(np.float64)
    return np.asarray(np.sign(wide) * np.log1p(np.abs(wide)))


def _features(splats: Splats, spacing: float) -> Float64[np.ndarray, "N 9"]:
    """Position, two sizes, opacity and colour, in units about as large as a coarse codec's errors."""
    position = _symmetric_log(splats.means) / (spacing / 5)
    # Sorted sizes are the same in all equivalent forms. The smallest, and all that is tiny, codecs clamp as they like.
    sizes = np.maximum(np.sort(splats.scales, axis=1)[:, 1:], -9.5) / 0.1
    opacity = sigmoid(splats.opacities)[:, None]
    seen = opacity * splats.sh0 / 0.05  # some codecs scramble the colour of what is transparent
    return np.hstack([position, sizes, opacity / 0.02, seen])


def _one_to_one(
    distances: Float64[np.ndarray, "M k"], nearest: Int[np.ndarray, "M k"], references: int
) -> Int[np.ndarray, " M"]:
    """Stable matching: all propose to their next nearest reference, which keeps the nearest who ever asked."""
    holder, held = np.full(references, -1), np.full(references, np.inf)
    turn = np.zeros(len(nearest), np.int64)
    free = np.arange(len(nearest))
    while len(free):
        asked, distance = nearest[free, turn[free]], distances[free, turn[free]]
        order = np.lexsort((distance, asked))
        first = order[np.flatnonzero(np.diff(asked[order], prepend=-1))]
        first = first[distance[first] < held[asked[first]]]
        released = holder[asked[first]]
        holder[asked[first]], held[asked[first]] = free[first], distance[first]
        refused = np.concatenate([np.delete(free, first), released[released >= 0]])
        turn[refused] += 1
        free = refused[turn[refused] < nearest.shape[1]]
    result = nearest[:, 0].astype(np.int64)
    taken = np.flatnonzero(holder >= 0)
    result[holder[taken]] = taken
    return result
