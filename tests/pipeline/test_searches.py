"""Oracle: functions whose crossing is known, and the size and the pictures of what a search returns."""

import math
import re

import pytest
from hypothesis import given
from hypothesis import strategies as st

import kissgs
from kissgs import Settings, UnsupportedError
from kissgs.core.root_finding import ATTEMPTS, REACH, find_root
from kissgs.pipeline.rate_control import Goal
from kissgs.pipeline.trial import Trial

SCENE = kissgs.sample_scene(1500, sh_degree=1, seed=5)
GLANCE = {"sensitivity_views": 4, "sensitivity_view_size": 48}


class Counted:
    def __init__(self, function):
        self.function, self.asked = function, []

    def __call__(self, x):
        self.asked.append(x)
        return self.function(x)


@given(st.floats(-20, 20), st.floats(0.3, 3), st.sampled_from([-1, 1]), st.floats(-15, 15))
def test_a_bent_line_is_met_in_few_attempts(crossing, steepness, sign, start):
    """Steeper above its crossing than below, and up to three times as steep as announced."""
    spare = Counted(lambda x: sign * steepness * (x - crossing) * (1.5 if sign * x > sign * crossing else 0.8))
    found = find_root(spare, start, sign * 1.0, 0.1, (-50, 50))
    assert 0 <= spare(found) <= 0.1
    assert len(spare.asked) <= ATTEMPTS + 1
    assert all(
        abs(after - before) <= REACH + 1e-9 for before, after in zip(spare.asked, spare.asked[1:-1], strict=False)
    )


def test_steps_are_lived_with():
    """What rounding gives: nothing between 0.4 below and 0.6 above; the best of what was tried is returned."""
    spare = Counted(lambda x: 0.6 - round(x) if abs(x) < 3 else -x)
    found = find_root(spare, 2.2, -1.0, 0.05, (-9, 9))
    assert spare(found) == pytest.approx(0.6)


def test_a_jump_is_not_looked_into_any_finer():
    spare = Counted(lambda x: (1.0 if x < 0.3 else -1.0) - 0.1 * x)
    found = find_root(spare, 1.0, -1.0, 0.01, (-9, 9), settled=lambda inside, outside: outside - inside < 1 / 32)
    assert found is not None
    assert 0.3 - 1 / 32 < found < 0.3
    assert len(spare.asked) < ATTEMPTS - 1
    assert find_root(Counted(spare.function), 1.0, -1.0, 0.01, (-9, 9)) == pytest.approx(0.3, abs=1 / 32)


def test_what_is_known_need_not_be_asked_for_again():
    spare = Counted(lambda x: 5.0 - math.exp(x))
    found = find_root(spare, 0.0, -1.0, 0.05, (-9, 9), before={1.7: spare.function(1.7), 1.5: spare.function(1.5)})
    assert found == pytest.approx(math.log(5), abs=0.02)
    assert len(spare.asked) <= 4
    assert min(spare.asked[1:]) > 1.5
    assert find_root(spare, 3.0, -1.0, 0.05, (-9, 9), before={1.0: 2.0}, attempts=1) is None


@pytest.mark.parametrize("sign", [-1, 1])
def test_what_is_met_at_the_bound_is_found(sign):
    """A staircase: long ways lead nowhere, and then they do."""
    spare = Counted(lambda x: -1.0 if sign * x < 20 else 30.0 + sign * x)
    found = find_root(spare, 0.0, sign * 1.0, 0.05, (-40, 40))
    assert found is not None
    assert 20 <= sign * found < 30
    assert len(spare.asked) <= ATTEMPTS


def test_the_bound_is_tried_when_attempts_are_over():
    spare = Counted(lambda x: -1.0 - x)
    assert find_root(spare, 30.0, -1.0, 0.05, (-40, 40), attempts=2) == -40
    assert spare.asked == [30.0, 26.0, -40]


@pytest.mark.parametrize("sign", [-1, 1])
def test_what_is_met_everywhere_is_met_at_the_far_bound(sign):
    spare = Counted(lambda x: 3.0 + 0.01 * sign * x)
    assert find_root(spare, 0.0, sign * 1.0, 0.05, (-40, 40)) == -40 * sign
    assert len(spare.asked) <= 4


def test_a_stale_end_does_not_make_it_creep():
    """False position alone goes a tenth of the way at each step here."""
    spare = Counted(lambda x: 100.0 if x < 1.3 else -0.1 - 0.01 * x)
    find_root(spare, 8.0, -1.0, 0.05, (-9, 9))
    assert any(abs(x - 1.3) < 0.2 for x in spare.asked)


def test_where_nothing_is_lost_the_search_goes_on():
    """Outcomes that tell no distance from the goal are no valley's floor."""
    spare = Counted(lambda x: math.inf if x < 6 else 10 - x)
    found = find_root(spare, -3.0, -1.0, 0.1, (-20, 20))
    assert found == pytest.approx(9.95, abs=0.06)
    assert all(math.isfinite(x) for x in spare.asked)


def test_it_goes_on_where_nearer_attempts_are_no_better():
    """A function that is not quite monotone: the same place is not tried twice."""
    spare = Counted(lambda x: 0.9 - 0.3 * x if x < 0.1 else -0.1 - 0.02 * (1 - x) if x < 1 else -x)
    found = find_root(spare, 1.0, -1.0, 0.05, (-9, 9))
    assert len(set(spare.asked)) == len(spare.asked) > 5
    assert spare(found) >= 0.85


@pytest.mark.parametrize("function", [lambda x: -5.0 - math.exp(-abs(x)), lambda x: min(-x, 40) - 41])
def test_what_cannot_be_met_is_given_up(function):
    """But not before the bound was tried."""
    spare = Counted(function)
    assert find_root(spare, 3.0, -1.0, 0.05, (-50, 50)) is None
    assert len(spare.asked) <= ATTEMPTS + 1
    assert spare.asked[-1] == -50


def test_bounds_are_kept_and_end_the_search():
    spare = Counted(lambda x: -20 - x)
    assert find_root(spare, 0.0, -1.0, 0.05, (-7, 7)) is None
    assert min(spare.asked) == -7
    assert len(spare.asked) == 3
    spare = Counted(lambda x: 20 - x)
    assert find_root(spare, 0.0, -1.0, 0.05, (-7, 7)) == 7


@pytest.mark.parametrize("share", [0.7, 1.15])
def test_a_size_is_met_from_below(share):
    plain = kissgs.compress(SCENE, settings=Settings.from_preset("balanced", **GLANCE))
    wanted = round(share * len(plain.to_zip()))
    found = kissgs.compress(SCENE, settings=Settings.from_preset("balanced", target_size=wanted, **GLANCE))
    assert 0.97 * wanted <= len(found.to_zip()) <= wanted
    assert found.report.trials[0].bytes == pytest.approx(len(plain.to_zip()), rel=0.01)
    assert len(found.to_zip()) in [trial.bytes for trial in found.report.trials]


@pytest.mark.parametrize("change", [-2.5, 2.0])
def test_a_psnr_is_met_from_above(change):
    """From cameras that the search has drawn; those of evaluate are others, and need not find the very same."""
    plain = kissgs.compress(SCENE, settings=Settings.from_preset("balanced", **GLANCE), evaluate=True)
    wanted = plain.report.evaluation.mean.candidate_vs_reference.psnr + change
    settings = Settings.from_preset("balanced", psnr=wanted, **GLANCE)
    found = kissgs.compress(SCENE, settings=settings, evaluate=True)
    made = max((trial for trial in found.report.trials if trial.bytes == len(found.to_zip())), key=lambda t: t.psnr)
    assert made.psnr >= wanted
    assert made.bytes == min(trial.bytes for trial in found.report.trials if trial.psnr >= wanted)
    assert (
        min(trial.rd_lambda for trial in found.report.trials if trial.psnr < wanted) < 1.5 * made.rd_lambda
    )  # jumps exist
    assert made.worst <= made.fifth_percentile <= made.psnr
    assert abs(found.report.evaluation.mean.candidate_vs_reference.psnr - wanted) < 2.5
    assert found.report.evaluation.mean.candidate_vs_reference.psnr not in [trial.psnr for trial in found.report.trials]
    assert (len(found.to_zip()) > len(plain.to_zip())) == (change > 0)


def test_the_price_and_the_codebook_that_were_found_give_the_same_container():
    found = kissgs.compress(SCENE, settings=Settings.from_preset("small", target_size="40 kB", **GLANCE))
    made = found.report.settings["encode"]
    same = {
        "rd_lambda": found.report.rd_lambda,
        **{name: made[name] for name in ("gaussians_per_codebook_entry", "sh_codebook_size")},
    }
    again = kissgs.compress(SCENE, settings=Settings.from_preset("small", **same, **GLANCE))
    assert again.files == found.files


FIXED = kissgs.sample_scene(4000, sh_degree=3, seed=4)


def test_a_size_is_met_between_two_sides_of_the_codebook():
    """Sides are multiples of 8, and each is worth some kB on this scene."""
    found = kissgs.compress(FIXED, settings=Settings.from_preset("balanced", target_size=61_500))
    assert 0.97 * 61_500 <= len(found.to_zip()) <= 61_500


def test_a_codebook_grows_where_there_is_room():
    """Seven Gaussians to an entry: so bounded, this scene takes 96 kB at the finest."""
    found = kissgs.compress(FIXED, settings=Settings.from_preset("balanced", target_size=140_000))
    assert 0.97 * 140_000 <= len(found.to_zip()) <= 140_000
    assert found.report.settings["encode"]["gaussians_per_codebook_entry"] == 1


def test_what_is_told_to_be_the_finest_can_be_asked_for():
    few = kissgs.sample_scene(1000, sh_degree=1, seed=2)

    def sought(psnr):
        return kissgs.compress(few, settings=Settings.from_preset("balanced", psnr=psnr, **GLANCE))

    with pytest.raises(UnsupportedError) as refused:
        sought(150)
    told = float(re.search(r"the finest has (\d+\.\d\d);", str(refused.value))[1])
    assert told <= max(trial.psnr for trial in sought(told).report.trials) + 0.005
    assert max(trial.psnr for trial in sought(told - 0.3).report.trials) >= told - 0.3


def test_equal_gaussians_have_a_psnr_like_any_others():
    """Their quality is a staircase: the goal is met far beyond where many attempts gain nothing."""
    equal = kissgs.sample_scene(400, sh_degree=1, seed=3).select([5] * 400)
    found = kissgs.compress(equal, settings=Settings.from_preset("balanced", psnr=30, **GLANCE))
    assert max(trial.psnr for trial in found.report.trials) >= 30


@pytest.mark.parametrize(
    ("goal", "told"),
    [
        (
            {"psnr": 150},
            r"no container .* has 150 dB, the finest has \d+\.\d\d; ask for no more than that; views count for at most",
        ),
        ({"target_size": 900}, r"no container .* has at most 900 bytes, the smallest has [\d,]+; ask for no less"),
    ],
)
def test_goals_out_of_reach_are_refused_and_nothing_is_written(tmp_path, goal, told):
    with pytest.raises(UnsupportedError, match=told):
        kissgs.compress(SCENE, tmp_path / "a.zip", settings=Settings.from_preset("balanced", **goal, **GLANCE))
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("count", [0, 1, 7])
def test_hardly_anything_can_have_a_goal(count):
    few = SCENE.select(range(count))
    for goal in ({"psnr": 20}, {"target_size": "9kB"}):
        found = kissgs.compress(few, settings=Settings.from_preset("balanced", **goal, **GLANCE))
        assert len(found.to_zip()) < 9000
        assert len(kissgs.decompress(found.files)) <= count


@pytest.mark.parametrize(
    ("preset", "goal", "told"),
    [
        ("fast", {"psnr": 40}, "psnr needs bits that are weighed: choose balanced or small"),
        ("paper", {"target_size": "3MB"}, "target_size needs bits that are weighed"),
        ("balanced", {"psnr": 40, "target_size": "3MB"}, "psnr and target_size cannot both be met; give one"),
        ("balanced", {"psnr": 40, "rd_lambda": 1e-9}, "rd_lambda and psnr cannot both be met"),
        ("balanced", {"psnr": 0}, "setting psnr: input should be greater than 0"),
        ("balanced", {"target_size": 0}, "setting target_size: input should be greater than or equal to 1"),
        ("balanced", {"target_size": "3 XB"}, "setting target_size: write 800kB, 2.5MB or 2,500,000, not '3 XB'"),
        ("balanced", {"target_size": "3,5MB"}, "not '3,5MB'"),
        ("balanced", {"target_size": "3MB more"}, "not '3MB more'"),
        ("balanced", {"target_size": "2.5"}, "not '2.5'"),
        (
            "balanced",
            {"opacity_step": 0.02},
            "opacity_step has no effect where bits are weighed: set quality_offset_db or rd_lambda",
        ),
    ],
)
def test_goals_that_make_no_sense_are_refused(preset, goal, told):
    with pytest.raises(UnsupportedError, match=told):
        Settings.from_preset(preset, **goal)


def test_a_search_can_be_stopped(tmp_path):
    encodings = 0

    def stop(stage, fraction, note=""):
        nonlocal encodings
        encodings += stage == "rate_distortion"
        if encodings == 2:
            raise kissgs.Cancelled

    settings = Settings.from_preset("balanced", target_size="20kB", **GLANCE)
    with pytest.raises(kissgs.Cancelled):
        kissgs.compress(SCENE, tmp_path / "a.zip", settings=settings, progress=stop)
    assert list(tmp_path.iterdir()) == []


def test_what_has_no_number_in_json_is_spelled():
    told = Trial(1, 1e-9, 10, psnr=math.inf, drop=-math.inf, worst=math.nan).as_dict()
    assert (told["psnr"], told["drop"], told["worst"], told["bytes"]) == (None, None, "NaN", 10)


def test_a_loss_without_bound_meets_no_goal():
    goal = Goal.of(Settings.from_preset("balanced", max_psnr_drop=1.0).encode)
    assert goal.margin(Trial(1, 1e-9, 10, drop=math.inf)) == -math.inf
