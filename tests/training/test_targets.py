"""Oracle: the photographs and renderings themselves; for the order, counting."""

from collections import Counter
from dataclasses import replace
from itertools import islice

import numpy as np
import pytest
from helpers.training_scenes import around, cloud, targets_of
from PIL import Image

from kissgs.cameras.views import View, black
from kissgs.rendering.rasterizer import render
from kissgs.training.targets import training_targets


def test_without_photographs_the_scene_itself_is_the_teacher():
    scene, views = cloud(), around(3)
    found = training_targets(scene, views, np.float32([0.2, 0.4, 0.6]))
    assert found.target_source == "renderings"
    assert len(found) == 3
    for n, view in enumerate(views):
        image, _ = render(scene, view.camera, background=(0.2, 0.4, 0.6))
        assert found.picture(n).dtype == np.float32
        np.testing.assert_allclose(found.picture(n), np.clip(image, 0, 1), atol=3e-4)


def test_photographs_are_what_is_learned_where_there_are_any(tmp_path):
    pictures = np.random.default_rng(0).integers(0, 256, (2, 32, 40, 3), dtype=np.uint8)
    views = []
    for n, (view, picture) in enumerate(zip(around(2), pictures, strict=True)):
        Image.fromarray(picture).save(tmp_path / f"{n}.png")
        views.append(View(view.name, view.camera, tmp_path / f"{n}.png"))
    found = training_targets(cloud(), views, black())
    assert found.target_source == "photos"
    np.testing.assert_array_equal(found.picture(1), pictures[1].astype(np.float32) / np.float32(255))
    mixed = training_targets(cloud(), [views[0], around(2)[1]], black())
    assert mixed.target_source == "photos"
    np.testing.assert_array_equal(mixed.picture(0), found.picture(0))
    np.testing.assert_array_equal(mixed.picture(1), targets_of(cloud(), around(2)).picture(1))


@pytest.mark.parametrize("first", [0, 1, 3, 4, 9])
def test_the_order_can_be_taken_up_anywhere(first):
    found = targets_of(cloud())
    whole = list(islice(found.order((7,)), 40))
    assert list(islice(found.order((7,), first), 40 - first)) == whole[first:]


def test_every_view_comes_once_in_every_round():
    found = targets_of(cloud())
    steps = list(islice(found.order((0, 1)), 20))
    assert all(Counter(steps[n : n + 4]) == Counter(range(4)) for n in range(0, 20, 4))
    assert steps != list(islice(found.order((0, 2)), 20))
    assert len({tuple(steps[n : n + 4]) for n in range(0, 20, 4)}) > 1


def test_the_extent_is_that_of_the_cameras():
    """A circle of radius 3: in INRIA's code, 1.1 times the largest distance from the mean."""
    assert targets_of(cloud()).extent == pytest.approx(3.3)


def test_the_reach_of_each_object_is_that_of_the_cameras_about_it():
    """Two objects, one at a hundredth of the size, far from each other."""

    def smaller(view):
        pose = view.camera.viewmat.copy()
        pose[:3, 3] = -pose[:3, :3] @ (0.01 * view.camera.position + (50, 0, 0))
        return View(view.name, replace(view.camera, viewmat=pose))

    small = [smaller(view) for view in around(12)]
    found = training_targets(cloud(), [*around(12), *small], black())
    alone = training_targets(cloud(), around(12), black())
    means = cloud(30).means
    reach = found.reach(np.concatenate([means, means * np.float32(0.01) + np.float32([50, 0, 0])]), found.extent)
    assert found.extent > 20
    np.testing.assert_allclose(reach[:30], alone.reach(means, found.extent), rtol=1e-6)
    np.testing.assert_allclose(reach[30:], 0.01 * reach[:30], rtol=1e-3)
    assert (reach[:30] > 0.5 * alone.extent).all()


def test_the_reach_is_never_nothing_and_never_more_than_it_may_be():
    found = training_targets(cloud(), around(3), black())
    places = np.concatenate([[camera.position for camera in found.cameras], [[1e6, 0, 0]]]).astype(np.float32)
    reach = found.reach(places, 2.0)
    assert (reach > 0).all()
    assert reach[-1] == 2.0
    assert found.reach(places[:0], 2.0).shape == (0,)
