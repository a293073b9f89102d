"""Rate curves (bytes over quality), the average difference of two of them, and the Pareto front of points."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from kissgs.core.array_types import Float64
from kissgs.core.errors import UnsupportedError
from kissgs.settings import EncodeSettings, Settings
from kissgs.settings.encode import GOALS


@dataclass(frozen=True, slots=True, eq=False)
class RateCurve:
    """Bytes over quality: the logarithm of bytes, interpolated linearly between points.

    Attributes:
        quality: ``(P,)`` ascending; any measure that grows with quality, such as PSNR in decibels.
        log_bytes: ``(P,)`` natural logarithms of bytes.
    """

    quality: Float64[np.ndarray, " P"]
    log_bytes: Float64[np.ndarray, " P"]

    @classmethod
    def of(cls, points: Iterable[tuple[float, float]]) -> RateCurve:
        """Return the curve through (quality, bytes) in any order; points of infinite or NaN quality are ignored."""
        kept = sorted((quality, math.log(size)) for quality, size in points if math.isfinite(quality))
        return cls(np.array([q for q, _ in kept], np.float64), np.array([b for _, b in kept], np.float64))

    def bytes_at(self, quality: float) -> float | None:
        """Return the bytes at this quality, interpolated; None beyond the ends of the curve."""
        if not len(self.quality) or not self.quality[0] <= quality <= self.quality[-1]:
            return None
        return float(np.exp(np.interp(quality, self.quality, self.log_bytes)))

    def saving(self, other: RateCurve) -> float | None:
        """Return the share of bytes that ``other`` saves at equal quality, on average; negative if it needs more.

        The Bjøntegaard delta rate (VCEG-M33), negated, with linear interpolation: the mean difference of the logarithms
        of bytes over the range of quality that both curves cover. None if there is no such range.
        """
        low = max(curve.quality.min(initial=np.inf) for curve in (self, other))
        high = min(curve.quality.max(initial=-np.inf) for curve in (self, other))
        if not low < high:
            return None
        grid = np.linspace(low, high, 1001)
        own, others = (np.interp(grid, curve.quality, curve.log_bytes) for curve in (self, other))
        return 1 - float(np.exp(np.mean(others - own)))


def pareto_front(points: Sequence[tuple[float, float]]) -> list[int]:
    """Return the indices of the points (bytes, quality) that no other point dominates, fewest bytes first.

    A point dominates another if it has no more bytes and no less quality, and differs in one of them. Of equal points,
    the first is returned; a point with NaN quality never is.
    """
    front: list[int] = []
    for index in sorted(range(len(points)), key=lambda n: (points[n][0], -points[n][1])):
        if not math.isnan(points[index][1]) and (not front or points[index][1] > points[front[-1]][1]):
            front.append(index)
    return front


def at_quality_offset(settings: Settings, quality_offset_db: float) -> Settings:
    """Return the settings with another quality offset (decibels), and without a lambda or a goal, which it replaces.

    Raises:
        UnsupportedError: the settings have no rate-distortion planning, which a quality offset needs.
    """
    if not settings.encode.rate_distortion:
        raise UnsupportedError(
            f"quality_offset_db needs rate-distortion planning, which the preset {settings.preset} does not have; "
            "choose balanced or small"
        )
    changes = {"quality_offset_db": quality_offset_db, "rd_lambda": None, **dict.fromkeys(GOALS)}
    encode = EncodeSettings(**{**settings.encode.model_dump(), **changes})
    return settings.model_copy(update={"encode": encode})
