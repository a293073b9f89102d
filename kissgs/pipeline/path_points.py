"""Numbers of the points of a training path: how many Gaussians each has, and which one suits a size."""

from __future__ import annotations

import math

from kissgs.core.splats import Splats

KEEP = 0.8
"""Share of the Gaussians that each point of the path keeps of the point before."""

POINTS_PER_HALVING = math.log(0.5) / math.log(KEEP)
"""Points of the path by which the number of Gaussians is halved."""

BYTES_PER_GAUSSIAN, BYTES_OF_SH = 8.6, 4.0
"""Bytes of a container per Gaussian that are expected at first, and those of view-dependent colour in addition."""

OVERHEAD_BYTES = 4000
"""Bytes of a container that are no images."""


def count_at(number: int, count: int) -> int:
    """Return the number of Gaussians at a point of the path of a scene with ``count``, at least 1."""
    return max(1, round(count * KEEP**number))


def last_number(count: int) -> int:
    """Return the number of the last point of the path of a scene with ``count`` Gaussians, at least 1."""
    return max(1, math.floor(math.log(1 / count) / math.log(KEEP)))


def number_for_size(splats: Splats, size: float) -> int:
    """Return the number of the point whose container is expected to have ``size`` bytes; 0: all Gaussians fit."""
    expected = (BYTES_PER_GAUSSIAN + BYTES_OF_SH * (splats.sh_degree > 0)) * len(splats)
    share = max((size - OVERHEAD_BYTES) / expected, 1 / len(splats))
    return max(0, round(math.log(share) / math.log(KEEP)))
