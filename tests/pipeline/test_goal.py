"""Oracle: the definition of each limit; a model of a scene whose losses grow with lambda."""

import math
import re
from dataclasses import replace

import pytest

from kissgs import Settings
from kissgs.core.root_finding import find_root
from kissgs.evaluation.results import Detail
from kissgs.pipeline.curves import LOG2_LAMBDA_RANGE
from kissgs.pipeline.goal import Attempt, Goal


def goal_of(**limits):
    return Goal.of(Settings.research("balanced", **limits).encode)


def test_infinity_and_nan_in_json():
    trial = Attempt(1, 1e-9, 10, psnr=math.inf, drop=-math.inf, worst=math.nan).as_dict()
    assert (trial["psnr"], trial["drop"], trial["worst"], trial["bytes"]) == (None, None, "NaN", 10)


def test_an_infinite_drop_meets_no_goal():
    goal = goal_of(max_psnr_drop=1.0)
    assert goal.margin(Attempt(1, 1e-9, 10, drop=math.inf)) == -math.inf


@pytest.mark.parametrize(
    ("drop", "ssim_drop", "met"),
    [(0.1, 0.003, True), (0.11, 0.003, False), (0.1, 0.0031, False), (-1.0, 0.003, True), (0.1, -1.0, True)],
)
def test_of_two_drops_both_must_hold(drop, ssim_drop, met):
    goal = goal_of(max_psnr_drop=0.1, max_ssim_drop=0.003)
    assert (goal.margin(Attempt(1, 1e-9, 10, drop=drop, ssim_drop=ssim_drop)) >= 0) == met


SAME = {"drop": 0.1, "ssim_drop": 0.003, "detail": Detail(worst=-0.09, worst_percent=-0.05, share_below=0.005)}
"""Figures of a container that just meets the quality "same", as docs/guide/goals.md states it."""


@pytest.mark.parametrize(
    ("changes", "met"),
    [
        ({}, True),
        ({"drop": 0.101}, False),
        ({"ssim_drop": 0.00301}, False),
        ({"detail": Detail(worst=-0.0901, worst_percent=-0.05, share_below=0.005)}, False),
        ({"detail": Detail(worst=-0.09, worst_percent=-0.0501, share_below=0.005)}, False),
        ({"detail": Detail(worst=math.nan, worst_percent=math.nan, share_below=math.nan)}, False),
        ({"detail": Detail(worst=0.01, worst_percent=0.02, share_below=0.0)}, True),
    ],
)
def test_a_quality_limits_psnr_ssim_and_detail_together(changes, met):
    attempt = Attempt(1, 1e-9, 10, **{**SAME, **changes})
    assert (goal_of(quality="same").margin(attempt) >= 0) == met
    assert goal_of(quality="good").margin(attempt) >= 0 or math.isnan(attempt.detail.worst)


def test_given_limits_replace_those_of_a_quality():
    goal = goal_of(quality="same", max_psnr_drop=0.2)
    assert goal.margin(Attempt(1, 1e-9, 10, **{**SAME, "drop": 0.2})) >= 0
    assert goal.margin(Attempt(1, 1e-9, 10, **{**SAME, "drop": 0.2, "ssim_drop": 0.0031})) < 0


def test_a_quality_that_cannot_be_met_is_named_with_all_that_is_missed():
    lost = Attempt(1, 1e-9, 10, **{**SAME, "drop": 0.12, "detail": Detail(-0.1999, -0.04, 0.01)})
    assert goal_of(quality="same").failure_message([lost], suggest_compaction=False) == (
        "quality same cannot be met: the finest container found loses 0.12 dB and 0.2 of SSIM in the worst patch; "
        "choose a lower quality, or give max_psnr_drop"
    )


@pytest.mark.parametrize("drops", [(math.nan, 0.001), (0.05, math.nan), (math.nan, math.nan)])
def test_a_failed_rendering_meets_no_drop(drops):
    goal = goal_of(max_psnr_drop=0.1, max_ssim_drop=0.003)
    assert not goal.margin(Attempt(1, 1e-9, 10, drop=drops[0], ssim_drop=drops[1])) >= 0


@pytest.mark.parametrize(
    ("drop", "ssim_drop", "near"),
    [(0.085, 0.001, True), (0.07, 0.001, False), (0.01, 0.0029, True), (0.01, 0.0027, False), (0.07, 0.0027, False)],
)
def test_near_the_limit_that_decides_is_near_enough(drop, ssim_drop, near):
    """Near is 0.02 dB of a drop of PSNR, and 5 % of a drop of SSIM."""
    goal = goal_of(max_psnr_drop=0.1, max_ssim_drop=0.003)
    trial = Attempt(1, 1e-9, 10, drop=drop, ssim_drop=ssim_drop)
    assert goal.margin(trial) == pytest.approx(math.log2(min(0.1 / drop, 0.003 / ssim_drop)))
    assert (0 <= goal.margin(trial) <= goal.decisive(trial).near) == near


def model_trial(x, growth, ssim_growth):
    """Return a trial at lambda 2^x whose drops grow exponentially with x."""
    drop, ssim_drop = 0.45 * 2 ** (growth * (x + 34)), 0.0074 * 2 ** (ssim_growth * (x + 34))
    return Attempt(1, 2.0**x, 10, drop=drop, ssim_drop=ssim_drop)


def searched(goal, growth, ssim_growth, start):
    """Search in a model of a scene. Return log2(lambda) of all trials, and of the best."""

    def decisive(x):
        return goal.decisive(model_trial(x, growth, ssim_growth))

    tried = []

    def margin(x):
        tried.append(x)
        return goal.margin(model_trial(x, growth, ssim_growth))

    found = find_root(margin, start, decisive(start).slope, lambda x: decisive(x).near, LOG2_LAMBDA_RANGE)
    return tried, found


@pytest.mark.parametrize("growth", [0.6, 0.9])
@pytest.mark.parametrize("ssim_growth", [0.6, 0.9])
@pytest.mark.parametrize("start", [-34.0, -39.0])
def test_two_limits_take_few_more_encodings_than_the_tighter_one(growth, ssim_growth, start):
    for psnr in (0.01, 0.05, 0.1, 0.2, 0.3, 0.5, 1.0, 3.0, 20.0):
        limits = {"max_psnr_drop": psnr, "max_ssim_drop": 0.003}
        points, found = searched(goal_of(**limits), growth, ssim_growth, start)
        decisive = goal_of(**limits).decisive(model_trial(found, growth, ssim_growth))
        single, _ = searched(Goal((decisive,)), growth, ssim_growth, start)
        assert len(points) <= len(single) + 2
        assert 0 <= decisive.margin(model_trial(found, growth, ssim_growth)) <= decisive.near


@pytest.mark.parametrize(
    ("limits", "found", "message"),
    [
        ((1.0, 1e-7), (0.0331, 0.00053901), "max_ssim_drop 1e-07 .* loses 0.00054 of SSIM; allow"),
        ((0.01, 1e-7), (0.033101, 0.000539001), "max_psnr_drop 0.01 dB and .* loses 0.0332 dB and 0.00054 of SSIM;"),
        ((0.01, 0.001), (-0.0201, 0.002001), "max_ssim_drop 0.001 cannot .* loses 0.00201 of SSIM;"),
        ((0.01, None), (math.inf, None), "max_psnr_drop 0.01 dB cannot .* so any loss of PSNR is infinite"),
        ((0.01, None), (math.nan, None), "max_psnr_drop 0.01 dB cannot .* so its quality is unknown"),
        ((None, 0.01), (None, math.nan), "max_ssim_drop 0.01 cannot .* so its quality is unknown"),
    ],
)
def test_the_message_names_the_limits_that_are_missed(limits, found, message):
    """Losses are rounded up, so that the one that is named can be met."""
    goal = goal_of(**dict(zip(("max_psnr_drop", "max_ssim_drop"), limits, strict=True)))
    trial = Attempt(1, 1e-9, 10, drop=found[0], ssim_drop=found[1])
    assert re.match(message, goal.failure_message([trial], suggest_compaction=False))


def test_a_failed_rendering_has_no_psnr():
    message = goal_of(psnr=40.0).failure_message([Attempt(1, 1e-9, 10, psnr=math.nan)], suggest_compaction=False)
    assert re.match("psnr 40 dB cannot .* so its quality is unknown", message)


def test_the_loss_that_is_named_can_be_met():
    trial = Attempt(1, 1e-9, 10, drop=0.03, ssim_drop=0.0029999999)
    message = goal_of(max_psnr_drop=0.001, max_ssim_drop=0.001).failure_message([trial], suggest_compaction=False)
    psnr, ssim = re.search("loses (.*) dB and (.*) of SSIM", message).groups()
    assert (psnr, ssim) == ("0.03", "0.003")
    assert goal_of(max_psnr_drop=float(psnr), max_ssim_drop=float(ssim)).margin(trial) >= 0


def test_nothing_lost_is_an_unknown_distance():
    goal = Goal.of(Settings.from_preset("balanced", max_ssim_drop=0.1).encode)
    assert goal.margin(Attempt(1, 1e-9, 10, ssim_drop=0.0)) == math.inf


@pytest.mark.parametrize(
    ("goal", "plain", "trained"),
    [
        ({"max_psnr_drop": 0.3}, 0.28, 0.2274),
        ({"max_psnr_drop": 0.1}, 0.08, 0.076),  # no less than three quarters
        ({"max_psnr_drop": 0.02}, 0.01, 0.01),
        ({"max_ssim_drop": 0.01}, 0.0095, 0.00815),
        ({"target_size": 1e6}, 1e6 * 0.97, 1e6 * 0.97**2.5),
    ],
)
def test_containers_that_take_a_training_need_not_come_as_near(goal, plain, trained):
    """The smallest figures that end a search."""
    (limit,) = goal_of(**goal).limits
    (value,) = goal.values()
    assert value * 2 ** -limit.near_enough(trained=False) == pytest.approx(plain)
    assert value * 2 ** -limit.near_enough(trained=True) == pytest.approx(trained, rel=0.01)


def test_what_the_user_has_named_is_named_in_errors():
    lost = Attempt(1, 1e-9, 10, **{**SAME, "drop": 0.2, "psnr": 53.36})
    message = goal_of(quality="same", max_psnr_drop=0.01).failure_message([lost], suggest_compaction=False)
    assert message == (
        "max_psnr_drop 0.01 dB cannot be met: the finest container found loses 0.201 dB; allow at least that"
    )
    message = goal_of(quality="good", psnr=55).failure_message([lost], suggest_compaction=False)
    assert message == "psnr 55 dB cannot be met: the finest container found has 53.36 dB; ask for at most that"
    both = replace(lost, ssim_drop=0.01)
    message = goal_of(quality="same", max_psnr_drop=0.01).failure_message([both], suggest_compaction=False)
    assert message.startswith("max_psnr_drop 0.01 dB and quality same cannot be met: ")
