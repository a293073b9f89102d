"""Cameras to judge by. Oracles: the places of clusters that were put there, and distances computed one by one."""

import subprocess
import sys
import tomllib
from pathlib import Path

import numpy as np
import pytest

import kissgs
from kissgs.core.errors import InvalidViewsError
from kissgs.core.splats import ATTRIBUTES, Splats
from kissgs.evaluation.camera_sampling import BACKGROUNDS, NEAREST
from kissgs.evaluation.cameras import EMPTY, HEIGHT, KINDS, WIDTH, evaluation_views
from kissgs.rendering.rasterizer import render

ROOT = Path(__file__).parents[2]
SCENE = kissgs.sample_scene(1500, sh_degree=0, seed=4)
SIZE = float(np.median(np.linalg.norm(SCENE.means - np.median(SCENE.means, axis=0), axis=1)))


def moved(scene=SCENE, by=(0, 0, 0), scale=1.0):
    arrays = {name: getattr(scene, name) for name in ATTRIBUTES}
    arrays["means"] = (scene.means * scale + np.array(by)).astype(np.float32)
    arrays["scales"] = (scene.scales + np.log(scale)).astype(np.float32)
    return Splats(**arrays)


def joined(*scenes):
    return Splats(**{name: np.concatenate([getattr(scene, name) for scene in scenes]) for name in ATTRIBUTES})


def cameras_of(views):
    return [(view.camera.viewmat.tobytes(), view.camera.K.tobytes()) for view in views.test]


def alpha(scene, view):
    return float(render(scene, view.camera)[1].mean())


def test_the_same_seed_draws_the_same_and_another_one_others():
    first = cameras_of(evaluation_views(SCENE, threads=1))
    assert first == cameras_of(evaluation_views(SCENE, threads=3))
    other = cameras_of(evaluation_views(SCENE, seed=1))
    assert not set(first) & set(other)
    assert not set(first) & set(cameras_of(kissgs.virtual_views(SCENE, width=WIDTH, height=HEIGHT)))


def test_kinds_take_turns_and_so_do_backgrounds():
    views = evaluation_views(SCENE, count=24)
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
    assert min(alpha(SCENE, view) for view in evaluation_views(SCENE, seed=2).test) > EMPTY / 2


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize(("by", "scale"), [(10_000.0, 1.0), (10_000.0, 0.02), (40.0, 0.02)])
def test_every_cluster_gets_cameras(seed, by, scale):
    """Two objects far apart, or one of them tiny: both are looked at from about their own size."""
    second = moved(by=(by, 0, 0), scale=scale)
    targets = [
        (view.target, np.linalg.norm(view.camera.position - view.target))
        for view in evaluation_views(joined(SCENE, second), seed=seed).test
    ]
    extent = 50 * SIZE  # the sample scene stands under a sky
    near = [away for target, away in targets if np.linalg.norm(target) < extent and away < extent]
    there = [
        away
        for target, away in targets
        if np.linalg.norm(target - [by, 0, 0]) < extent * scale and away < extent * scale
    ]
    assert len(near) >= 3
    assert len(there) >= 3


def test_a_small_cluster_beside_a_hundred_times_as_many_gets_its_turn():
    rng = np.random.default_rng(1)
    few = moved(SCENE.select(rng.choice(1500, 15, replace=False)), by=(3000, 0, 0))
    found = [
        view.target[0] > 2000 for seed in range(6) for view in evaluation_views(joined(SCENE, few), seed=seed).test
    ]
    assert sum(found) >= 6  # a hundredth of 108 cameras that look at what is near would be one


def test_one_outlier_does_not_take_the_cameras_away():
    far = moved(SCENE.select(slice(0, 1)), by=(1e6, 0, 0))
    for seed in range(3):
        views = evaluation_views(joined(SCENE, far), seed=seed).test
        assert sum(np.linalg.norm(view.target) < 1e3 for view in views) >= 18


@pytest.mark.parametrize("count", [0, 1, 2, 7])
def test_few_gaussians(count):
    """The first of the sample scene, all in sight: they fill part of every picture."""
    scene = SCENE.select(slice(0, count))
    views = evaluation_views(scene)
    assert len(views.test) == 24
    if count:
        assert np.mean([alpha(scene, view) for view in views.test]) > 0.03


def test_nothing_visible_and_all_in_one_place():
    hidden = Splats(**{**{name: getattr(SCENE, name) for name in ATTRIBUTES}, "opacities": SCENE.opacities - 99})
    assert len(evaluation_views(hidden).test) == 24
    together = moved(scale=1.0)
    together.means[:] = 3.0
    assert np.mean([alpha(together, view) for view in evaluation_views(together).test]) > 0.03


@pytest.mark.parametrize("scale", [1e-6, 1e-3, 1e6])
def test_scenes_of_any_size_are_looked_at_alike(scale):
    scene = moved(scale=scale, by=(3 * scale, 0, 0))
    views = evaluation_views(scene).test
    assert np.mean([alpha(scene, view) for view in views]) > 0.3
    assert min(np.linalg.norm(view.camera.position - view.target) for view in views) > 0.99 * NEAREST


def test_close_ups_stand_among_the_nearest():
    """No nearer than the hundredth, no farther than the thousandth Gaussian, unless the Gaussian itself is large."""
    for view in evaluation_views(SCENE, seed=1).test:
        if "close-up" in view.name:
            away = np.linalg.norm(view.camera.position - view.target)
            distances = np.linalg.norm(SCENE.means - view.target, axis=1)
            subject = int(distances.argmin())
            own = 5 * float(np.exp(np.sort(SCENE.scales[subject])[1]))
            nearer = int((distances < away).sum())
            assert 95 <= nearer <= 1005 or away == pytest.approx(own, rel=1e-3)


def test_impossible_requests_are_refused():
    for wrong in ({"count": 0}, {"width": 0}, {"height": -1}):
        with pytest.raises(InvalidViewsError, match="at least 1 view of 1x1 pixels"):
            evaluation_views(SCENE, **wrong)
    with pytest.raises(InvalidViewsError, match="a seed is a whole number from 0, not -1"):
        evaluation_views(SCENE, seed=-1)


def test_nothing_is_shared_with_the_cameras_of_the_encoder():
    """They, and what they are found by, are not even imported; and the contract of imports names them all."""
    code = (
        "import sys, kissgs.evaluation.evaluate, kissgs.evaluation.html, kissgs.evaluation.psnr_loss\n"
        "print(' '.join(name for name in sys.modules if name.startswith('kissgs.')))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    contracts = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["importlinter"]["contracts"]
    (forbidden,) = (set(each["forbidden_modules"]) for each in contracts if "evaluation is independent" in each["name"])
    assert not set(done.stdout.split()) & forbidden
    assert not any(name.startswith("kissgs.cameras.virtual") for name in done.stdout.split())
    names = ("coverage", "sensitivity", "local_scale", "color_refit")
    assert forbidden == {"kissgs.cameras.virtual", *(f"kissgs.rendering.{name}" for name in names)}
