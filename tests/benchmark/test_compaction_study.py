"""Oracle: the ways called by themselves; for plots, that they are drawn and can be read."""

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from helpers.training_scenes import around, cloud
from PIL import Image

from kissgs import CompactSettings, InvalidSceneError, UnsupportedError
from kissgs.benchmark.compaction_study import WAYS, study
from kissgs.benchmark.plots import check_plot, compaction_plot
from kissgs.cameras.views import Views, black
from kissgs.cli.bench_curves import compaction
from kissgs.cli.bench_scenes import Asked

SHORT = CompactSettings(sparsify_steps=6, refine_steps=6, prune_rounds=2, synthetic_view_share=0)


@pytest.fixture(scope="module")
def points():
    return study(cloud(80), SHORT, Views(around(5), around(3), black(), "five views"), ratios=[0.5, 0.2])


def test_all_ways_at_all_ratios(points):
    first, *others = points
    assert (first.way, first.count, first.psnr) == ("input", 80, math.inf)
    assert [(point.way, point.count) for point in others] == [(way.name, count) for way in WAYS for count in (40, 16)]
    assert all(0 < point.psnr < 100 and 0 < point.bytes < first.bytes for point in others)


def test_who_is_best_is_left(points):
    """Scores beat chance, and training beats none."""
    psnr = {point.way: point.psnr for point in points if point.count == 16}
    assert psnr["random"] < psnr["POP in rounds"] < psnr["POP in rounds + refine"]
    assert psnr["opacity"] < psnr["opacity + refine"]


@pytest.mark.parametrize("learn_from", ["photos", "cameras", "scene"])
def test_who_judges_does_not_depend_on_what_is_learned_from(tmp_path, learn_from):
    """Photographs are black here: what learned from them shows it."""
    black_photo = tmp_path / "black.png"
    Image.new("RGB", (24, 24)).save(black_photo)
    taken = [tuple(replace(view, photo=black_photo) for view in views) for views in (around(5), around(3))]
    views = Views(*taken, black(), "five views")
    short = SHORT.model_copy(update={"views": 16, "view_size": 24})
    (refined,) = [way for way in WAYS if way.name == "POP + refine"]
    before, after = study(cloud(80), short, views, ratios=[0.5], ways=[refined], learn_from=learn_from)
    (blank,) = study(cloud(80), short, views, ratios=[], ways=[])
    assert before.psnr == blank.psnr
    unheld = replace(views, train=views.test, test=())
    (seen,) = study(cloud(80), short, unheld, ratios=[], ways=[], learn_from=learn_from)
    assert seen.psnr == blank.psnr, "where no view is held out, those to learn from judge"
    (cut,) = [way for way in WAYS if way.name == "POP"]
    pruned = study(cloud(80), short, views, ratios=[0.5], ways=[cut], learn_from=learn_from)[-1]
    assert (after.psnr > pruned.psnr + 1) == (learn_from == "photos")


def test_names_mean_the_same_whatever_the_settings():
    """The preset's own rounds and shares change nothing; without steps, ways that train are left out."""
    scene, views = cloud(80), Views(around(5), around(3), black(), "five views")
    usual = study(scene, SHORT, views, ratios=[0.3])
    other = SHORT.model_copy(
        update={"prune_rounds": 7, "min_keep_per_scoring": 0.3, "admm_rho": 0.1, "erank_weight": 1.0}
    )
    assert [point.psnr for point in study(scene, other, views, ratios=[0.3])] == [point.psnr for point in usual]
    none = SHORT.model_copy(update={"sparsify_steps": 0, "refine_steps": 0})
    ways = [point.way for point in study(scene, none, views, ratios=[0.3])]
    assert ways == ["input", "random", "opacity", "POP", "POP in rounds"]


def test_an_empty_scene_is_refused():
    with pytest.raises(InvalidSceneError, match="has no Gaussians"):
        study(cloud(1).select(slice(0)), SHORT)


def test_a_plot_of_nothing_finite_is_drawn(tmp_path, points):
    compaction_plot([replace(point, psnr=math.inf) for point in points], tmp_path / "p.svg")
    assert (tmp_path / "p.svg").exists()


def test_nobodys_cameras_cannot_be_learned_from():
    for message, options in (
        ("say whose with --views", {"learn_from": "cameras"}),
        ("choose photos, cameras or scene", {"learn_from": "books"}),
        ("--ratio 0 keeps nothing", {"ratios": [0.5, 0.0]}),
        ("there is no way 'mine'; there are: random; opacity; ", {"ways": ["mine"]}),
    ):
        with pytest.raises(UnsupportedError, match=message):
            compaction(Asked(scenes=[Path("x.ply")], presets=["fast"], **options))


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


def test_what_cannot_be_drawn_is_said_before_the_work(tmp_path):
    with pytest.raises(UnsupportedError, match="plots are svg, png, pdf"):
        check_plot(tmp_path / "plot.jpg")
