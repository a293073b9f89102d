"""Oracle: scenes with known distances between Gaussians, and geometry by hand."""

from dataclasses import replace

import numpy as np
import pytest
from helpers.whole_scenes import moved, two

from kissgs import render, sample_scene
from kissgs.cameras.virtual.samples import close_ups, scattered_cameras
from kissgs.cameras.virtual.select import scene_bounds
from kissgs.rendering.sensitivity import local_scale


def looked_at(scene, cameras):
    """Return each camera's distance to the Gaussian in the centre of its image, and the index of that Gaussian."""
    found = []
    for camera in cameras:
        offsets = scene.means.astype(np.float64) - camera.position
        distances = np.linalg.norm(offsets, axis=1)
        target = int(np.argmax(offsets @ camera.viewmat[2, :3] / distances))
        found.append((float(distances[target]), target))
    return found


def test_objects_of_all_sizes_have_close_ups():
    cameras = close_ups(two(1000, 1 / 50), side=32, count=80, seed=1)
    assert len(cameras) == 80
    assert {(camera.width, camera.height) for camera in cameras} == {(32, 32)}
    small = [camera.position for camera in cameras if camera.position[0] > 500]
    assert 20 < len(small) < 60, "both objects have equally many Gaussians"
    assert np.median(np.linalg.norm(np.array(small) - (1000, 0, 0), axis=1)) < 0.5


def test_the_target_is_in_the_middle_of_the_image():
    scene = sample_scene(500)
    for camera in close_ups(scene, side=16, count=20):
        depth = scene.means @ camera.viewmat[2, :3] + camera.viewmat[2, 3]
        offsets = scene.means @ camera.viewmat[:2, :3].T + camera.viewmat[:2, 3]
        assert np.linalg.norm(offsets / depth[:, None], axis=1)[depth > 0].min() < 1e-4


@pytest.mark.parametrize(("draw", "least"), [(close_ups, 0.4), (scattered_cameras, 0.1)])
@pytest.mark.parametrize("scale", [1e-5, 1e5])
def test_images_are_alike_at_any_scale(draw, least, scale):
    """A longer lens takes the place of a camera so close that the near plane would cut the target off."""
    scene = sample_scene(2000)
    scaled = moved(scene, scale=scale)
    shown = [
        np.mean([render(each, camera)[1].mean() for camera in draw(each, side=24, count=40, seed=3)])
        for each in (scene, scaled)
    ]
    assert abs(shown[0] - shown[1]) < 0.1
    assert shown[0] > least


def test_distances_directions_and_fields_of_view_of_close_ups():
    """Distances are log-uniform from one local scale to eight, directions uniform, the field of view is 70 degrees."""
    scene = sample_scene(500)
    spacing = local_scale(scene)
    octaves, forward = [], []
    cameras = close_ups(scene, side=16, count=200)
    for camera, (distance, target) in zip(cameras, looked_at(scene, cameras), strict=True):
        octaves.append(np.log2(distance / spacing[target]))
        forward.append(camera.viewmat[2, :3])
        assert camera.K[0, 0] == pytest.approx(8 / np.tan(np.radians(35)))
    near, far = np.quantile(octaves, [0.05, 0.95])
    assert -0.1 < near < 0.5
    assert 2.5 < far < 3.1
    assert np.linalg.norm(np.mean(forward, axis=0)) < 0.2


def test_faint_gaussians_are_rarely_targets():
    scene = sample_scene(1000)
    faint = scene.means[:, 0] > np.median(scene.means[:, 0])
    scene = replace(scene, opacities=np.where(faint, np.float32(-7), np.float32(3)))
    targets = [target for _, target in looked_at(scene, close_ups(scene, side=16, count=100))]
    assert faint[targets].sum() < 5


@pytest.mark.parametrize("draw", [close_ups, scattered_cameras])
def test_the_same_seed_gives_the_same_cameras(draw):
    scene = sample_scene(300)
    positions = [[camera.position for camera in draw(scene, side=8, count=9, seed=seed)] for seed in (2, 2, 3)]
    assert np.array_equal(positions[0], positions[1])
    assert not np.array_equal(positions[0], positions[2])


@pytest.mark.parametrize("draw", [close_ups, scattered_cameras])
def test_a_scene_without_visible_gaussians_has_none(draw):
    scene = sample_scene(20)
    assert draw(replace(scene, opacities=np.full(20, -np.inf, np.float32)), side=8, count=5) == []
    assert draw(scene.select(np.arange(0)), side=8, count=5) == []


@pytest.mark.parametrize("draw", [close_ups, scattered_cameras])
def test_scenes_of_a_few_gaussians_and_of_one_place(draw):
    for count in (1, 2, 7):
        scene = sample_scene(count)
        for splats in (scene, replace(scene, means=np.zeros_like(scene.means))):
            assert len(draw(splats, side=8, count=6)) == 6


def test_distances_and_directions_of_scattered_cameras():
    """Log-uniform from 10 local scales or a radius to three radii; every third one stands beside another Gaussian."""
    scene = sample_scene(2000)
    spacing, radius = local_scale(scene), scene_bounds(scene).radius
    cameras = scattered_cameras(scene, side=16, count=300)
    assert len(cameras) == 300
    shares = []
    for n, (distance, target) in enumerate(looked_at(scene, cameras)):
        nearest = min(10 * spacing[target], radius)
        if n % 3:
            shares.append(np.log(distance / nearest) / np.log(3 * radius / nearest))
    assert np.min(shares) > -0.01
    assert np.max(shares) < 1.01
    assert 0.4 < np.mean(shares) < 0.6
    across = [np.linalg.norm(scene.means - camera.position, axis=1) / spacing for camera in cameras[::3]]
    assert max(ratio.min() for ratio in across) < 8.1
    assert np.linalg.norm(np.mean([camera.viewmat[2, :3] for camera in cameras], axis=0)) < 0.2
    assert {(camera.width, camera.height) for camera in cameras} == {(16, 16)}


def test_objects_of_all_sizes_are_looked_at():
    scene = two(1000, 1 / 50)
    cameras = scattered_cameras(scene, side=32, count=90, seed=1)
    small = [target >= len(scene) // 2 for _, target in looked_at(scene, cameras)]
    assert 25 < sum(small) < 65, "both objects have equally many Gaussians"
