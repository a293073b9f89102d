"""Budgets. Oracle: synthetic photographs and errors of known size; an evaluation of the result."""

import math

import numpy as np
import pytest
from helpers.evaluations import evaluation_of
from helpers.training_scenes import around, cloud, same

import kissgs
from kissgs import CompactSettings, Settings, UnsupportedError
from kissgs.cameras.views import Views, black
from kissgs.compaction.budget import compact_scene
from kissgs.evaluation.evaluate import compare_images
from kissgs.evaluation.results import ASSUMED_PSNR, drop_of

ONLY_PRUNE = {"sparsify_steps": 0, "refine_steps": 0, "min_keep_per_scoring": 0.6}


def views():
    return Views(around(5), around(3), black(), "five views")


def compacted(scene, given=None, **changes):
    return compact_scene(scene, CompactSettings(**{**ONLY_PRUNE, **changes}), given or views())


@pytest.mark.parametrize(("budget", "count"), [({"count": 17}, 17), ({"ratio": 0.3}, 24), ({"ratio": 1e-9}, 1)])
def test_the_result_has_the_count_of_the_budget(budget, count):
    assert len(compacted(cloud(80), **budget).splats) == count


@pytest.mark.parametrize("budget", [{"count": 80}, {"count": 10**9}, {"ratio": 1.0}])
def test_a_scene_within_the_budget_is_unchanged_and_the_note_says_so(budget):
    scene = cloud(80)
    result = compacted(scene, **budget)
    assert same(result.splats, scene)
    assert (result.index == np.arange(80)).all()
    assert result.report.note == "the scene has 80 Gaussians, no more than requested: it is unchanged"
    assert result.report.steps == ()


@pytest.mark.parametrize("budget", [{"count": 99}, {"ratio": 1.0}])
def test_preset_paper_trains_a_scene_within_the_budget(budget):
    scene, steps = cloud(80), {"sparsify_steps": 2, "refine_steps": 2}
    chosen = Settings.research("paper", compact={**steps, **budget}).compact
    found = compact_scene(scene, chosen, views())
    assert [(step.name, step.count) for step in found.report.steps[-2:]] == [("sparsify", 80), ("refine", 80)]
    assert (found.index == np.arange(80)).all()
    assert not same(found.splats, scene)
    none = compact_scene(scene.select(slice(0)), chosen, views())
    assert len(none.splats) == 0
    assert "it is unchanged" in none.report.note


@pytest.mark.parametrize("count", [0, 1])
def test_scenes_of_no_and_one_gaussian(count):
    for budget in ({"count": 1}, {"ratio": 0.1}, {"max_psnr_drop": 0.1}):
        assert len(compacted(cloud(count), **budget).splats) == count


@pytest.mark.parametrize("allowed", [0.5, 0.05, 3.0])
@pytest.mark.quick(1)
def test_the_search_finds_the_smallest_count_tried_that_meets_the_drop(allowed):
    scene = cloud(250)
    result = compacted(scene, max_psnr_drop=allowed)
    evaluation = compare_images(scene, result.splats, Views((), around(3), black(), ""))
    assert drop_of(evaluation) <= allowed
    drops = {trial.count: trial.drop for trial in result.report.trials}
    assert drops[len(result.splats)] == pytest.approx(drop_of(evaluation))
    assert all(drop > allowed for count, drop in drops.items() if count < len(result.splats))
    assert 1 < len(result.splats) < 250
    assert len(drops) == len(result.report.trials)


def test_the_note_says_that_a_drop_without_photographs_is_estimated():
    assert "is estimated for a scene that has 30 dB" in compacted(cloud(60), max_psnr_drop=1).report.note


def test_counts_exclude_gaussians_removed_by_cleaning():
    scene = cloud(50)
    scene.means[0] = np.nan
    result = kissgs.compact(
        scene, settings=kissgs.Settings.from_preset("fast", compact={"count": 20, "method": "prune"}), views=views()
    )
    assert result.report.source_count == 49
    assert result.report.cleaned.non_finite == 1
    assert result.report.as_dict()["cleaned"]["non_finite"] == 1
    assert result.report.cpu_seconds > 0
    assert result.report.peak_memory > 1e7
    assert (result.splats.means == kissgs.clean(scene)[0].means[result.index]).all()


def test_the_scene_is_unchanged_if_every_count_tried_loses_too_much():
    scene = cloud(40)
    result = compacted(scene, max_psnr_drop=1e-9)
    assert same(result.splats, scene)
    assert "every smaller count that was tried loses more than 1e-09 dB" in result.report.note
    assert result.report.trials


def test_without_photographs_the_drop_assumes_errors_of_a_usual_capture():
    """Independent errors add up: a scene of 30 dB loses 3 dB by as large an error again."""
    rng = np.random.default_rng(0)
    truth = np.full((64, 64, 3), 0.5)
    scene, worse = truth + rng.normal(0, 10 ** (-ASSUMED_PSNR / 20), truth.shape), None
    for error in (ASSUMED_PSNR, 40.0, 50.0):
        worse = scene + rng.normal(0, 10 ** (-error / 20), truth.shape)
        psnr = [-10 * math.log10(np.mean((a - b) ** 2)) for a, b in ((scene, truth), (worse, truth), (worse, scene))]
        evaluation = evaluation_of([psnr[2]])
        assert drop_of(evaluation) == pytest.approx(psnr[0] - psnr[1], abs=0.1)
    assert drop_of(evaluation_of([math.inf])) == pytest.approx(0, abs=1e-9)


def test_a_missing_budget_is_rejected():
    with pytest.raises(
        UnsupportedError, match="missing the number of Gaussians to keep: give count, ratio or max_psnr_drop"
    ):
        compacted(cloud(9))


def test_a_search_with_a_checkpoint_is_rejected(tmp_path):
    with pytest.raises(UnsupportedError, match="keeps no checkpoint"):
        compact_scene(cloud(9), CompactSettings(max_psnr_drop=1), views(), checkpoint=tmp_path / "c.npz")
