"""Oracle: geometry by hand, on scenes whose distances are known."""

import numpy as np
from helpers.looked_at import looked_at
from helpers.whole_scenes import two

from kissgs import sample_scene
from kissgs.cameras.virtual.candidates import scene_bounds
from kissgs.cameras.virtual.samples import scattered_cameras
from kissgs.rendering.sensitivity import local_scale


def test_distances_directions_and_fields_of_view():
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
