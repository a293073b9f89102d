"""Oracle: scenes of which it is known how near their Gaussians lie, and what a camera close by shows of them."""

from dataclasses import replace

import numpy as np
import pytest
from helpers.whole_scenes import moved, two

from kissgs import render, sample_scene
from kissgs.cameras.virtual.close_ups import close_ups
from kissgs.rendering.local_scale import local_scale


def test_every_object_is_seen_close_up_whatever_its_size():
    cameras = close_ups(two(1000, 1 / 50), side=32, count=80, seed=1)
    assert len(cameras) == 80
    assert {(camera.width, camera.height) for camera in cameras} == {(32, 32)}
    small = [camera.position for camera in cameras if camera.position[0] > 500]
    assert 20 < len(small) < 60, "as many Gaussians in the one as in the other"
    assert np.median(np.linalg.norm(np.array(small) - (1000, 0, 0), axis=1)) < 0.5


def test_what_they_aim_at_is_in_the_middle():
    scene = sample_scene(500)
    for camera in close_ups(scene, side=16, count=20):
        depth = scene.means @ camera.viewmat[2, :3] + camera.viewmat[2, 3]
        places = scene.means @ camera.viewmat[:2, :3].T + camera.viewmat[:2, 3]
        assert np.linalg.norm(places / depth[:, None], axis=1)[depth > 0].min() < 1e-4


@pytest.mark.parametrize("scale", [1e-5, 1e5])
def test_the_picture_is_the_same_at_any_scale(scale):
    """No camera stands so near that nothing is drawn: there, a longer lens takes its place."""
    scene = sample_scene(2000)
    scaled = moved(scene, scale=scale)
    shown = [
        np.mean([render(each, camera)[1].mean() for camera in close_ups(each, side=24, count=40, seed=3)])
        for each in (scene, scaled)
    ]
    assert abs(shown[0] - shown[1]) < 0.1
    assert shown[0] > 0.4


def test_distances_directions_and_lens():
    """From one local scale to eight, evenly by octaves; from all around; 70 degrees."""
    scene = sample_scene(500)
    spacing = local_scale(scene)
    octaves, ahead = [], []
    for camera in close_ups(scene, side=16, count=200):
        gaps = scene.means - camera.position
        aimed = np.argmax(gaps @ camera.viewmat[2, :3] / np.linalg.norm(gaps, axis=1))
        octaves.append(np.log2(np.linalg.norm(gaps[aimed]) / spacing[aimed]))
        ahead.append(camera.viewmat[2, :3])
        assert camera.K[0, 0] == pytest.approx(8 / np.tan(np.radians(35)))
    near, far = np.quantile(octaves, [0.05, 0.95])
    assert -0.1 < near < 0.5
    assert 2.5 < far < 3.1
    assert np.linalg.norm(np.mean(ahead, axis=0)) < 0.2


def test_what_is_hardly_visible_is_hardly_looked_at():
    scene = sample_scene(1000)
    faint = scene.means[:, 0] > np.median(scene.means[:, 0])
    scene = replace(scene, opacities=np.where(faint, np.float32(-7), np.float32(3)))
    aimed = []
    for camera in close_ups(scene, side=16, count=100):
        gaps = scene.means - camera.position
        aimed.append(np.argmax(gaps @ camera.viewmat[2, :3] / np.linalg.norm(gaps, axis=1)))
    assert faint[aimed].sum() < 5


def test_the_same_seed_gives_the_same_cameras():
    scene = sample_scene(300)
    places = [[camera.position for camera in close_ups(scene, side=8, count=9, seed=seed)] for seed in (2, 2, 3)]
    assert np.array_equal(places[0], places[1])
    assert not np.array_equal(places[0], places[2])


def test_where_nothing_can_be_seen_there_are_none():
    scene = sample_scene(20)
    unseen = replace(scene, opacities=np.full(20, -np.inf, np.float32))
    assert close_ups(unseen, side=8, count=5) == []
    assert close_ups(scene.select(np.arange(0)), side=8, count=5) == []
    assert len(close_ups(scene.select(np.arange(1)), side=8, count=5)) == 5
