"""Regions and the cameras that are chosen for each; the oracle is where the objects were put."""

from __future__ import annotations

import numpy as np
import pytest
from helpers.whole_scenes import SCENES, joined, moved, two

from kissgs import Camera, Splats, clean, sample_scene
from kissgs.cameras.virtual.random_poses import random_poses
from kissgs.cameras.virtual.scene_views import scene_views


def near(cameras: list[Camera], place: tuple[float, float, float], radius: float) -> int:
    return sum(float(np.linalg.norm(camera.position - place)) < radius for camera in cameras)


def cameras_of(splats: Splats, count: int = 24) -> list[Camera]:
    found = scene_views(clean(splats)[0], width=96, height=96, count=count)
    assert len(found.all) == count
    return [view.camera for view in found.all]


@pytest.mark.parametrize("distance", [100, 10_000])
def test_two_objects_far_from_each_other_have_cameras_each(distance: float):
    found = cameras_of(two(distance))
    assert near(found, (0, 0, 0), 30) >= 6
    assert near(found, (distance, 0, 0), 30) >= 6


def test_a_small_object_has_cameras_at_its_own_scale():
    found = cameras_of(two(12, 1 / 50))
    assert near(found, (12, 0, 0), 0.6) >= 4
    assert near(found, (0, 0, 0), 8) >= 4


def test_each_of_five_objects_has_cameras():
    found = cameras_of(SCENES["five of different density"](), count=48)
    for place in ((0, 0, 0), (150, 0, 0), (0, 0, 150), (-150, 20, 0), (300, 0, 300)):
        assert near(found, place, 60) >= 2


def test_random_cameras_to_learn_from_are_spread_over_both_objects():
    views = random_poses(clean(two(1000))[0], side=64, count=40)
    found = [view.camera for view in views.all]
    assert near(found, (0, 0, 0), 40) >= 12
    assert near(found, (1000, 0, 0), 40) >= 12


@pytest.mark.parametrize("count", [0, 1, 2, 7])
def test_scenes_of_hardly_anything_have_cameras(count: int):
    assert len(cameras_of(sample_scene(count), count=3)) == 3


def test_the_number_of_threads_changes_nothing():
    scene = clean(joined(sample_scene(1500), moved(sample_scene(1500, seed=1), by=(300, 0, 0))))[0]
    one, many = (scene_views(scene, width=64, height=64, count=8, threads=threads) for threads in (1, 3))
    for a, b in zip(one.all, many.all, strict=True):
        assert np.array_equal(a.camera.viewmat, b.camera.viewmat)
