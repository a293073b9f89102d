"""Training targets. Oracle: the photographs and renderings themselves; for the order, counting."""

from collections import Counter
from dataclasses import replace
from itertools import islice

import numpy as np
import pytest
from helpers.training_scenes import around, cloud, targets_of
from PIL import Image

from kissgs.cameras.views import View, Views, black
from kissgs.rendering.rasterizer import render
from kissgs.training.supervision import evaluation_only


def test_without_photographs_the_targets_are_renderings_before_the_background_of_each_view():
    own = replace(around(1)[0], background=np.float32([0.5, 1.0, 0.0]))
    found = targets_of(cloud(), (own, *around(3)[1:]), np.float32([0.2, 0.4, 0.6]))
    assert found.target_source == "renderings"
    assert len(found) == 3
    for n, background in enumerate([(0.5, 1.0, 0.0), (0.2, 0.4, 0.6), (0.2, 0.4, 0.6)]):
        np.testing.assert_array_equal(found.backgrounds[n], np.float32(background))
        image, _ = render(cloud(), found.cameras[n], background=background)
        assert found.image(n).dtype == np.float32
        np.testing.assert_allclose(found.image(n), np.clip(image, 0, 1), atol=3e-4)


def test_photographs_are_the_targets_if_there_are_any(tmp_path):
    photos = np.random.default_rng(0).integers(0, 256, (2, 32, 40, 3), dtype=np.uint8)
    views = []
    for n, (view, photo) in enumerate(zip(around(2), photos, strict=True)):
        Image.fromarray(photo).save(tmp_path / f"{n}.png")
        views.append(View(view.name, view.camera, tmp_path / f"{n}.png"))
    found = targets_of(cloud(), tuple(views))
    assert found.target_source == "photos"
    np.testing.assert_array_equal(found.image(1), photos[1].astype(np.float32) / np.float32(255))
    mixed = targets_of(cloud(), (views[0], around(2)[1]))
    assert mixed.target_source == "photos"
    np.testing.assert_array_equal(mixed.image(0), found.image(0))
    np.testing.assert_array_equal(mixed.image(1), targets_of(cloud(), around(2)).image(1))


def test_every_target_occurs_once_per_epoch():
    found = targets_of(cloud())
    steps = list(islice(found.order((0, 1)), 20))
    assert all(Counter(steps[n : n + 4]) == Counter(range(4)) for n in range(0, 20, 4))
    assert steps != list(islice(found.order((0, 2)), 20))
    for first in (1, 3, 4, 9):
        assert list(islice(found.order((0, 1), first), 20 - first)) == steps[first:]
    assert len({tuple(steps[n : n + 4]) for n in range(0, 20, 4)}) > 1


@pytest.mark.parametrize(("synthetic", "some"), [(7, 2), (3, 3)])
def test_synthetic_cameras_take_turns(synthetic, some):
    """Each epoch has all other targets and so many of these, all of which occur equally often."""
    found = targets_of(cloud(), around(4 + synthetic), synthetic=synthetic, synthetic_per_epoch=some)
    count = 4 + some
    steps = list(islice(found.order((5,)), count * synthetic))
    for n in range(0, len(steps), count):
        epoch = steps[n : n + count]
        assert sorted(epoch)[:4] == [0, 1, 2, 3]
        assert len(set(epoch)) == count
    assert Counter(step for step in steps if step >= 4) == Counter(list(range(4, 4 + synthetic)) * some)
    for first in (1, count, 2 * count + 2):
        assert list(islice(found.order((5,), first), len(steps) - first)) == steps[first:]


def test_the_turns_of_synthetic_cameras_depend_on_the_seed():
    found = targets_of(cloud(), around(24), synthetic=20, synthetic_per_epoch=1)
    turns = [[step for step in islice(found.order((seed,)), 100) if step >= 4] for seed in (1, 2)]
    assert sorted(turns[0]) == sorted(turns[1]) == list(range(4, 24))
    assert turns[0] != turns[1]


def test_the_extent_is_that_of_3dgs():
    """Cameras on a circle of radius 3; in INRIA's code, 1.1 times the largest distance from the mean."""
    assert targets_of(cloud()).extent == pytest.approx(3.3)
    away = np.eye(4)
    away[:3, 3] = 50, 0, 0
    far = tuple(replace(view, camera=replace(view.camera, viewmat=view.camera.viewmat @ away)) for view in around(3))
    found = targets_of(cloud(), (*around(4), *far), synthetic=3, synthetic_per_epoch=1)
    assert found.extent == pytest.approx(3.3), "synthetic cameras do not count"


def test_the_local_extent_of_an_object_is_that_of_the_cameras_around_it():
    """Two distant objects, one a hundredth of the size of the other."""

    def smaller(view):
        pose = view.camera.viewmat.copy()
        pose[:3, 3] = -pose[:3, :3] @ (0.01 * view.camera.position + (50, 0, 0))
        return View(view.name, replace(view.camera, viewmat=pose))

    small = [smaller(view) for view in around(12)]
    found = targets_of(cloud(), (*around(12), *small))
    alone = targets_of(cloud(), around(12))
    means = cloud(30).means
    extents = found.local_extents(
        np.concatenate([means, means * np.float32(0.01) + np.float32([50, 0, 0])]), found.extent
    )
    assert found.extent > 20
    turns = targets_of(cloud(), (*around(12), *small), synthetic=12, synthetic_per_epoch=1)
    both = np.concatenate([means, means * np.float32(0.01) + np.float32([50, 0, 0])])
    np.testing.assert_array_equal(turns.local_extents(both, found.extent), extents)  # synthetic cameras count
    np.testing.assert_allclose(extents[:30], alone.local_extents(means, found.extent), rtol=1e-6)
    np.testing.assert_allclose(extents[30:], 0.01 * extents[:30], rtol=1e-3)
    assert (extents[:30] > 0.5 * alone.extent).all()


def test_local_extents_are_positive_and_limited():
    found = targets_of(cloud(), around(3))
    points = np.concatenate([[camera.position for camera in found.cameras], [[1e6, 0, 0]]]).astype(np.float32)
    extents = found.local_extents(points, 2.0)
    assert (extents > 0).all()
    assert extents[-1] == 2.0
    assert found.local_extents(points[:0], 2.0).shape == (0,)


def test_at_most_16_views_evaluate_evenly_chosen():
    names = [view.name for view in evaluation_only(Views((), around(20), black(), "a capture")).test]
    assert (len(names), names[0], names[-1]) == (16, "view0", "view19")
