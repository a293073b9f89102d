"""Oracle: photographs and errors made to order; counts that are known to lose little or much."""

import math

import numpy as np
import pytest
from helpers.training_scenes import around, cloud, same
from PIL import Image

import kissgs
from kissgs import CompactSettings, UnsupportedError
from kissgs.cameras.views import View, Views, black
from kissgs.compaction.budget import compact_scene
from kissgs.evaluation.evaluate import evaluate
from kissgs.evaluation.psnr_loss import ASSUMED_PSNR, drop_of
from kissgs.rendering.rasterizer import render

ONLY_PRUNE = {"sparsify_steps": 0, "refine_steps": 0, "min_keep_per_scoring": 0.6}


def views():
    return Views(around(5), around(3), black(), "five views")


def compacted(scene, given=None, **changes):
    return compact_scene(scene, CompactSettings(**{**ONLY_PRUNE, **changes}), given or views())


@pytest.mark.parametrize(("budget", "count"), [({"count": 17}, 17), ({"ratio": 0.3}, 24), ({"ratio": 1e-9}, 1)])
def test_budgets(budget, count):
    assert len(compacted(cloud(80), **budget).splats) == count


@pytest.mark.parametrize("budget", [{"count": 80}, {"count": 10**9}, {"ratio": 1.0}])
def test_a_scene_that_is_small_enough_stays_as_it_is_and_that_is_said(budget):
    scene = cloud(80)
    result = compacted(scene, **budget)
    assert same(result.splats, scene)
    assert (result.index == np.arange(80)).all()
    assert result.report.note == "the scene has 80 Gaussians, no more than asked for: it stays as it is"
    assert result.report.steps == ()


@pytest.mark.parametrize("count", [0, 1])
def test_scenes_of_hardly_anything(count):
    for budget in ({"count": 1}, {"ratio": 0.1}, {"max_psnr_drop": 0.1}):
        assert len(compacted(cloud(count), **budget).splats) == count


def test_without_a_budget_nobody_knows_how_many():
    with pytest.raises(UnsupportedError, match="give count, ratio or max_psnr_drop"):
        compacted(cloud(9))


def test_a_search_keeps_no_checkpoint(tmp_path):
    with pytest.raises(UnsupportedError, match="keeps no checkpoint"):
        compact_scene(cloud(9), CompactSettings(max_psnr_drop=1), views(), checkpoint=tmp_path / "c.npz")


@pytest.mark.parametrize("allowed", [0.05, 0.5, 3.0])
def test_as_few_as_lose_no_more_than_is_allowed(allowed):
    scene = cloud(250)
    result = compacted(scene, max_psnr_drop=allowed)
    judged = evaluate(scene, result.splats, Views((), around(3), black(), ""))
    assert drop_of(judged) <= allowed
    assert (len(result.splats), pytest.approx(drop_of(judged))) in result.report.trials
    assert all(drop > allowed for count, drop in result.report.trials if count < len(result.splats))
    assert 1 < len(result.splats) < 250
    assert len({count for count, _ in result.report.trials}) == len(result.report.trials)


def test_that_a_drop_without_photographs_is_a_model_is_said():
    assert "is estimated for a scene that has 30 dB" in compacted(cloud(60), max_psnr_drop=1).report.note


def test_counts_are_of_the_cleaned_scene():
    scene = cloud(50)
    scene.means[0] = np.nan
    result = kissgs.compact(scene, settings=kissgs.Settings.from_preset("fast", compact={"count": 20}), views=views())
    assert result.report.source_count == 49
    assert result.report.cleaned.non_finite == 1
    assert result.report.as_dict()["cleaned"]["non_finite"] == 1
    assert result.report.cpu_seconds > 0
    assert result.report.peak_memory > 1e7
    assert (result.splats.means == kissgs.clean(scene)[0].means[result.index]).all()


def test_where_nothing_can_go_it_stays_as_it_is():
    scene = cloud(40)
    result = compacted(scene, max_psnr_drop=1e-9)
    assert same(result.splats, scene)
    assert "every smaller one that was tried loses more than 1e-09 dB" in result.report.note
    assert result.report.trials


def test_the_drop_is_that_to_the_photographs(tmp_path):
    scene = cloud(60)
    photographed = []
    for view in around(3):
        picture = np.clip(render(scene, view.camera)[0] * 255 + 0.5, 0, 255).astype(np.uint8)
        Image.fromarray(picture // 2 + 30).save(tmp_path / f"{view.name}.png")
        photographed.append(View(view.name, view.camera, tmp_path / f"{view.name}.png"))
    other = scene.select(slice(0, 30))
    judged = evaluate(scene, other, Views((), tuple(photographed), black(), ""))
    assert drop_of(judged) == judged.mean.reference.psnr - judged.mean.candidate.psnr


def test_without_photographs_errors_add_up_to_those_of_a_usual_capture():
    """Independent noise: of 30 dB in the scene, and as much again, is 3 dB."""
    rng = np.random.default_rng(0)
    truth = np.full((64, 64, 3), 0.5)
    scene, worse = truth + rng.normal(0, 10 ** (-ASSUMED_PSNR / 20), truth.shape), None
    for error in (ASSUMED_PSNR, 40.0, 50.0):
        worse = scene + rng.normal(0, 10 ** (-error / 20), truth.shape)
        psnr = [-10 * math.log10(np.mean((a - b) ** 2)) for a, b in ((scene, truth), (worse, truth), (worse, scene))]
        told = evaluation_of(psnr[2])
        assert drop_of(told) == pytest.approx(psnr[0] - psnr[1], abs=0.1)
    assert drop_of(evaluation_of(math.inf)) == pytest.approx(0, abs=1e-9)


def evaluation_of(psnr):
    judged = evaluate(cloud(5), cloud(5), Views((), around(1), black(), ""))
    likeness = kissgs.evaluation.results.ImageMetrics(psnr=psnr, ssim=1.0)
    comparison = kissgs.evaluation.results.Comparison(
        reference=None, candidate=likeness, candidate_vs_reference=likeness
    )
    (view,) = judged.views
    changed = kissgs.evaluation.results.ViewComparison(view=view.view, comparison=comparison)
    return kissgs.evaluation.results.Evaluation(
        **{name: getattr(judged, name) for name in judged.__slots__ if name != "views"}, views=(changed,)
    )
