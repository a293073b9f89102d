"""Goals of a bare scene, which its renderings serve. Oracle: the encoder alone, from cameras that nothing else uses."""

from dataclasses import replace

import numpy as np
import pytest
from helpers.photographed import FEW_VIEWS

import kissgs
from kissgs import Settings
from kissgs.cameras.views import Views
from kissgs.cameras.virtual.samples import random_poses
from kissgs.core.splats import ATTRIBUTES, Splats
from kissgs.evaluation.evaluate import compare_images

VIEWS = {"views": 48, "view_size": 160}
NEEDED = kissgs.sample_scene(400, sh_degree=1, seed=7)


def with_faint(scene):
    """Return a scene with as many faint Gaussians, elsewhere among those of the scene."""
    rng = np.random.default_rng(3)
    shift = np.exp(scene.scales) * rng.standard_normal(scene.means.shape)
    faint = replace(
        scene,
        means=(scene.means + shift).astype(np.float32),
        opacities=rng.uniform(-2.5, -1.5, scene.opacities.shape).astype(np.float32),
    )
    both = {name: np.concatenate([getattr(scene, name), getattr(faint, name)]) for name in ATTRIBUTES}
    return Splats(**both)


FEW = with_faint(NEEDED.select(np.arange(100)))
SMALL, LARGE = with_faint(NEEDED), with_faint(kissgs.sample_scene(3000, sh_degree=0, seed=7))


def settings(tunes=True, steps=200, **goal):
    finetune = {"enabled": tunes, "steps": steps, **VIEWS}
    return Settings.research("balanced", compact=VIEWS, finetune=finetune, **FEW_VIEWS, **goal)


def psnr(found, scene):
    """Return the mean PSNR to the scene's renderings, decibels, from poses of a seed that nothing else has."""
    poses = random_poses(scene, side=96, count=24, seed=999)
    views = Views((), (*poses.train, *poses.test), poses.background, "")
    return compare_images(scene, kissgs.decompress(found.files), views).mean.candidate_vs_reference.psnr


@pytest.mark.quick(0)
def test_fewer_gaussians_are_trained_for_a_loss():
    trained, alone = (kissgs.compress(SMALL, settings=settings(tunes, max_psnr_drop=0.5)) for tunes in (True, False))
    for found in (trained, alone):
        kept = [trial for trial in found.report.trials if trial.bytes == len(found.to_zip())]
        assert any(trial.drop <= 0.5 for trial in kept)
    assert trained.report.finetuning.target_source == "renderings"
    assert trained.report.compaction.count == 512
    assert "it is unchanged" not in trained.report.compaction.note
    assert len(trained.to_zip()) < 0.97 * len(alone.to_zip())


@pytest.mark.quick(0)
def test_a_size_is_better_used_with_training():
    plain = kissgs.compress(LARGE, settings=settings(tunes=False))
    wanted = round(0.6 * len(plain.to_zip()))
    trained, alone = (kissgs.compress(LARGE, settings=settings(tunes, target_size=wanted)) for tunes in (True, False))
    assert max(len(trained.to_zip()), len(alone.to_zip())) <= wanted
    assert psnr(trained, LARGE) > psnr(alone, LARGE) + 1.5


@pytest.mark.parametrize(("units", "trained"), [(1e6, True), (10, False)])
@pytest.mark.quick(0)
def test_a_limited_time_trains_if_it_is_long(monkeypatch, units, trained):
    monkeypatch.setattr("kissgs.pipeline.limited_time.encode_seconds", lambda *found: 1e5 / units)
    chosen = settings(steps=20, max_psnr_drop=0.5).model_copy(update={"time_limit": 1e5})
    report = kissgs.compress(SMALL, settings=chosen).report
    assert any(trial.count < len(SMALL) for trial in report.trials) == trained
    if not trained:
        assert "too little time to train a smaller number" in report.compaction.note


@pytest.mark.parametrize("goal", [{"max_psnr_drop": 0.5}, {"quality": "good"}])
@pytest.mark.quick(0)
def test_a_loss_that_is_estimated_is_called_so_once(goal):
    """Regression: not where the encoder alone searched."""
    alone = {"compact": {"auto_count": False}, "finetune": {"enabled": False}}
    few = {"sensitivity_views": 16, "sensitivity_view_size": 96}
    for changes in (alone, {"finetune": {"enabled": False}}):
        report = kissgs.compress(SMALL, settings=kissgs.Settings.research("balanced", **goal, **changes, **few)).report
        notes = report.note + ("" if report.compaction is None else report.compaction.note)
        assert notes.count("the drop of PSNR is estimated for a scene that has 30 dB") == 1


@pytest.mark.quick(0)
def test_the_reported_settings_give_the_same_bytes_for_any_number_of_threads():
    found = kissgs.compress(FEW, settings=settings(steps=20, max_ssim_drop=0.05), threads=1)
    assert any(trial.count < len(FEW) for trial in found.report.trials)
    again = kissgs.compress(FEW, settings=Settings.model_validate(found.report.settings), threads=2)
    assert again.files == found.files


def test_ctrl_c_keeps_the_container_of_the_encoder():
    """Pressed in the first training, when containers of the encoder alone exist."""
    stopped = []

    def stop(stage, fraction, note=""):
        if stage == "finetune" and not stopped:
            stopped.append(stage)
            raise kissgs.StopSearch

    found = kissgs.compress(FEW, settings=settings(steps=20, max_psnr_drop=0.5), progress=stop)
    assert stopped
    assert found.report.finetuning is None
    met = [trial.bytes for trial in found.report.trials if trial.drop <= 0.5]
    assert len(found.to_zip()) == min(met)


@pytest.mark.parametrize("count", [7, 2, 1, 0])
@pytest.mark.parametrize(
    "goal", [{"max_psnr_drop": 1.0}, {"max_ssim_drop": 0.05}, {"target_size": "6kB"}, {"psnr": 20.0}]
)
@pytest.mark.quick(1)
def test_few_gaussians(count, goal):
    few = SMALL.select(np.arange(count))
    found = kissgs.compress(few, settings=settings(steps=3, **goal))
    assert len(kissgs.decompress(found.files)) <= count


@pytest.mark.quick(0)
def test_fewer_gaussians_are_no_worse_where_all_are_needed():
    """How many are kept may differ between processors: containers of a few bytes more or less fit the size, or not."""
    wanted = round(0.7 * len(kissgs.compress(NEEDED, settings=settings(tunes=False)).to_zip()))
    trained, alone = (kissgs.compress(NEEDED, settings=settings(tunes, target_size=wanted)) for tunes in (True, False))
    assert len(trained.to_zip()) <= wanted
    assert psnr(trained, NEEDED) >= psnr(alone, NEEDED) - 0.1
