"""Oracle: size and renderings of the container that a search returns."""

import pytest

import kissgs
from kissgs import Settings, UnsupportedError

SCENE = kissgs.sample_scene(1500, sh_degree=1, seed=5)
UNTRAINED = {"finetune": {"enabled": False}}
FEW_VIEWS = {"sensitivity_views": 4, "sensitivity_view_size": 48, **UNTRAINED}
MORE_VIEWS = {"sensitivity_views": 16, "sensitivity_view_size": 96}  # their PSNR is near that of other cameras


@pytest.mark.parametrize("share", [0.7, 1.15])
@pytest.mark.quick(1)
def test_a_target_size_is_met(share):
    plain = kissgs.compress(SCENE, settings=Settings.research("balanced", **FEW_VIEWS))
    wanted = round(share * len(plain.to_zip()))
    found = kissgs.compress(SCENE, settings=Settings.research("balanced", target_size=wanted, **FEW_VIEWS))
    assert 0.97 * wanted <= len(found.to_zip()) <= wanted
    assert found.report.trials[0].bytes == pytest.approx(len(plain.to_zip()), rel=0.01)
    assert len(found.to_zip()) in [trial.bytes for trial in found.report.trials]


@pytest.mark.parametrize("wanted", [38.0, 33.0])
@pytest.mark.quick(1)
def test_a_psnr_is_met(wanted):
    """The search has other cameras than the evaluation, so that their PSNR may differ."""
    settings = Settings.research("balanced", psnr=wanted, **MORE_VIEWS)
    found = kissgs.compress(SCENE, settings=settings, evaluate=True)
    made = max((trial for trial in found.report.trials if trial.bytes == len(found.to_zip())), key=lambda t: t.psnr)
    assert made.psnr >= wanted
    assert made.bytes == min(trial.bytes for trial in found.report.trials if trial.psnr >= wanted)
    too_coarse = min(trial.rd_lambda for trial in found.report.trials if trial.psnr < wanted)
    assert made.psnr <= wanted + 0.1 or too_coarse < 1.5 * made.rd_lambda  # near the goal, or at a jump over it
    assert made.worst <= made.fifth_percentile <= made.psnr
    assert abs(found.report.evaluation.mean.candidate_vs_reference.psnr - wanted) < 1.5
    assert found.report.evaluation.mean.candidate_vs_reference.psnr not in [trial.psnr for trial in found.report.trials]


@pytest.mark.quick(0)
def test_the_codebook_grows_for_a_large_target_size():
    scene = kissgs.sample_scene(4000, sh_degree=3, seed=4)
    found = kissgs.compress(scene, settings=Settings.research("balanced", target_size=140_000, **UNTRAINED))
    assert 0.97 * 140_000 <= len(found.to_zip()) <= 140_000


@pytest.mark.parametrize("degree", [0, 1])
@pytest.mark.quick(1)
def test_a_target_size_above_every_container_takes_two_encodings(degree):
    """Regression: it searched seven sizes, up to the same finest container."""
    scene = kissgs.sample_scene(600, sh_degree=degree, seed=5)
    found = kissgs.compress(scene, settings=Settings.research("balanced", target_size="3MB", **FEW_VIEWS))
    assert [trial.rd_lambda for trial in found.report.trials][1:] == [2.0**-70]
    again = kissgs.compress(scene, settings=Settings.research("balanced", rd_lambda=2.0**-70, **FEW_VIEWS))
    assert again.files == found.files
    size = len(found.to_zip())
    assert (
        found.report.note == f"target_size 3,000,000 bytes is above the finest container of this scene: {size:,} bytes"
    )


def test_a_target_size_just_above_the_finest_container_is_searched_for():
    """It is below the bound of all containers, so the search itself must find that the finest is the best."""
    few = kissgs.sample_scene(600, sh_degree=0, seed=5)
    finest = kissgs.compress(few, settings=Settings.research("balanced", rd_lambda=2.0**-70, **FEW_VIEWS))
    wanted = round(1.05 * len(finest.to_zip()))
    found = kissgs.compress(few, settings=Settings.research("balanced", target_size=wanted, **FEW_VIEWS))
    assert found.files == finest.files
    assert len(found.report.trials) > 2
    assert "is above the finest container" in found.report.note


@pytest.mark.quick(0)
def test_equal_gaussians_can_meet_a_psnr():
    """The PSNR over lambda is a staircase: the goal is met only after several attempts without gain."""
    equal = kissgs.sample_scene(400, sh_degree=1, seed=3).select([5] * 400)
    found = kissgs.compress(equal, settings=Settings.research("balanced", psnr=30, **FEW_VIEWS))
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
@pytest.mark.quick(0)
def test_unreachable_goals_are_refused_and_nothing_is_written(tmp_path, goal, message):
    with pytest.raises(UnsupportedError, match=message):
        kissgs.compress(SCENE, tmp_path / "a.zip", settings=Settings.research("balanced", **goal, **FEW_VIEWS))
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("preset", "goal", "message"),
    [
        ("fast", {"psnr": 40}, "psnr needs rate_distortion: choose preset balanced"),
        ("paper", {"target_size": "3MB"}, "target_size needs rate_distortion"),
        ("balanced", {"psnr": 40, "rd_lambda": 1e-9}, "rd_lambda and psnr cannot both be met"),
        ("balanced", {"rd_lambda": 1e-9, "max_ssim_drop": 0.1}, "rd_lambda and max_ssim_drop cannot both be met"),
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
        Settings.research(preset, **goal)


def test_a_search_can_be_cancelled(tmp_path):
    encodings = 0

    def stop(stage, fraction, note=""):
        nonlocal encodings
        encodings += stage == "rate_distortion"
        if encodings == 2:
            raise kissgs.Cancelled

    settings = Settings.research("balanced", target_size="20kB", **FEW_VIEWS)
    with pytest.raises(kissgs.Cancelled):
        kissgs.compress(SCENE, tmp_path / "a.zip", settings=settings, progress=stop)
    assert list(tmp_path.iterdir()) == []
