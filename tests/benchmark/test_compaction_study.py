"""Relations between strategies that are known; plots are files of the right format that are not blank."""

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from helpers.training_scenes import around, cloud
from PIL import Image

from kissgs import CompactSettings, InvalidSceneError, UnsupportedError
from kissgs.benchmark.compaction_study import STRATEGIES, compare_strategies
from kissgs.benchmark.plots import check_plot, compaction_plot
from kissgs.cameras.views import Views, black
from kissgs.cli.bench_curves import compaction
from kissgs.cli.bench_scenes import BenchInputs

SHORT = CompactSettings(sparsify_steps=6, refine_steps=6, prune_rounds=2, synthetic_view_share=0)


@pytest.fixture(scope="module")
def points():
    return compare_strategies(cloud(80), SHORT, Views(around(5), around(3), black(), "five views"), ratios=[0.5, 0.2])


@pytest.mark.quick(0)
def test_all_strategies_at_all_ratios(points):
    first, *others = points
    assert (first.strategy, first.count, first.psnr) == ("input", 80, math.inf)
    assert [(point.strategy, point.count) for point in others] == [
        (strategy.name, count) for strategy in STRATEGIES for count in (40, 16)
    ]
    assert all(0 < point.psnr < 100 and 0 < point.bytes < first.bytes for point in others)


@pytest.mark.quick(0)
def test_scores_are_better_than_chance_and_training_better_than_none(points):
    psnr = {point.strategy: point.psnr for point in points if point.count == 16}
    assert psnr["random"] < psnr["POP in rounds"] < psnr["POP in rounds + refine"]
    assert psnr["opacity"] < psnr["opacity + refine"]


@pytest.mark.parametrize("supervision", ["photos", "cameras", "scene"])
@pytest.mark.quick(1)
def test_evaluation_views_do_not_depend_on_the_supervision(tmp_path, supervision):
    """Photographs are black here, so that only training with them improves the PSNR to them."""
    black_photo = tmp_path / "black.png"
    Image.new("RGB", (24, 24)).save(black_photo)
    taken = [tuple(replace(view, photo=black_photo) for view in views) for views in (around(5), around(3))]
    views = Views(*taken, black(), "five views")
    short = SHORT.model_copy(update={"views": 16, "view_size": 24})
    (refined,) = [strategy for strategy in STRATEGIES if strategy.name == "POP + refine"]
    before, after = compare_strategies(
        cloud(80), short, views, ratios=[0.5], strategies=[refined], supervision=supervision
    )
    (blank,) = compare_strategies(cloud(80), short, views, ratios=[], strategies=[])
    assert before.psnr == blank.psnr
    not_held_out = replace(views, train=views.test, test=())
    (without_held_out,) = compare_strategies(
        cloud(80), short, not_held_out, ratios=[], strategies=[], supervision=supervision
    )
    assert without_held_out.psnr == blank.psnr, "without held-out views, the training views evaluate"
    (pruning,) = [strategy for strategy in STRATEGIES if strategy.name == "POP"]
    pruned = compare_strategies(cloud(80), short, views, ratios=[0.5], strategies=[pruning], supervision=supervision)[
        -1
    ]
    assert (after.psnr > pruned.psnr + 1) == (supervision == "photos")


@pytest.mark.quick(0)
def test_settings_that_a_strategy_fixes_have_no_effect():
    """Without training steps, strategies that train are left out."""
    scene, views = cloud(80), Views(around(5), around(3), black(), "five views")

    def psnrs(strategies=STRATEGIES, **changes):
        settings = SHORT.model_copy(update=changes)
        found = compare_strategies(scene, settings, views, ratios=[0.3], strategies=strategies)
        return {point.strategy: point.psnr for point in found}

    usual = psnrs()
    assert psnrs(prune_rounds=7, min_keep_per_scoring=0.3, admm_rho=0.1) == usual
    along = [strategy for strategy in STRATEGIES if strategy.training == "along"]
    found = psnrs(along, prune_rounds=7, min_keep_per_scoring=0.3, admm_rho=0.1, erank_weight=1.0)
    assert found == {name: usual[name] for name in found}
    assert len(found) == 1 + len(along)
    no_steps = SHORT.model_copy(update={"sparsify_steps": 0, "refine_steps": 0})
    names = [point.strategy for point in compare_strategies(scene, no_steps, views, ratios=[0.3])]
    assert names == ["input", "random", "opacity", "POP", "POP in rounds", "merge"]


def test_an_empty_scene_is_refused():
    with pytest.raises(InvalidSceneError, match="has no Gaussians"):
        compare_strategies(cloud(1).select(slice(0)), SHORT)


@pytest.mark.quick(0)
def test_a_plot_without_finite_values_is_drawn(tmp_path, points):
    compaction_plot([replace(point, psnr=math.inf) for point in points], tmp_path / "p.svg")
    assert (tmp_path / "p.svg").exists()


def test_invalid_options_are_refused():
    for message, options in (
        ("needs a capture; give one with --views", {"supervision": "cameras"}),
        ("choose photos, cameras or scene", {"supervision": "books"}),
        ("--ratio 0 keeps no Gaussian", {"ratios": [0.5, 0.0]}),
        ("unknown strategy; choose one of: random; opacity; ", {"strategies": ["mine"]}),
    ):
        with pytest.raises(UnsupportedError, match=message):
            compaction(BenchInputs(scenes=[Path("x.ply")]), preset="fast", **options)


@pytest.mark.parametrize("kind", ["png", "svg", "pdf"])
def test_the_plot_is_drawn(tmp_path, points, kind):
    path = tmp_path / f"plot.{kind}"
    compaction_plot(points, path)
    data = path.read_bytes()
    assert data.startswith({"png": b"\x89PNG", "svg": b"<?xml", "pdf": b"%PDF"}[kind])
    if kind == "png":
        assert np.asarray(Image.open(path).convert("L")).std() > 10
    compaction_plot(points, path)
    assert path.read_bytes() == data


def test_an_unknown_plot_format_is_refused(tmp_path):
    with pytest.raises(UnsupportedError, match=r"ends in \.svg, \.png or \.pdf"):
        check_plot(tmp_path / "plot.jpg")
