"""Bytes against quality: curves, what two of them differ by, and which points nothing beats."""

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
    """Bytes over quality: logarithms of bytes, with straight lines between the points.

    Attributes:
        quality: ``(P,)`` ascending, such as decibels.
        log_bytes: ``(P,)`` natural logarithms.
    """

    quality: Float64[np.ndarray, " P"]
    log_bytes: Float64[np.ndarray, " P"]

    @classmethod
    def of(cls, points: Iterable[tuple[float, float]]) -> RateCurve:
        """Through (quality, bytes), in any order. Where quality is infinite or NaN, a point says nothing."""
        kept = sorted((quality, math.log(size)) for quality, size in points if math.isfinite(quality))
        return cls(np.array([q for q, _ in kept], np.float64), np.array([b for _, b in kept], np.float64))

    def bytes_at(self, quality: float) -> float | None:
        """Where the curve has that quality; None beyond its ends."""
        if not len(self.quality) or not self.quality[0] <= quality <= self.quality[-1]:
            return None
        return float(np.exp(np.interp(quality, self.quality, self.log_bytes)))

    def saving(self, other: RateCurve) -> float | None:
        """By what share ``other`` is smaller at equal quality, on average; negative if larger.

        Bjøntegaard's measure (VCEG-M33) with straight lines: the mean difference of the logarithms of bytes over the
        range of quality that both curves cover. None where there is no such range.
        """
        low = max(curve.quality.min(initial=np.inf) for curve in (self, other))
        high = min(curve.quality.max(initial=-np.inf) for curve in (self, other))
        if not low < high:
            return None
        grid = np.linspace(low, high, 1001)
        own, others = (np.interp(grid, curve.quality, curve.log_bytes) for curve in (self, other))
        return 1 - float(np.exp(np.mean(others - own)))


def pareto(points: Sequence[tuple[float, float]]) -> list[int]:
    """Which of these (bytes, quality) nothing beats, fewest bytes first; a NaN is beaten by all.

    One beats another if it has no more bytes and no less quality, and is not the same in both. Of equals, the first.
    """
    front: list[int] = []
    for index in sorted(range(len(points)), key=lambda n: (points[n][0], -points[n][1])):
        if not math.isnan(points[index][1]) and (not front or points[index][1] > points[front[-1]][1]):
            front.append(index)
    return front


def at_fidelity(settings: Settings, quality_offset_db: float) -> Settings:
    """The same but for the quality_offset_db, and for goals that would contradict it.

    Raises:
        UnsupportedError: they weigh no bits, and so know no quality_offset_db.
    """
    if not settings.encode.rate_distortion:
        raise UnsupportedError(
            f"the preset {settings.preset} weighs no bits, and knows no quality_offset_db; choose another"
        )
    asked = {"quality_offset_db": quality_offset_db, "rd_lambda": None, **dict.fromkeys(GOALS)}
    encode = EncodeSettings(**{**settings.encode.model_dump(), **asked})
    return settings.model_copy(update={"encode": encode})
