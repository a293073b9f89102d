"""Figures that goals ask for. Oracle: squared errors, added and averaged one by one."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from kissgs.cameras.views import View
from kissgs.evaluation.psnr_loss import UNEVEN, USUAL, drop_of, psnr_of
from kissgs.evaluation.results import Comparison, Evaluation, ImageMetrics, ViewComparison
from kissgs.rendering.camera import look_at

VIEW = View(
    "a", look_at(np.zeros(3), np.array([0.0, 0.0, 1.0]), np.array([0.0, -1.0, 0.0]), fov=1.0, width=4, height=4)
)


def likeness(psnr):
    return ImageMetrics(psnr=psnr, ssim=0.5)


def evaluation_of(between, photos=None):
    """Views with these PSNRs, and, if given, pairs of the reference's and the candidate's PSNR to photographs."""
    compared = [
        Comparison(reference=None, candidate=likeness(psnr), candidate_vs_reference=likeness(psnr)) for psnr in between
    ]
    if photos is not None:
        compared = [
            Comparison(reference=likeness(one), candidate=likeness(other), candidate_vs_reference=likeness(psnr))
            for (one, other), psnr in zip(photos, between, strict=True)
        ]
    return Evaluation(
        against="renderings" if photos is None else "photos",
        split="all",
        source="",
        background=np.zeros(3, np.float32),
        reference_count=1,
        candidate_count=1,
        views=tuple(ViewComparison(view=VIEW, comparison=each) for each in compared),
    )


def squared(psnr):
    return 10 ** (-np.asarray(psnr) / 10)


def test_a_mean_does_not_make_up_for_a_part_that_is_lost():
    """23 views at 44 dB and one at 9 are 42.5 on average; a goal of 42 was met."""
    found = evaluation_of([44.0] * 23 + [9.0])
    assert found.mean.candidate_vs_reference.psnr > 42
    assert psnr_of(found) == pytest.approx(-10 * math.log10((squared(9) + squared(44)) / 2 / UNEVEN))
    assert psnr_of(found) < 26
    even = evaluation_of([USUAL + 16.4] * 24)
    assert drop_of(even) == pytest.approx(0.1, abs=0.002)
    assert drop_of(found) > 1


def test_views_that_are_only_harder_change_nothing():
    found = evaluation_of([46.0] * 20 + [37.0] * 4)
    assert psnr_of(found) == found.mean.candidate_vs_reference.psnr
    assert drop_of(found) == pytest.approx(
        10 * math.log10(1 + squared(found.mean.candidate_vs_reference.psnr) / squared(USUAL))
    )


@pytest.mark.parametrize(("count", "worst"), [(1, 1), (20, 1), (21, 2), (96, 5)])
def test_a_twentieth_of_the_views_is_one_at_least(count, worst):
    figures = [5.0] + [50.0] * (count - 1)
    error = np.mean(sorted(squared(figures))[-worst:])
    assert psnr_of(evaluation_of(figures)) == pytest.approx(min(np.mean(figures), -10 * math.log10(error / UNEVEN)))


def test_photographs_count_by_what_came_on_top():
    """A view that was bad before is no loss; one that became bad is."""
    before = [32.0] * 24
    bad = evaluation_of([45.0] * 24, [(30.0, 29.9), (9.0, 9.0), *[(psnr, psnr) for psnr in before[2:]]])
    assert drop_of(bad) == pytest.approx(0.1 / 24, abs=1e-6)
    lost = evaluation_of([45.0] * 24, [(psnr, psnr + 0.5) for psnr in before[1:]] + [(32.0, 20.5)])
    assert lost.mean.change == pytest.approx(0.0, abs=1e-9)
    top = (squared(20.5) - squared(32.0) + squared(32.5) - squared(32.0)) / 2
    assert drop_of(lost) == pytest.approx(10 * math.log10(1 + top / squared(32.0) / UNEVEN))
    better = evaluation_of([45.0] * 24, [(psnr, psnr + 0.5) for psnr in before])
    assert drop_of(better) == pytest.approx(-0.5)


@given(st.lists(st.floats(0, 100) | st.sampled_from([math.inf, math.nan]), min_size=1, max_size=45))
def test_any_figures(figures):
    found = evaluation_of(figures)
    if any(map(math.isnan, figures)):
        assert math.isnan(psnr_of(found))
        assert math.isnan(drop_of(found))
    else:
        assert psnr_of(found) <= found.mean.candidate_vs_reference.psnr
        assert drop_of(found) >= 0
        assert (psnr_of(found) == math.inf) == (min(figures) == math.inf)
