"""Oracle: functions with a known root; size and renderings of the container that a search returns."""

import math
import re

import pytest
from hypothesis import given
from hypothesis import strategies as st

import kissgs
from kissgs import Settings, UnsupportedError
from kissgs.core.root_finding import ATTEMPTS, MAX_EXTRAPOLATION, StopRule, find_root
from kissgs.pipeline.goal import Goal
from kissgs.pipeline.rate_control import LOG2_LAMBDA_RANGE
from kissgs.pipeline.trial import Trial

SCENE = kissgs.sample_scene(1500, sh_degree=1, seed=5)
FEW_VIEWS = {"sensitivity_views": 4, "sensitivity_view_size": 48}
MORE_VIEWS = {"sensitivity_views": 16, "sensitivity_view_size": 96}  # their PSNR is near that of other cameras


class Recorded:
    def __init__(self, function):
        self.function, self.arguments = function, []

    def __call__(self, x):
        self.arguments.append(x)
        return self.function(x)


@given(st.floats(-20, 20), st.floats(0.3, 3), st.sampled_from([-1, 1]), st.floats(-15, 15))
def test_the_root_of_a_bent_line_is_found_in_few_attempts(crossing, steepness, sign, start):
    """Steeper above its root than below, and up to three times as steep as the given slope."""
    margin = Recorded(lambda x: sign * steepness * (x - crossing) * (1.5 if sign * x > sign * crossing else 0.8))
    found = find_root(margin, start, sign * 1.0, 0.1, (-50, 50))
    assert 0 <= margin(found) <= 0.1
    assert len(margin.arguments) <= ATTEMPTS + 1
    assert all(
        abs(after - before) <= MAX_EXTRAPOLATION + 1e-9
        for before, after in zip(margin.arguments, margin.arguments[1:-1], strict=False)
    )


def test_a_staircase():
    """Rounding leaves no value between -0.4 and 0.6; the best attempt is returned."""
    margin = Recorded(lambda x: 0.6 - round(x) if abs(x) < 3 else -x)
    found = find_root(margin, 2.2, -1.0, 0.05, (-9, 9))
    assert margin(found) == pytest.approx(0.6)


def test_a_jump_is_not_searched_further():
    margin = Recorded(lambda x: (1.0 if x < 0.3 else -1.0) - 0.1 * x)
    found = find_root(
        margin, 1.0, -1.0, 0.01, (-9, 9), stop=StopRule(settled=lambda inside, outside: outside - inside < 1 / 32)
    )
    assert found is not None
    assert 0.3 - 1 / 32 < found < 0.3
    assert len(margin.arguments) < ATTEMPTS - 1
    assert find_root(Recorded(margin.function), 1.0, -1.0, 0.01, (-9, 9)) == pytest.approx(0.3, abs=1 / 32)


def test_known_values_are_used():
    margin = Recorded(lambda x: 5.0 - math.exp(x))
    found = find_root(margin, 0.0, -1.0, 0.05, (-9, 9), before={1.7: margin.function(1.7), 1.5: margin.function(1.5)})
    assert found == pytest.approx(math.log(5), abs=0.02)
    assert len(margin.arguments) <= 4
    assert min(margin.arguments[1:]) > 1.5
    assert find_root(margin, 3.0, -1.0, 0.05, (-9, 9), before={1.0: 2.0}, stop=StopRule(attempts=1)) is None


@pytest.mark.parametrize("sign", [-1, 1])
def test_a_root_at_the_bound_is_found(sign):
    """The function is flat over long steps before it jumps."""
    margin = Recorded(lambda x: -1.0 if sign * x < 20 else 30.0 + sign * x)
    found = find_root(margin, 0.0, sign * 1.0, 0.05, (-40, 40))
    assert found is not None
    assert 20 <= sign * found < 30
    assert len(margin.arguments) <= ATTEMPTS


def test_the_bound_is_tried_after_the_last_attempt():
    margin = Recorded(lambda x: -1.0 - x)
    assert find_root(margin, 30.0, -1.0, 0.05, (-40, 40), stop=StopRule(attempts=2)) == -40
    assert margin.arguments == [30.0, 26.0, -40]


@pytest.mark.parametrize("sign", [-1, 1])
def test_a_goal_met_everywhere_ends_at_the_far_bound(sign):
    margin = Recorded(lambda x: 3.0 + 0.01 * sign * x)
    assert find_root(margin, 0.0, sign * 1.0, 0.05, (-40, 40)) == -40 * sign
    assert len(margin.arguments) <= 4


def test_a_fixed_end_of_the_bracket_does_not_slow_the_search():
    """False position alone advances by a tenth of the bracket per step here."""
    margin = Recorded(lambda x: 100.0 if x < 1.3 else -0.1 - 0.01 * x)
    find_root(margin, 8.0, -1.0, 0.05, (-9, 9))
    assert any(abs(x - 1.3) < 0.2 for x in margin.arguments)


def test_infinite_margins_do_not_end_the_search():
    """An infinite margin says nothing about the distance to the goal."""
    margin = Recorded(lambda x: math.inf if x < 6 else 10 - x)
    found = find_root(margin, -3.0, -1.0, 0.1, (-20, 20))
    assert found == pytest.approx(9.95, abs=0.06)
    assert all(math.isfinite(x) for x in margin.arguments)


def test_a_function_that_is_not_quite_monotone():
    """No argument is tried twice."""
    margin = Recorded(lambda x: 0.9 - 0.3 * x if x < 0.1 else -0.1 - 0.02 * (1 - x) if x < 1 else -x)
    found = find_root(margin, 1.0, -1.0, 0.05, (-9, 9))
    assert len(set(margin.arguments)) == len(margin.arguments) > 5
    assert margin(found) >= 0.85


@pytest.mark.parametrize("function", [lambda x: -5.0 - math.exp(-abs(x)), lambda x: min(-x, 40) - 41])
def test_an_unreachable_goal_is_given_up(function):
    """The bound is tried first."""
    margin = Recorded(function)
    assert find_root(margin, 3.0, -1.0, 0.05, (-50, 50)) is None
    assert len(margin.arguments) <= ATTEMPTS + 1
    assert margin.arguments[-1] == -50


def test_bounds_limit_the_search():
    margin = Recorded(lambda x: -20 - x)
    assert find_root(margin, 0.0, -1.0, 0.05, (-7, 7)) is None
    assert min(margin.arguments) == -7
    assert len(margin.arguments) == 3
    margin = Recorded(lambda x: 20 - x)
    assert find_root(margin, 0.0, -1.0, 0.05, (-7, 7)) == 7


@pytest.mark.parametrize("share", [0.7, 1.15])
@pytest.mark.quick(1)
def test_a_target_size_is_met(share):
    plain = kissgs.compress(SCENE, settings=Settings.from_preset("balanced", **FEW_VIEWS))
    wanted = round(share * len(plain.to_zip()))
    found = kissgs.compress(SCENE, settings=Settings.from_preset("balanced", target_size=wanted, **FEW_VIEWS))
    assert 0.97 * wanted <= len(found.to_zip()) <= wanted
    assert found.report.trials[0].bytes == pytest.approx(len(plain.to_zip()), rel=0.01)
    assert len(found.to_zip()) in [trial.bytes for trial in found.report.trials]


@pytest.mark.parametrize("change", [-2.5, 2.0])
@pytest.mark.quick(1)
def test_a_psnr_is_met(change):
    """The search has other cameras than the evaluation, so that their PSNR may differ."""
    plain = kissgs.compress(SCENE, settings=Settings.from_preset("balanced", **MORE_VIEWS), evaluate=True)
    wanted = plain.report.evaluation.mean.candidate_vs_reference.psnr + change
    settings = Settings.from_preset("balanced", psnr=wanted, **MORE_VIEWS)
    found = kissgs.compress(SCENE, settings=settings, evaluate=True)
    made = max((trial for trial in found.report.trials if trial.bytes == len(found.to_zip())), key=lambda t: t.psnr)
    assert made.psnr >= wanted
    assert made.bytes == min(trial.bytes for trial in found.report.trials if trial.psnr >= wanted)
    too_coarse = min(trial.rd_lambda for trial in found.report.trials if trial.psnr < wanted)
    assert made.psnr <= wanted + 0.1 or too_coarse < 1.5 * made.rd_lambda  # near the goal, or at a jump over it
    assert made.worst <= made.fifth_percentile <= made.psnr
    assert abs(found.report.evaluation.mean.candidate_vs_reference.psnr - wanted) < 1.5
    assert found.report.evaluation.mean.candidate_vs_reference.psnr not in [trial.psnr for trial in found.report.trials]
    assert (len(found.to_zip()) > len(plain.to_zip())) == (change > 0)


@pytest.mark.quick(0)
def test_the_reported_lambda_and_codebook_reproduce_the_container():
    found = kissgs.compress(SCENE, settings=Settings.from_preset("small", target_size="40 kB", **FEW_VIEWS))
    made = found.report.settings["encode"]
    same = {
        "rd_lambda": found.report.rd_lambda,
        **{name: made[name] for name in ("gaussians_per_codebook_entry", "sh_codebook_size")},
    }
    again = kissgs.compress(SCENE, settings=Settings.from_preset("small", **same, **FEW_VIEWS))
    assert again.files == found.files


FIXED = kissgs.sample_scene(4000, sh_degree=3, seed=4)


@pytest.mark.quick(0)
def test_a_size_is_met_between_two_sides_of_the_codebook():
    """Sides are multiples of 8; one step of the side is some kB for this scene."""
    found = kissgs.compress(FIXED, settings=Settings.from_preset("balanced", target_size=61_500))
    assert 0.97 * 61_500 <= len(found.to_zip()) <= 61_500


@pytest.mark.quick(0)
def test_the_codebook_grows_for_a_large_target_size():
    """The finest container of this scene with seven Gaussians per entry has 96 kB."""
    found = kissgs.compress(FIXED, settings=Settings.from_preset("balanced", target_size=140_000))
    assert 0.97 * 140_000 <= len(found.to_zip()) <= 140_000
    assert found.report.settings["encode"]["gaussians_per_codebook_entry"] == 1


@pytest.mark.parametrize("degree", [0, 1])
@pytest.mark.quick(1)
def test_a_target_size_above_every_container_takes_two_encodings(degree):
    """Regression: it searched seven sizes, up to the same finest container."""
    scene = kissgs.sample_scene(600, sh_degree=degree, seed=5)
    found = kissgs.compress(scene, settings=Settings.from_preset("balanced", target_size="3MB", **FEW_VIEWS))
    assert [trial.rd_lambda for trial in found.report.trials][1:] == [2.0**-70]
    made = found.report.settings["encode"]["gaussians_per_codebook_entry"]
    finest = {"rd_lambda": 2.0**-70, "gaussians_per_codebook_entry": made}
    again = kissgs.compress(scene, settings=Settings.from_preset("balanced", **finest, **FEW_VIEWS))
    assert again.files == found.files
    assert made == (1 if degree else 7)
    size = len(found.to_zip())
    assert (
        found.report.note == f"target_size 3,000,000 bytes is above the finest container of this scene: {size:,} bytes"
    )


def test_a_target_size_just_above_the_finest_container_is_searched_for():
    """It is below the bound of all containers, so the search itself must find that the finest is the best."""
    few = kissgs.sample_scene(600, sh_degree=0, seed=5)
    finest = kissgs.compress(few, settings=Settings.from_preset("balanced", rd_lambda=2.0**-70, **FEW_VIEWS))
    wanted = round(1.05 * len(finest.to_zip()))
    found = kissgs.compress(few, settings=Settings.from_preset("balanced", target_size=wanted, **FEW_VIEWS))
    assert found.files == finest.files
    assert len(found.report.trials) > 2
    assert "is above the finest container" in found.report.note


@pytest.mark.quick(0)
def test_the_psnr_in_the_error_message_can_be_met():
    few = kissgs.sample_scene(1000, sh_degree=1, seed=2)

    def search(psnr):
        return kissgs.compress(few, settings=Settings.from_preset("balanced", psnr=psnr, **FEW_VIEWS))

    with pytest.raises(UnsupportedError) as refused:
        search(150)
    highest = float(re.search(r"found has (\d+\.\d\d) dB;", str(refused.value))[1])
    assert highest <= max(trial.psnr for trial in search(highest).report.trials) + 0.005
    assert max(trial.psnr for trial in search(highest - 0.3).report.trials) >= highest - 0.3


def test_equal_gaussians_can_meet_a_psnr():
    """The PSNR over lambda is a staircase: the goal is met only after several attempts without gain."""
    equal = kissgs.sample_scene(400, sh_degree=1, seed=3).select([5] * 400)
    found = kissgs.compress(equal, settings=Settings.from_preset("balanced", psnr=30, **FEW_VIEWS))
    assert max(trial.psnr for trial in found.report.trials) >= 30


@pytest.mark.parametrize(
    ("goal", "message"),
    [
        (
            {"psnr": 150},
            r"psnr 150 dB cannot be met: .* has \d+\.\d\d dB; ask for at most that; each view counts for at most",
        ),
        (
            {"target_size": 900},
            r"target_size 900 bytes cannot be met: the smallest container found has [\d,]+; ask for at least",
        ),
    ],
)
@pytest.mark.quick(1)
def test_unreachable_goals_are_refused_and_nothing_is_written(tmp_path, goal, message):
    with pytest.raises(UnsupportedError, match=message):
        kissgs.compress(SCENE, tmp_path / "a.zip", settings=Settings.from_preset("balanced", **goal, **FEW_VIEWS))
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("count", [0, 1, 7])
def test_goals_of_scenes_of_few_gaussians(count):
    few = SCENE.select(range(count))
    for goal in ({"psnr": 20}, {"target_size": "9kB"}):
        found = kissgs.compress(few, settings=Settings.from_preset("balanced", **goal, **FEW_VIEWS))
        assert len(found.to_zip()) < 9000
        assert len(kissgs.decompress(found.files)) <= count


@pytest.mark.parametrize(
    ("preset", "goal", "message"),
    [
        ("fast", {"psnr": 40}, "psnr needs rate_distortion: choose preset balanced or small"),
        ("paper", {"target_size": "3MB"}, "target_size needs rate_distortion"),
        ("balanced", {"psnr": 40, "target_size": "3MB"}, "psnr and target_size cannot both be met; give one"),
        ("balanced", {"psnr": 40, "rd_lambda": 1e-9}, "rd_lambda and psnr cannot both be met"),
        ("balanced", {"psnr": 40, "max_ssim_drop": 0.1}, "psnr and max_ssim_drop cannot both be met; give one"),
        ("balanced", {"target_size": 9000, "max_ssim_drop": 0.1}, "target_size and max_ssim_drop cannot both be met"),
        ("balanced", {"rd_lambda": 1e-9, "max_ssim_drop": 0.1}, "rd_lambda and max_ssim_drop cannot both be met"),
        (
            "balanced",
            {"psnr": 40, "max_psnr_drop": 1, "max_ssim_drop": 0.1},
            "psnr and max_psnr_drop cannot both be met",
        ),
        ("fast", {"max_ssim_drop": 0.1}, "max_ssim_drop needs rate_distortion"),
        ("balanced", {"max_ssim_drop": 0}, "setting max_ssim_drop: input should be greater than 0"),
        ("balanced", {"max_ssim_drop": 1.1}, "setting max_ssim_drop: input should be less than or equal to 1"),
        ("balanced", {"psnr": 0}, "setting psnr: input should be greater than 0"),
        ("balanced", {"target_size": 0}, "setting target_size: input should be greater than or equal to 1"),
        ("balanced", {"target_size": "3 XB"}, "setting target_size: write 800kB, 2.5MB or 2,500,000, not '3 XB'"),
        ("balanced", {"target_size": "3,5MB"}, "not '3,5MB'"),
        ("balanced", {"target_size": "3MB more"}, "not '3MB more'"),
        ("balanced", {"target_size": "2.5"}, "not '2.5'"),
        (
            "balanced",
            {"opacity_step": 0.02},
            "opacity_step has no effect with rate_distortion: set quality_offset_db or rd_lambda",
        ),
    ],
)
def test_invalid_goals_are_refused(preset, goal, message):
    with pytest.raises(UnsupportedError, match=message):
        Settings.from_preset(preset, **goal)


def test_a_search_can_be_cancelled(tmp_path):
    encodings = 0

    def stop(stage, fraction, note=""):
        nonlocal encodings
        encodings += stage == "rate_distortion"
        if encodings == 2:
            raise kissgs.Cancelled

    settings = Settings.from_preset("balanced", target_size="20kB", **FEW_VIEWS)
    with pytest.raises(kissgs.Cancelled):
        kissgs.compress(SCENE, tmp_path / "a.zip", settings=settings, progress=stop)
    assert list(tmp_path.iterdir()) == []


def test_infinity_and_nan_in_json():
    trial = Trial(1, 1e-9, 10, psnr=math.inf, drop=-math.inf, worst=math.nan).as_dict()
    assert (trial["psnr"], trial["drop"], trial["worst"], trial["bytes"]) == (None, None, "NaN", 10)


def test_an_infinite_drop_meets_no_goal():
    goal = Goal.of(Settings.from_preset("balanced", max_psnr_drop=1.0).encode)
    assert goal.margin(Trial(1, 1e-9, 10, drop=math.inf)) == -math.inf


@pytest.mark.parametrize(
    ("drop", "ssim_drop", "met"),
    [(0.1, 0.003, True), (0.11, 0.003, False), (0.1, 0.0031, False), (-1.0, 0.003, True), (0.1, -1.0, True)],
)
def test_of_two_drops_both_must_hold(drop, ssim_drop, met):
    goal = Goal.of(Settings.from_preset("balanced", max_psnr_drop=0.1, max_ssim_drop=0.003).encode)
    assert (goal.margin(Trial(1, 1e-9, 10, drop=drop, ssim_drop=ssim_drop)) >= 0) == met


@pytest.mark.parametrize("drops", [(math.nan, 0.001), (0.05, math.nan), (math.nan, math.nan)])
def test_a_failed_rendering_meets_no_drop(drops):
    goal = Goal.of(Settings.from_preset("balanced", max_psnr_drop=0.1, max_ssim_drop=0.003).encode)
    assert not goal.margin(Trial(1, 1e-9, 10, drop=drops[0], ssim_drop=drops[1])) >= 0


def goal_of(**limits):
    return Goal.of(Settings.from_preset("balanced", **limits).encode)


@pytest.mark.parametrize(
    ("drop", "ssim_drop", "near"),
    [(0.085, 0.001, True), (0.07, 0.001, False), (0.01, 0.0029, True), (0.01, 0.0027, False), (0.07, 0.0027, False)],
)
def test_near_the_limit_that_decides_is_near_enough(drop, ssim_drop, near):
    """Near is 0.02 dB of a drop of PSNR, and 5 % of a drop of SSIM."""
    goal = goal_of(max_psnr_drop=0.1, max_ssim_drop=0.003)
    trial = Trial(1, 1e-9, 10, drop=drop, ssim_drop=ssim_drop)
    assert goal.margin(trial) == pytest.approx(math.log2(min(0.1 / drop, 0.003 / ssim_drop)))
    assert (0 <= goal.margin(trial) <= goal.decisive(trial).near) == near


def model_trial(x, growth, ssim_growth):
    """Return a trial at lambda 2^x whose drops grow exponentially with x."""
    drop, ssim_drop = 0.45 * 2 ** (growth * (x + 34)), 0.0074 * 2 ** (ssim_growth * (x + 34))
    return Trial(1, 2.0**x, 10, drop=drop, ssim_drop=ssim_drop)


def searched(goal, growth, ssim_growth, start):
    """Search in a model of a scene. Return log2(lambda) of all trials, and of the best."""

    def decisive(x):
        return goal.decisive(model_trial(x, growth, ssim_growth))

    margin = Recorded(lambda x: goal.margin(model_trial(x, growth, ssim_growth)))
    found = find_root(margin, start, decisive(start).slope, lambda x: decisive(x).near, LOG2_LAMBDA_RANGE)
    return margin.arguments, found


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
        assert 0 <= decisive.room(model_trial(found, growth, ssim_growth)) <= decisive.near


@pytest.mark.parametrize(
    ("limits", "found", "message"),
    [
        (
            {"max_psnr_drop": 1.0, "max_ssim_drop": 1e-7},
            {"drop": 0.0331, "ssim_drop": 0.00053901},
            "max_ssim_drop 1e-07 cannot be met: the finest container found loses 0.00054 of SSIM; allow at least that",
        ),
        (
            {"max_psnr_drop": 0.01, "max_ssim_drop": 1e-7},
            {"drop": 0.033101, "ssim_drop": 0.000539001},
            "max_psnr_drop 0.01 dB and max_ssim_drop 1e-07 cannot be met: the finest container found loses 0.0332 dB "
            "and 0.00054 of SSIM; allow at least that",
        ),
        (
            {"max_psnr_drop": 0.01, "max_ssim_drop": 0.001},
            {"drop": -0.0201, "ssim_drop": 0.002001},
            "max_ssim_drop 0.001 cannot be met: the finest container found loses 0.00201 of SSIM; allow at least that",
        ),
        (
            {"max_psnr_drop": 0.01},
            {"drop": math.inf},
            "max_psnr_drop 0.01 dB cannot be met: the scene's renderings equal the photographs, so any loss of PSNR is "
            "infinite",
        ),
        *[
            (
                {name: value},
                {figure: math.nan},
                f"{name} {value:g}{unit} cannot be met: a rendering of the finest container found failed, so its "
                "quality is unknown",
            )
            for name, value, figure, unit in [
                ("max_psnr_drop", 0.01, "drop", " dB"),
                ("max_ssim_drop", 0.01, "ssim_drop", ""),
                ("psnr", 40.0, "psnr", " dB"),
            ]
        ],
    ],
)
def test_the_message_names_the_limits_that_are_missed(limits, found, message):
    """Losses are rounded up, so that the one that is named can be met."""
    assert goal_of(**limits).failure_message([Trial(1, 1e-9, 10, **found)], suggest_compaction=False) == message


def test_the_loss_that_is_named_can_be_met():
    trial = Trial(1, 1e-9, 10, drop=0.03, ssim_drop=0.0029999999)
    message = goal_of(max_psnr_drop=0.001, max_ssim_drop=0.001).failure_message([trial], suggest_compaction=False)
    psnr, ssim = re.search("loses (.*) dB and (.*) of SSIM", message).groups()
    assert (psnr, ssim) == ("0.03", "0.003")
    assert goal_of(max_psnr_drop=float(psnr), max_ssim_drop=float(ssim)).margin(trial) >= 0


def test_nothing_lost_is_an_unknown_distance():
    goal = Goal.of(Settings.from_preset("balanced", max_ssim_drop=0.1).encode)
    assert goal.margin(Trial(1, 1e-9, 10, ssim_drop=0.0)) == math.inf


def test_a_trial_names_the_loss_of_ssim_where_it_is_a_goal():
    trial = Trial(1, 1e-9, 812_000, psnr=41.2, drop=0.12, worst=35.1)
    assert trial.summary() == "812 kB at 41.20 dB, drop 0.12 dB, worst view 35.1 dB"
    text = Trial(1, 1e-9, 812_000, psnr=41.2, drop=0.12, ssim_drop=0.00291, worst=35.1).summary()
    assert text == "812 kB at 41.20 dB, drop 0.12 dB, SSIM drop 0.00291, worst view 35.1 dB"
    assert "SSIM drop 2.35e-05" in Trial(1, 1e-9, 812_000, ssim_drop=0.000023456).summary()
