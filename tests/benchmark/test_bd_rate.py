"""Reference: rate curves given as formulas, and Pareto fronts by comparison of all pairs."""

import math

import numpy as np
import pytest

from kissgs import Settings, UnsupportedError
from kissgs.benchmark.bd_rate import RateCurve, at_quality_offset, pareto_front


def is_dominated(point, other):
    """Return whether ``other`` dominates ``point``, (bytes, quality) each, by definition."""
    (size, quality), (other_size, other_quality) = point, other
    return other_size <= size and other_quality >= quality and (other_size, other_quality) != (size, quality)


@pytest.mark.parametrize("seed", range(20))
def test_the_front_holds_exactly_the_points_that_none_dominates(seed):
    rng = np.random.default_rng(seed)
    points = [tuple(map(float, point)) for point in rng.integers(0, 12, (25, 2))]
    front = pareto_front(points)
    kept = {points[index] for index in front}
    assert kept == {point for point in points if not any(is_dominated(point, other) for other in points)}
    assert len(front) == len(kept), "one of several equal points"
    assert [points[index][0] for index in front] == sorted(points[index][0] for index in front)


def test_the_front_of_no_points_and_of_infinite_and_nan_quality():
    assert pareto_front([]) == []
    assert pareto_front([(5, math.nan), (9, 1.0)]) == [1]
    assert pareto_front([(5, math.inf), (4, math.inf), (3, 1.0)]) == [2, 1]


@pytest.mark.parametrize("growth", [1.05, 1.3])
def test_bytes_are_interpolated_exponentially_and_not_extrapolated(growth):
    points = [(q, 1e6 * growth**q) for q in (41.0, 30.0, 35.5)]
    curve = RateCurve.of([*points, (math.inf, 5.0), (math.nan, 5.0)])
    for quality in (30.0, 33.3, 35.5, 40.0, 41.0):
        assert curve.bytes_at(quality) == pytest.approx(1e6 * growth**quality, rel=1e-9)
    assert curve.bytes_at(29.99) is None
    assert curve.bytes_at(41.01) is None
    assert curve.bytes_at(math.nan) is None
    assert RateCurve.of([]).bytes_at(30.0) is None


def test_a_quality_offset_replaces_every_goal():
    settings = Settings.from_preset("small", psnr=40.0)
    other = at_quality_offset(settings, -3.5)
    assert (other.encode.quality_offset_db, other.encode.psnr, other.preset) == (-3.5, None, "small")
    changed = {name for name, value in other.encode.model_dump().items() if value != getattr(settings.encode, name)}
    assert changed == {"quality_offset_db", "psnr"}
    with pytest.raises(UnsupportedError, match="needs rate-distortion planning, which the preset paper does not have"):
        at_quality_offset(Settings.from_preset("paper"), 0.0)
