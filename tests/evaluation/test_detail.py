"""Changes of SSIM in patches. Oracles: SSIM by SciPy, patches cut out here one by one, and sorting."""

import json
import math

import numpy as np
import pytest
from helpers.captured_scene import SCENE, cameras, damaged, rendered_view, write_capture
from helpers.evaluations import compared, evaluation_with, metrics
from helpers.reference_ssim import similarities
from hypothesis import given
from hypothesis import strategies as st

from kissgs.cameras.captures.load import load_views
from kissgs.evaluation.evaluate import compare_images, evaluate
from kissgs.evaluation.results import Detail

SIZE = (100, 70)
WORSE = damaged()
CHANGES = st.floats(-2, 2) | st.sampled_from([0.0, -0.05, -0.05000001])


def patches_of(image, target):
    """Return the mean SSIM of each patch of an image of 100x70 pixels: the last take the remainders, 6 and 36."""
    pixels = similarities(image, target)
    return np.array([[part.mean() for part in np.split(row, (32, 64), axis=1)] for row in np.split(pixels, (32,))])


def assert_changes(found, views, expected):
    for each, changes in zip(found.views, expected, strict=True):
        np.testing.assert_allclose(each.patch_changes, changes, atol=2e-6)
    everything = sorted(change for view in found.views for change in view.patch_changes.ravel().tolist())
    assert len(found.views) == len(views)
    assert found.detail.worst == everything[0] < -0.05
    assert found.detail.share_below == pytest.approx(sum(change < -0.05 for change in everything) / len(everything))


def test_without_photographs_patches_are_compared_with_the_reference():
    views = cameras(size=SIZE)
    pairs = [[rendered_view(scene, view) for scene in (WORSE, SCENE)] for view in views.test]
    assert_changes(compare_images(SCENE, WORSE, views), views.test, [patches_of(*pair) - 1 for pair in pairs])


def test_with_photographs_it_is_the_change_to_the_held_out_ones(tmp_path):
    views = load_views(write_capture(tmp_path / "capture", size=SIZE))
    found = evaluate(SCENE, WORSE, views)
    (view,) = views.test
    photo = view.load_photo() / 255
    before, after = (patches_of(rendered_view(scene, view), photo) for scene in (SCENE, WORSE))
    assert_changes(found, views.test, [after - before])
    assert found.surroundings.detail == evaluate(SCENE, WORSE).detail


def test_equal_and_empty_scenes_lose_nothing(tmp_path):
    views, none = load_views(write_capture(tmp_path / "capture", size=SIZE)), SCENE.select(slice(0, 0))
    for scene in (SCENE, none):
        assert compare_images(scene, scene, views).detail == Detail(0.0, 0.0, 0.0)
    assert compare_images(SCENE, none, cameras(size=(20, 9))).detail.share_below == 1


@given(st.lists(st.lists(CHANGES, min_size=1, max_size=90), min_size=1, max_size=9))
def test_the_figures_are_those_of_sorted_patches(views):
    found = Detail.of([np.array(view)[None] for view in views])
    ordered = sorted(change for view in views for change in view)
    count = next(n for n in range(1, len(ordered) + 1) if 100 * n >= len(ordered))
    assert found.worst == ordered[0]
    assert found.worst_percent == pytest.approx(sum(ordered[:count]) / count)
    assert found.share_below == pytest.approx(sum(change < -0.05 for change in ordered) / len(ordered))


def test_the_figures_are_in_text_and_json():
    row = compared(metrics(30), metrics(29), metrics(35))
    changes = [np.array([[-0.124, 0.01], [-0.03, 0.0]]), np.full((1, 1), -0.05)]
    found = evaluation_with([row, row], changes)
    said = "SSIM to photographs in patches of 32x32 pixels: -0.1240 in the worst 1 %, -0.1240 in the worst one, 20.00 %"
    assert said in found.extremes
    figures = {"worst": -0.124, "worst_percent": -0.124, "share_below": 0.2}
    assert json.loads(json.dumps(found.as_dict(), allow_nan=False))["detail"] == figures
    found = evaluation_with([compared(None, metrics(29), metrics(29))])
    assert "SSIM to the reference in patches of 32x32 pixels: +0.0000" in found.extremes


def test_a_failed_rendering_is_not_hidden():
    row = compared(None, metrics(math.nan), metrics(math.nan))
    found = evaluation_with([row, row], [np.array([[-0.1, math.nan]]), np.zeros((1, 1))])
    assert json.loads(json.dumps(found.as_dict(), allow_nan=False))["detail"] == dict.fromkeys(
        ("worst", "worst_percent", "share_below"), "NaN"
    )
    assert "NaN in the worst 1 %" in found.extremes
