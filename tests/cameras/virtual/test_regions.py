"""Oracle: positions and sizes of the objects that scenes are made of."""

import numpy as np
import pytest
from helpers.fewer_cameras import try_fewer
from helpers.whole_scenes import SCENES, two

from kissgs import clean
from kissgs.cameras.virtual.samples import random_poses, scene_views


@pytest.fixture(autouse=True)
def fewer(monkeypatch):
    try_fewer(monkeypatch)


def count_near(cameras, position, radius):
    return sum(float(np.linalg.norm(camera.position - position)) < radius for camera in cameras)


def cameras_of(splats, count=24):
    views = scene_views(clean(splats)[0], width=48, height=48, count=count)
    assert len(views.all) == count
    return [view.camera for view in views.all]


@pytest.mark.parametrize("distance", [100, 10_000])
@pytest.mark.quick(1)
def test_two_distant_objects_both_have_cameras(distance):
    cameras = cameras_of(two(distance, count=2000))
    assert count_near(cameras, (0, 0, 0), 30) >= 6
    assert count_near(cameras, (distance, 0, 0), 30) >= 6


def test_a_small_object_has_cameras_at_its_own_scale():
    cameras = cameras_of(two(12, 1 / 50, count=2000))
    assert count_near(cameras, (12, 0, 0), 0.6) >= 4
    assert count_near(cameras, (0, 0, 0), 8) >= 4


@pytest.mark.quick(0)
def test_each_of_five_objects_has_cameras():
    cameras = cameras_of(SCENES["five of different density"](), count=48)
    for position in ((0, 0, 0), (150, 0, 0), (0, 0, 150), (-150, 20, 0), (300, 0, 300)):
        assert count_near(cameras, position, 60) >= 2


def test_random_poses_are_divided_among_both_objects():
    views = random_poses(clean(two(1000, count=2000))[0], side=24, count=40)
    cameras = [view.camera for view in views.all]
    assert count_near(cameras, (0, 0, 0), 40) >= 12
    assert count_near(cameras, (1000, 0, 0), 40) >= 12
