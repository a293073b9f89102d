"""Oracle: finite numbers, and images that are not worse than before, for degenerate Gaussians."""

import numpy as np
import pytest
from helpers.degenerate_scenes import SCENES, changed, loud
from helpers.training_scenes import around, cloud

import kissgs
from kissgs import CompactSettings
from kissgs.cameras.views import View, black
from kissgs.compaction.popspa import Popspa
from kissgs.core.splats import ATTRIBUTES
from kissgs.rendering.rasterizer import render
from kissgs.training.supervision import SupervisionViews

STEPS = {
    "sparsify_steps": 60,
    "refine_steps": 60,
    "prune_rounds": 3,
    "admm_interval": 5,
    "erank_weight": 0.01,
    "min_scale_weight": 1.0,
}


def targets_of(size=1.0):
    views = []
    for view in around(5):
        pose = view.camera.viewmat.copy()
        pose[:3, 3] *= size
        views.append(View(view.name, kissgs.Camera(pose, view.camera.K, view.camera.width, view.camera.height)))
    return SupervisionViews(*[tuple(views)] * 3, black(), "five views")


def error(scene, original, supervision):
    pairs = [[render(one, view.camera)[0] for one in (scene, original)] for view in supervision.train]
    return np.mean([np.square(np.clip(a, 0, 1) - np.clip(b, 0, 1)) for a, b in pairs])


def check(scene, count, supervision, seen=True, **changes):
    fitted = Popspa(scene, CompactSettings(**{**STEPS, **changes}), supervision)(count).splats
    assert len(fitted) == count
    for name in ATTRIBUTES:
        assert np.isfinite(getattr(fitted, name)).all(), name
    if not seen:
        return fitted
    pruned = Popspa(scene, CompactSettings(sparsify_steps=0, refine_steps=0), supervision)(count).splats
    assert error(fitted, scene, supervision) <= 1.1 * error(pruned, scene, supervision) + 2e-3
    return fitted


@pytest.mark.parametrize("scene", SCENES, ids=lambda scene: scene.__name__)
@pytest.mark.quick(1)
def test_degenerate_scenes_train_without_nan(scene):
    check(scene(), 20, targets_of(), seen=scene is not loud)  # no image from 0 to 1 has colours of a million


@pytest.mark.parametrize("size", [1e-1, 1e3, 1e6])
@pytest.mark.quick(0)
def test_worlds_of_any_size_train_alike(size):
    """Learning rates of positions are in units of the cameras' extent; scales are logarithms."""
    scene = cloud(60)
    large = changed(scene, means=scene.means * size, scales=scene.scales + np.log(size))
    reference = check(scene, 20, targets_of(), admm_rho=0)
    found = check(large, 20, targets_of(size), admm_rho=0)
    near = error(found, large, targets_of(size)), error(reference, scene, targets_of())
    assert near[0] == pytest.approx(near[1], rel=0.5)


@pytest.mark.parametrize(("count", "degree"), [(2, 0), (7, 1), (8, 2), (9, 3)])
def test_few_gaussians_of_any_degree(count, degree):
    check(cloud(count, degree, seed=count), count - 1, targets_of(), sparsify_steps=10, refine_steps=5)
