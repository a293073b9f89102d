"""Evaluation of scenes. Oracle: renderings and photographs compared here by the textbook formulas; fox's README."""

import json
import math
from dataclasses import replace

import numpy as np
import pytest
from helpers.captured_scene import SCENE, cameras, damaged, rendered_view, write_capture
from helpers.evaluations import compared, evaluation_of, evaluation_with, metrics
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image

import kissgs
from kissgs.cameras.captures.load import load_views
from kissgs.cameras.views import View, Views
from kissgs.core.context import Context
from kissgs.core.errors import Cancelled, InvalidViewsError, UnsupportedError
from kissgs.core.splats import ATTRIBUTES, Splats
from kissgs.evaluation import evaluate as evaluation_module
from kissgs.evaluation.cameras import evaluation_views
from kissgs.evaluation.evaluate import compare_images, evaluate
from kissgs.evaluation.results import ImageMetrics, format_metric
from kissgs.evaluation.scene_parts import share_shown
from kissgs.rendering.camera import look_at
from kissgs.rendering.metrics import ms_ssim, ssim
from kissgs.rendering.rasterizer import render

WORSE = damaged()


def decibels(image, target):
    return -10 * math.log10(np.mean((image.astype(np.float64) - target) ** 2))


def photo_of(view):
    with Image.open(view.photo) as image:
        return np.asarray(image.convert("RGB")).astype(np.float32) / 255


def assert_metrics(found, image, target):
    assert found.psnr == pytest.approx(decibels(image, target), abs=1e-5)
    assert found.ssim == pytest.approx(ssim(image, target), abs=1e-7)
    assert found.ms_ssim == pytest.approx(ms_ssim(image, target), abs=1e-7)
    assert found.lpips is None


@pytest.fixture(scope="module")
def capture(tmp_path_factory):
    return load_views(write_capture(tmp_path_factory.mktemp("photos") / "capture"))


def test_without_photographs_renderings_are_compared():
    views = cameras(background=(0.2, 0.5, 1))
    found = evaluate(SCENE, WORSE, views)
    assert (found.against, found.split, found.source) == ("renderings", "test", "cameras by hand")
    assert [each.view for each in found.views] == list(views.test)
    for each in found.views:
        pair = [rendered_view(scene, each.view, (0.2, 0.5, 1)) for scene in (WORSE, SCENE)]
        assert_metrics(each.comparison.candidate_vs_reference, *pair)
        assert each.comparison.candidate == each.comparison.candidate_vs_reference
        assert each.comparison.reference is None
        assert each.comparison.change is None


def test_photographs_are_the_targets_if_there_are_any(capture):
    found = evaluate(SCENE, WORSE, capture, split="all")
    assert (found.against, found.split) == ("photos", "all")
    assert [each.view.name for each in found.views] == ["images/a.png", "images/b.png", "images/c.png"]
    for each in found.views:
        before, after, photo = rendered_view(SCENE, each.view), rendered_view(WORSE, each.view), photo_of(each.view)
        assert_metrics(each.comparison.reference, before, photo)
        assert_metrics(each.comparison.candidate, after, photo)
        assert_metrics(each.comparison.candidate_vs_reference, after, before)
        assert each.comparison.change == pytest.approx(decibels(after, photo) - decibels(before, photo), abs=1e-5)
        assert each.comparison.change < 0


def test_equal_scenes_have_infinite_psnr(capture):
    few = SCENE.select(slice(0, 50))
    found = evaluate(few, few, capture, split="train")
    assert found.mean.candidate_vs_reference == ImageMetrics(psnr=math.inf, ssim=1.0, ms_ssim=1.0)
    assert found.mean.change == 0
    report = json.loads(json.dumps(found.as_dict(), allow_nan=False))
    assert report["mean"]["candidate_vs_reference"] == {"psnr": None, "ssim": 1.0, "ms_ssim": 1.0}


def test_the_json_has_the_documented_layout(capture):
    found = evaluate(SCENE, WORSE.select(slice(0, 900)), capture)
    report = json.loads(json.dumps(found.as_dict(), allow_nan=False))
    assert report["against"] == "photos"
    assert report["split"] == "test"
    assert report["source"] == capture.source
    assert report["count"] == {"reference": 1500, "candidate": 900}
    (view,) = report["views"]
    assert (view["name"], view["width"], view["height"]) == ("images/a.png", 60, 40)
    assert report["mean"] == {side: view[side] for side in ("reference", "candidate", "candidate_vs_reference")}
    assert set(view["reference"]) == {"psnr", "ssim", "ms_ssim"}
    without = compare_images(SCENE, WORSE, cameras()).as_dict()
    assert without["mean"]["reference"] is None
    assert without["mean"]["candidate"] == without["mean"]["candidate_vs_reference"]


def test_scenes_may_differ_in_length_and_need_cleaning():
    """A Gaussian with NaN is removed instead of spoiling the image."""
    arrays = {name: getattr(SCENE, name).copy() for name in ATTRIBUTES}
    arrays["means"][3] = np.nan
    arrays["quats"][5] *= 4
    found = evaluate(Splats(**arrays), SCENE.select(slice(0, 0)), cameras(test=1))
    assert (found.reference_count, found.candidate_count) == (1499, 0)
    assert 0 < found.mean.candidate_vs_reference.psnr < 40


def test_results_do_not_depend_on_threads():
    few = SCENE.select(slice(0, 300))
    one, other = (evaluate(few, WORSE, cameras(), threads=threads).as_dict() for threads in (1, 3))
    assert one == other


def test_drawn_cameras_are_the_default_and_evaluate_the_surroundings_of_a_capture(capture):
    alone, views = evaluate(SCENE, WORSE, seed=3), evaluation_views(SCENE, seed=3)
    assert (alone.against, alone.split, alone.source) == ("renderings", "all", "drawn over the whole scene, seed 3")
    assert alone.surroundings is None
    compared = compare_images(SCENE, WORSE, views)
    assert [each.comparison for each in alone.views] == [each.comparison for each in compared.views]
    assert alone.shown == share_shown(SCENE, [view.camera for view in views.test])
    found = evaluate(SCENE, WORSE, capture, seed=3)
    assert found.against == "photos"
    assert found.surroundings.as_dict() == alone.as_dict()
    assert [each.comparison for each in found.views] == [
        each.comparison for each in compare_images(SCENE, WORSE, capture).views
    ]


def test_views_use_their_own_background_or_the_common_one():
    views = cameras(test=2, background=(1, 0, 0))
    white = replace(views.test[1], background=np.ones(3, np.float32))
    found = compare_images(SCENE, WORSE, replace(views, test=(views.test[0], white)))
    for each, background in zip(found.views, ((1, 0, 0), (1, 1, 1)), strict=True):
        pair = [rendered_view(scene, each.view, background) for scene in (WORSE, SCENE)]
        assert_metrics(each.comparison.candidate_vs_reference, *pair)


def test_the_reference_is_rendered_once(monkeypatch):
    reference_images, rendered = {}, []
    first = compare_images(SCENE, WORSE, cameras(), reference_images=reference_images)
    monkeypatch.setattr(
        evaluation_module, "render", lambda *args, **options: rendered.append(args[0]) or render(*args, **options)
    )
    again = compare_images(SCENE, WORSE, cameras(), reference_images=reference_images)
    assert first.as_dict() == again.as_dict()
    assert len(rendered) == len(reference_images) == 3
    assert all((scene.sh0 == WORSE.sh0).all() for scene in rendered)


@pytest.mark.quick(0)
def test_fox_has_the_metrics_of_its_readme(shared_data):
    scene = kissgs.load(shared_data / "fox" / "point_cloud.ply")
    found = evaluate(scene, scene, load_views(shared_data / "fox", scale=4))
    assert len(found.views) == 7
    assert found.mean.reference.psnr == pytest.approx(32.09, abs=0.1)
    assert found.mean.reference.ssim == pytest.approx(0.913, abs=0.002)
    each = [view.comparison.reference.psnr for view in found.views]
    assert each == pytest.approx([34.7, 33.0, 33.2, 29.0, 33.3, 32.7, 28.6], abs=0.1)
    assert found.mean.candidate_vs_reference.psnr == math.inf


# --- Splits ---------------------------------------------------------------------------------------


def test_each_split_evaluates_its_views():
    views, few = cameras(test=2, train=3), SCENE.select(slice(0, 50))
    for split, wanted in (("test", views.test), ("train", views.train), ("all", views.test + views.train)):
        found = evaluate(few, few, views, split=split)
        assert (found.split, [each.view for each in found.views]) == (split, list(wanted))
    found = evaluate(few, few, cameras(test=0, train=2))  # training views replace missing test views
    assert (found.split, len(found.views), found.views_used) == ("train", 2, "2 training cameras")


def test_empty_splits_are_rejected():
    with pytest.raises(InvalidViewsError, match="the split 'train' of cameras by hand is empty"):
        evaluate(SCENE, SCENE, cameras(test=2, train=0), split="train")
    for split in ("test", "all"):
        with pytest.raises(InvalidViewsError, match="there is no view to evaluate from"):
            evaluate(SCENE, SCENE, cameras(test=0, train=0), split=split)
    with pytest.raises(UnsupportedError, match="there is no split 'val'; choose test, train or all"):
        evaluation_module._select_split(cameras(), "val")


def test_photographs_of_only_some_views_are_rejected(capture):
    """Otherwise the results of a part would look like those of the whole."""
    mixed = Views(capture.train, cameras(test=1).test, capture.background, "a mixture")
    with pytest.raises(InvalidViewsError, match="1 of 3 views have no photograph, the first is 'view_00'; give all"):
        evaluate(SCENE, SCENE, mixed, split="all")


def test_missing_photographs_are_an_error(tmp_path):
    views = load_views(write_capture(tmp_path / "capture"))
    views.test[0].photo.unlink()
    with pytest.raises(InvalidViewsError, match="there is no such file"):
        evaluate(SCENE, SCENE, views)


# --- Progress, LPIPS, CUDA ------------------------------------------------------------------------


def test_progress_is_reported_and_can_cancel():
    events = []
    context = Context(progress=lambda stage, fraction: events.append((stage, fraction)))
    compare_images(SCENE, SCENE, cameras(test=4), context)
    assert [fraction for stage, fraction in events if stage == "evaluate"] == [0, 0.25, 0.5, 0.75, 1]
    assert {stage for stage, _ in events} == {"kernels", "evaluate"}
    events.clear()
    evaluate(SCENE, SCENE, cameras(test=4), progress=context.progress)
    fractions = [fraction for stage, fraction in events if stage == "evaluate"]
    assert len(fractions) == 30  # with that of the end
    assert fractions == sorted(fractions)
    assert fractions[-1] == 1.0
    assert list(dict.fromkeys(stage for stage, _ in events)) == ["kernels", "cameras", "evaluate"]

    def stop(stage, fraction):
        if stage == "evaluate" and fraction >= 0.5:
            raise Cancelled("enough")

    with pytest.raises(Cancelled, match="enough"):
        evaluate(SCENE, SCENE, cameras(test=4), progress=stop)


def test_flip_and_lpips_are_measured_on_request(monkeypatch, capture):
    monkeypatch.setattr(evaluation_module, "Flip", lambda: lambda image, target: float(np.abs(image - target).mean()))
    monkeypatch.setattr(
        evaluation_module, "Lpips", lambda device: lambda image, target: float(np.abs(image - target).max())
    )
    found = evaluate(SCENE, WORSE, cameras(), flip=True, lpips=True)
    each = [np.abs(rendered_view(WORSE, view) - rendered_view(SCENE, view)) for view in cameras().test]
    assert found.mean.candidate_vs_reference.lpips == pytest.approx(np.mean([image.max() for image in each]))
    assert found.mean.candidate_vs_reference.flip == pytest.approx(np.mean([image.mean() for image in each]))
    assert set(found.as_dict()["mean"]["candidate_vs_reference"]) == {"psnr", "ssim", "ms_ssim", "flip", "lpips"}


def test_missing_cuda_is_an_error():
    import torch

    if torch.cuda.is_available():
        pytest.skip("this machine has CUDA")
    with pytest.raises(UnsupportedError, match="torch finds no CUDA device"):
        evaluate(SCENE.select(slice(0, 9)), SCENE, cameras(), device="cuda")


# --- Metrics --------------------------------------------------------------------------------------


def test_a_failed_rendering_is_not_hidden(monkeypatch):
    def fail_once(splats, camera, **options):
        image = np.full((camera.height, camera.width, 3), 0.5, np.float32)
        if camera is views.test[1].camera and len(splats) == 900:
            image[3, 4, 1] = np.nan
        return image, image[..., 0]

    views = cameras()
    monkeypatch.setattr(evaluation_module, "render", fail_once)
    found = evaluate(SCENE, SCENE.select(slice(0, 900)), views)
    report = json.loads(json.dumps(found.as_dict(), allow_nan=False))
    assert [view["candidate_vs_reference"]["psnr"] for view in report["views"]] == [None, "NaN", None]
    assert report["mean"]["candidate_vs_reference"] == {"psnr": "NaN", "ssim": "NaN", "ms_ssim": "NaN"}


PSNRS = st.floats(0, 100) | st.sampled_from([math.inf, math.nan])


@given(st.lists(st.tuples(PSNRS, PSNRS, PSNRS), min_size=1, max_size=5))
def test_any_metrics_are_averaged_and_valid_json(psnrs):
    found = evaluation_with([compared(*(metrics(psnr, n / 5) for psnr in row)) for n, row in enumerate(psnrs)])
    report = json.loads(json.dumps(found.as_dict(), allow_nan=False))
    for i, side in enumerate(("reference", "candidate", "candidate_vs_reference")):
        column = [row[i] for row in psnrs]
        mean = None if set(column) == {math.inf} else pytest.approx(np.mean(np.minimum(column, 60)))
        assert report["mean"][side]["psnr"] == ("NaN" if any(map(math.isnan, column)) else mean)
        assert report["mean"][side]["ssim"] == pytest.approx((len(psnrs) - 1) / 10)
        assert report["mean"][side]["ms_ssim"] == pytest.approx(0.5)
    assert all(len(each.comparison.cells()) == 10 for each in found.views)
    assert all(each.comparison.change == 0 for each, (a, b, _) in zip(found.views, psnrs, strict=True) if a == b)


@given(st.lists(PSNRS, min_size=1, max_size=45))
def test_the_worst_view_and_the_fifth_percentile(psnrs):
    """Oracle: sorting, and NumPy's percentile where all is finite."""
    found = evaluation_of(psnrs)
    camera = found.views[0].view.camera
    failed = [number for number, value in enumerate(psnrs) if math.isnan(value)]
    assert int(found.worst.view.name) == (failed[0] if failed else psnrs.index(min(psnrs)))
    report = json.loads(json.dumps(found.as_dict(), allow_nan=False))
    assert report["worst"]["name"] == found.worst.view.name
    assert report["worst"]["position"] == camera.position.tolist()
    assert report["worst"]["target"] is None
    if failed:
        assert math.isnan(found.fifth_percentile)
    elif all(map(math.isfinite, psnrs)):
        assert found.fifth_percentile == pytest.approx(np.percentile(psnrs, 5))
    else:
        assert min(psnrs) <= found.fifth_percentile
    assert "worst view" in found.extremes


@pytest.mark.parametrize(
    ("value", "signed", "text"),
    [
        (31.456, False, "31.46"),
        (-0.001, True, "+0.00"),
        (-0.5, True, "-0.50"),
        (math.inf, True, "∞"),
        (math.nan, 0, "NaN"),
    ],
)
def test_values_are_formatted(value, signed, text):
    assert format_metric(value, 2, signed=bool(signed)) == text


def test_empty_images_are_noted() -> None:
    """Both images are black: the scene is 1e12 world units away, beyond what renderers draw."""
    scene = kissgs.sample_scene(50, sh_degree=0)
    away = Splats(**{name: getattr(scene, name) + (1e12 if name == "means" else 0) for name in ATTRIBUTES})
    assert "mean nothing" in evaluate(away, scene, looking_away()).note
    assert evaluate(scene.select(slice(0)), scene, looking_away()).note == ""
    assert evaluate(scene, scene).note == ""


def looking_away() -> Views:
    camera = look_at(
        np.array([0.0, 0, -99]), np.array([0.0, 0, -200]), np.array([0.0, -1, 0]), fov=1, width=9, height=8
    )
    return Views((), (View("away", camera),), np.zeros(3, np.float32), "one camera")
