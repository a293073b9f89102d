"""Evaluation cameras. Oracles: known positions of clusters, and distances computed one by one."""

import functools
import subprocess
import sys
import tomllib
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from helpers.whole_scenes import joined, moved

import kissgs
from kissgs.cameras.views import MIN_DISTANCE, Views, black
from kissgs.core.context import Context
from kissgs.core.errors import InvalidViewsError
from kissgs.evaluation.cameras import BACKGROUNDS, HEIGHT, KINDS, MIN_MEAN_ALPHA, WIDTH, evaluation_views, farther
from kissgs.rendering.constants import NEAR
from kissgs.rendering.metrics import psnr
from kissgs.rendering.rasterizer import render

ROOT = Path(__file__).parents[2]
SCENE = kissgs.sample_scene(1500, sh_degree=0, seed=4)
SIZE = float(np.median(np.linalg.norm(SCENE.means - np.median(SCENE.means, axis=0), axis=1)))


@functools.cache
def drawn(seed=0):
    return evaluation_views(SCENE, seed=seed)


def cameras_of(views):
    return [(view.camera.viewmat.tobytes(), view.camera.K.tobytes()) for view in views.test]


def alpha(scene, view):
    return float(render(scene, view.camera)[1].mean())


def test_cameras_depend_on_the_seed_but_not_on_threads():
    first = cameras_of(evaluation_views(SCENE, Context(1)))
    assert first == cameras_of(evaluation_views(SCENE, Context(3)))
    other = cameras_of(drawn(1))
    assert not set(first) & set(other)
    assert not set(first) & set(cameras_of(kissgs.virtual_views(SCENE, width=WIDTH, height=HEIGHT)))


def test_farther_cameras_look_at_the_same_points_in_the_same_direction():
    views = drawn()
    for before, after in zip(views.test, farther(views, 4.0).test, strict=True):
        (place, axes), (moved_place, moved_axes) = (
            (-view.camera.viewmat[:3, :3].T @ view.camera.viewmat[:3, 3], view.camera.viewmat[:3, :3])
            for view in (before, after)
        )
        np.testing.assert_allclose(moved_place - before.target, 4 * (place - before.target), rtol=1e-9, atol=1e-9)
        np.testing.assert_array_equal(moved_axes, axes)
        np.testing.assert_array_equal(after.camera.K, before.camera.K)


@pytest.mark.parametrize("distance", [0.0, -1.0, float("inf"), float("nan")])
def test_a_distance_that_is_none_is_refused(distance):
    with pytest.raises(InvalidViewsError, match="give a number above 0"):
        farther(Views((), (), black(), ""), distance)


def test_kinds_and_backgrounds_alternate():
    views = drawn()
    assert views.train == ()
    assert [view.name for view in views.test] == sorted(view.name for view in views.test)
    kinds = [view.name.split()[1] for view in views.test]
    assert sum(kind == KINDS[n % 4] for n, kind in enumerate(kinds)) >= 20
    assert {(kind, float(view.background[0])) for kind, view in zip(kinds, views.test, strict=True)} == {
        (kind, background) for kind in KINDS for background in BACKGROUNDS
    }
    for view in views.test:
        assert (view.camera.width, view.camera.height) == (WIDTH, HEIGHT)
        middle = view.camera.viewmat[:3, :3] @ view.target + view.camera.viewmat[:3, 3]
        np.testing.assert_allclose(middle[:2] / middle[2], 0, atol=1e-6)
        angle = np.degrees(2 * np.arctan(0.5 * WIDTH / view.camera.K[0, 0]))
        assert 49.9 < angle < 90.1


def test_every_view_shows_something():
    assert min(alpha(SCENE, view) for view in drawn(2).test) > MIN_MEAN_ALPHA / 2


@pytest.mark.parametrize(("seed", "by", "scale"), [(0, 10_000.0, 1.0), (1, 10_000.0, 0.02), (2, 40.0, 0.02)])
def test_every_cluster_gets_cameras(seed, by, scale):
    """Two objects far apart, or one of them tiny: both get cameras at a distance of about their own size."""
    second = moved(SCENE, by=(by, 0, 0), scale=scale)
    targets = [
        (view.target, np.linalg.norm(view.camera.position - view.target))
        for view in evaluation_views(joined(SCENE, second), seed=seed).test
    ]
    extent = 50 * SIZE  # the sample scene has a sky
    first = [distance for target, distance in targets if np.linalg.norm(target) < extent and distance < extent]
    other = [
        distance
        for target, distance in targets
        if np.linalg.norm(target - [by, 0, 0]) < extent * scale and distance < extent * scale
    ]
    assert len(first) >= 3
    assert len(other) >= 3


def test_a_cluster_of_a_hundredth_of_the_gaussians_gets_cameras():
    rng = np.random.default_rng(1)
    few = moved(SCENE.select(rng.choice(1500, 15, replace=False)), by=(3000, 0, 0))
    found = [
        view.target[0] > 2000 for seed in range(6) for view in evaluation_views(joined(SCENE, few), seed=seed).test
    ]
    assert sum(found) >= 6  # a hundredth of the 108 cameras with near targets would be one


def test_one_outlier_does_not_attract_the_cameras():
    far = moved(SCENE.select(slice(0, 1)), by=(1e6, 0, 0))
    for seed in range(3):
        views = evaluation_views(joined(SCENE, far), seed=seed).test
        assert sum(np.linalg.norm(view.target) < 1e3 for view in views) >= 18


@pytest.mark.parametrize("count", [0, 1, 2, 7])
def test_scenes_of_few_gaussians_get_cameras(count):
    """The first Gaussians of the sample scene are all visible: they fill part of every image."""
    scene = SCENE.select(slice(0, count))
    views = evaluation_views(scene)
    assert len(views.test) == 24
    if count:
        assert np.mean([alpha(scene, view) for view in views.test]) > 0.03


def test_scenes_without_visible_gaussians_or_at_one_point_get_cameras():
    hidden = replace(SCENE, opacities=SCENE.opacities - 99)
    assert len(evaluation_views(hidden).test) == 24
    together = moved(SCENE)
    together.means[:] = 3.0
    assert np.mean([alpha(together, view) for view in evaluation_views(together).test]) > 0.03


@pytest.mark.parametrize("scale", [1e-6, 1e-3, 1e6])
def test_scenes_of_any_scale_fill_the_images(scale):
    scene = moved(SCENE, scale=scale, by=(3 * scale, 0, 0))
    views = evaluation_views(scene).test
    assert np.mean([alpha(scene, view) for view in views]) > 0.3
    assert min(np.linalg.norm(view.camera.position - view.target) for view in views) > 0.99 * MIN_DISTANCE


def test_close_ups_are_among_the_nearest_gaussians():
    """Between the 100th and the 1000th nearest Gaussian, unless the Gaussian itself is large."""
    for view in drawn(1).test:
        if "close-up" in view.name:
            distance = np.linalg.norm(view.camera.position - view.target)
            distances = np.linalg.norm(SCENE.means - view.target, axis=1)
            subject = int(distances.argmin())
            own = 5 * float(np.exp(np.sort(SCENE.scales[subject])[1]))
            nearer = int((distances < distance).sum())
            assert 95 <= nearer <= 1005 or distance == pytest.approx(own, rel=1e-3)


def test_seeds_below_0_are_refused():
    with pytest.raises(InvalidViewsError, match="cameras is -1; give a whole number from 0"):
        evaluation_views(SCENE, seed=-1)


def test_evaluation_does_not_import_the_encoders_cameras():
    """Neither these nor the modules behind them are imported, and the import contract names them all."""
    code = (
        "import sys, kissgs.evaluation.evaluate, kissgs.evaluation.html, kissgs.evaluation.results\n"
        "print(' '.join(name for name in sys.modules if name.startswith('kissgs.')))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    contracts = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["importlinter"]["contracts"]
    (forbidden,) = (set(each["forbidden_modules"]) for each in contracts if "evaluation is independent" in each["name"])
    assert not set(done.stdout.split()) & forbidden
    assert not any(name.startswith("kissgs.cameras.virtual") for name in done.stdout.split())
    assert forbidden == {"kissgs.cameras.virtual", "kissgs.rendering.sensitivity"}


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_no_image_depends_on_where_the_near_plane_cuts(seed):
    """Regression: a Gaussian that moved by rounding was shown whole, and cost a view 15 dB."""
    rng, count = np.random.default_rng(seed), 1000
    scene = kissgs.Splats(
        means=rng.uniform(-0.06, 0.06, (count, 3)).astype(np.float32),
        quats=np.tile(np.float32([1, 0, 0, 0]), (count, 1)),
        scales=np.full((count, 3), np.log(0.004), np.float32),
        opacities=np.full(count, 4, np.float32),
        sh0=rng.normal(0, 1.5, (count, 3)).astype(np.float32),
        shN=np.zeros((count, 0, 3), np.float32),
    )
    for view in evaluation_views(scene).test:
        viewmat = view.camera.viewmat.copy()
        viewmat[2, 3] += 0.05 * NEAR
        moved = replace(view.camera, viewmat=viewmat)
        images = [
            np.clip(render(scene, camera, background=view.background.tolist())[0], 0, 1)
            for camera in (view.camera, moved)
        ]
        assert psnr(*images) > 35
