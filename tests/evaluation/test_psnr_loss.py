"""PSNR, its drop and that of SSIM as goals define them. Oracle: errors, added and averaged one by one."""

import math
from dataclasses import replace

import numpy as np
import pytest
from helpers.evaluations import compared, evaluation_of, evaluation_with, metrics
from hypothesis import given
from hypothesis import strategies as st

from kissgs.evaluation.results import ASSUMED_PSNR, MAX_ERROR_RATIO, MAX_SSIM_RATIO, drop_of, psnr_of, ssim_drop_of


def similarities(*ssims):
    """Return an evaluation with these SSIMs: to renderings, or pairs of reference and candidate to photographs."""
    pairs = [ssim if isinstance(ssim, tuple) else (None, ssim) for ssim in ssims]
    return evaluation_with(
        [
            compared(
                None if own is None else metrics(30.0, own),
                metrics(30.0, ssim),
                metrics(30.0, ssim if own is None else 0.2),
            )
            for own, ssim in pairs
        ]
    )


def test_a_drop_of_ssim_is_that_to_photographs_or_to_renderings():
    assert ssim_drop_of(similarities(0.99, 0.98, 1.0)) == pytest.approx(0.01)
    assert ssim_drop_of(similarities((0.94, 0.93), (0.9, 0.91), (0.8, 0.77))) == pytest.approx(0.01)
    assert ssim_drop_of(similarities((0.94, 0.95), (0.9, 0.9))) == pytest.approx(-0.005)
    assert ssim_drop_of(similarities(1.0, 1.0)) == 0
    assert math.isnan(ssim_drop_of(similarities(0.9, math.nan)))


def test_the_mean_of_ssim_does_not_hide_a_lost_part():
    """Two of 24 views lose 0.24 each: their mean drop, a fifth of which counts, is twelve times that of all views."""
    found = similarities(*[1.0] * 22, 0.76, 0.76)
    assert 1 - found.mean.candidate.ssim == pytest.approx(0.02)
    assert ssim_drop_of(found) == pytest.approx(0.24 / 5)
    photographs = similarities(*[(0.9, 0.91)] * 38, (0.9, 0.5), (0.9, 0.3))
    assert ssim_drop_of(photographs) == pytest.approx((0.4 + 0.6) / 2 / 5)


def test_difficult_views_do_not_limit_the_ssim():
    """The worst two of 40 views lose four times the mean."""
    found = similarities(*[0.99] * 38, 0.95, 0.95)
    assert ssim_drop_of(found) == pytest.approx(1 - found.mean.candidate.ssim)


def with_surroundings(psnrs, drawn, photo_psnrs=None):
    return replace(evaluation_of(psnrs, photo_psnrs), surroundings=evaluation_of(drawn))


def test_the_drop_is_that_of_the_views_and_the_psnr_that_of_the_surroundings():
    found = with_surroundings([ASSUMED_PSNR + 16.4] * 24, [40.0] * 24)
    assert drop_of(found) == pytest.approx(0.1, abs=0.002)
    assert psnr_of(found) == pytest.approx(40)
    better = with_surroundings([46.4] * 24, [50.0] * 24)
    assert drop_of(better) == drop_of(found)
    assert psnr_of(better) == pytest.approx(50)


def test_a_part_lost_in_the_surroundings_limits_the_drop():
    """The worst two of 24 of each group count, so that views of one do not hide the other's."""
    found = with_surroundings([46.4] * 24, [46.4] * 23 + [9.0])
    error = np.mean(squared([9.0, 46.4])) / squared(ASSUMED_PSNR)
    assert drop_of(found) == pytest.approx(10 * math.log10(1 + error / MAX_ERROR_RATIO))
    assert drop_of(with_surroundings([46.4] * 23 + [9.0], [46.4] * 24)) == pytest.approx(drop_of(found))
    lost = replace(similarities(*[0.99] * 24), surroundings=similarities(*[0.99] * 23, 0.2))
    assert ssim_drop_of(lost) == pytest.approx((0.8 + 0.01) / 2 / MAX_SSIM_RATIO)
    assert ssim_drop_of(replace(lost, surroundings=similarities(*[0.9] * 24))) == pytest.approx(0.1 / MAX_SSIM_RATIO)


@pytest.mark.parametrize("failed", [[math.nan] * 24, [46.4] * 23 + [math.nan]])
def test_a_failed_rendering_of_the_surroundings_is_no_result(failed):
    assert math.isnan(drop_of(with_surroundings([46.4] * 24, failed)))
    lost = replace(similarities(*[0.99] * 24), surroundings=similarities(*[0.9] * 23, failed[-1]))
    assert math.isnan(ssim_drop_of(lost))


def test_with_photographs_the_surroundings_do_not_count():
    pairs = [(32.0, 31.5)] * 24
    found = with_surroundings([45.0] * 24, [9.0] * 24, pairs)
    assert drop_of(found) == pytest.approx(0.5)
    assert psnr_of(found) == psnr_of(evaluation_of([45.0] * 24, pairs))


def squared(psnr):
    return 10 ** (-np.asarray(psnr) / 10)


def test_the_mean_does_not_hide_a_lost_part():
    """The mean of 23 views at 44 dB and one at 9 dB is 42.5 dB, which would meet a goal of 42 dB."""
    found = evaluation_of([44.0] * 23 + [9.0])
    assert found.mean.candidate_vs_reference.psnr > 42
    assert psnr_of(found) == pytest.approx(-10 * math.log10((squared(9) + squared(44)) / 2 / MAX_ERROR_RATIO))
    assert psnr_of(found) < 26
    even = evaluation_of([ASSUMED_PSNR + 16.4] * 24)
    assert drop_of(even) == pytest.approx(0.1, abs=0.002)
    assert drop_of(found) > 1


def test_difficult_views_do_not_limit_the_psnr():
    found = evaluation_of([46.0] * 20 + [37.0] * 4)
    assert psnr_of(found) == found.mean.candidate_vs_reference.psnr
    assert drop_of(found) == pytest.approx(
        10 * math.log10(1 + squared(found.mean.candidate_vs_reference.psnr) / squared(ASSUMED_PSNR))
    )


@pytest.mark.parametrize(("count", "worst"), [(1, 1), (20, 1), (21, 2), (96, 5)])
def test_the_worst_five_percent_are_at_least_one_view(count, worst):
    psnrs = [5.0] + [50.0] * (count - 1)
    error = np.mean(sorted(squared(psnrs))[-worst:])
    assert psnr_of(evaluation_of(psnrs)) == pytest.approx(
        min(np.mean(psnrs), -10 * math.log10(error / MAX_ERROR_RATIO))
    )


def test_with_photographs_only_additional_error_counts():
    """A view with a low PSNR in the reference is no loss; one whose PSNR drops is."""
    before = [32.0] * 24
    bad = evaluation_of([45.0] * 24, [(30.0, 29.9), (9.0, 9.0), *[(psnr, psnr) for psnr in before[2:]]])
    assert drop_of(bad) == pytest.approx(0.1 / 24, abs=1e-6)
    lost = evaluation_of([45.0] * 24, [(psnr, psnr + 0.5) for psnr in before[1:]] + [(32.0, 20.5)])
    assert lost.mean.change == pytest.approx(0.0, abs=1e-9)
    added = (squared(20.5) - squared(32.0) + squared(32.5) - squared(32.0)) / 2
    assert drop_of(lost) == pytest.approx(10 * math.log10(1 + added / squared(32.0) / MAX_ERROR_RATIO))
    better = evaluation_of([45.0] * 24, [(psnr, psnr + 0.5) for psnr in before])
    assert drop_of(better) == pytest.approx(-0.5)


@given(st.lists(st.floats(0, 100) | st.sampled_from([math.inf, math.nan]), min_size=1, max_size=45))
def test_psnr_and_drop_of_any_values(psnrs):
    found = evaluation_of(psnrs)
    if any(map(math.isnan, psnrs)):
        assert math.isnan(psnr_of(found))
        assert math.isnan(drop_of(found))
    else:
        assert psnr_of(found) <= found.mean.candidate_vs_reference.psnr
        assert drop_of(found) >= 0
        assert (psnr_of(found) == math.inf) == (min(psnrs) == math.inf)
