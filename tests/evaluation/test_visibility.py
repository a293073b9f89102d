"""What views show of a scene. Oracle: a float64 renderer written pixel by pixel, its weights added up one by one."""

import numpy as np
import pytest
from helpers import reference_rasterizer

import kissgs
from kissgs.core.splats import ATTRIBUTES, Splats
from kissgs.core.threads import Workers
from kissgs.evaluation.prominence import NEIGHBOURS, GaussianSampler, distances, opacity, prominence
from kissgs.evaluation.visibility import LITTLE, SIDE, share_shown, weights_of, without_gloss
from kissgs.rendering.camera import look_at
from kissgs.rendering.cpu.frame import draw

SCENE = kissgs.sample_scene(150, sh_degree=1, seed=7)
UP = np.array([0.0, -1, 0])


def camera(place, target=(0, -0.8, 0), size=(32, 24)):
    return look_at(np.array(place, float), np.array(target, float), UP, fov=1.0, width=size[0], height=size[1])


CAMERAS = [camera((0, -2.2, -5)), camera((4, -1, 2)), camera((0, -1, 0.5), (0, -1, 9))]


def brute_force(scene, view):
    """Sum of alpha times what is left of the light, for each Gaussian."""
    params = {name: getattr(scene, name).astype(np.float64) for name in ATTRIBUTES}
    found = np.zeros(len(scene))
    for number, alphas, before, _ in reference_rasterizer.draw(params, view, np.zeros(3)).layers:
        found[number] += float((alphas * before).sum())
    return found


def test_weights_are_those_of_a_renderer_written_pixel_by_pixel():
    with Workers(1) as pool:
        for view in CAMERAS:
            frame = draw(SCENE, view, np.zeros(3, np.float32), pool)
            found = weights_of(frame, pool)
            np.testing.assert_allclose(found, brute_force(SCENE, view), atol=2e-2, rtol=1e-3)
            assert found.sum() + frame.transmittance.sum() == pytest.approx(32 * 24, rel=1e-5)


@pytest.mark.parametrize("number", [0, 1, 2, 3])
def test_the_share_is_that_of_brute_force(number):
    views, counts = CAMERAS[:number], prominence(SCENE)
    most = np.max([np.zeros(len(SCENE)), *(brute_force(SCENE, view) / (32 * 24) for view in views)], axis=0)
    doubtful = np.abs(most - LITTLE) < 0.1 * LITTLE
    wanted = counts[most > LITTLE].sum() / counts.sum()
    assert share_shown(SCENE, views) == pytest.approx(wanted, abs=counts[doubtful].sum() / counts.sum() + 1e-9)
    assert number == 0 or 0.1 < wanted < 1


def test_what_is_hidden_is_not_shown_and_what_is_transparent_does_not_count():
    arrays = {name: getattr(SCENE, name)[:4].copy() for name in ATTRIBUTES}
    arrays["means"][:] = [(0, 0, 0), (0, 0, 0.1), (0, 0, 1.5), (0, 0, -9)]
    arrays["scales"][:] = np.log([[5], [5], [0.01], [0.5]])  # two, a small one behind them, one behind the camera
    arrays["opacities"][:] = 9.0
    four, ahead = Splats(**arrays), camera((0, 0, -5), (0, 0, 0))
    counts = prominence(four)
    assert share_shown(four, [ahead]) == pytest.approx(counts[:2].sum() / counts.sum())
    arrays["opacities"][2:] = -9.0
    assert share_shown(Splats(**arrays), [ahead]) == 1
    assert share_shown(four.select(slice(0)), [ahead]) == 1


def test_large_pictures_are_reduced():
    large, small = camera((0, -2.2, -5), size=(1600, 1200)), camera((0, -2.2, -5), size=(SIDE, 120))
    assert share_shown(SCENE, [large]) == share_shown(SCENE, [small])


def test_gloss_does_not_matter():
    assert share_shown(without_gloss(SCENE), CAMERAS) == share_shown(SCENE, CAMERAS)


# --- Prominence -----------------------------------------------------------------------------------


def test_prominence_is_opacity_times_relative_area():
    """In one neighbourhood; oracle: the definition, one by one."""
    few = SCENE.select(slice(0, NEIGHBOURS))
    few = few.select(opacity(few) > 0)
    axes = np.sort(np.exp(few.scales.astype(np.float64)), axis=1)
    areas = axes[:, 1] * axes[:, 2]
    padded = prominence(few) / opacity(few)
    usual = areas * (1 / padded - 1)
    np.testing.assert_allclose(usual, usual[0], rtol=1e-9)
    assert np.quantile(areas, 0.2) < usual[0] < np.quantile(areas, 0.8)


def test_distances_are_those_of_the_covariances():
    place = np.array([0.3, -1.0, 2.0])
    for n in range(5):
        turn = reference_rasterizer.rotation(SCENE.quats[n].astype(np.float64))
        covariance = turn @ np.diag(np.exp(2 * SCENE.scales[n].astype(np.float64))) @ turn.T
        away = place - SCENE.means[n]
        wanted = np.sqrt(away @ np.linalg.inv(covariance) @ away)
        assert distances(SCENE, place)[n] == pytest.approx(wanted, rel=1e-3)


def test_gaussians_are_drawn_by_weights_and_by_parts():
    """Oracle: a hundred in one corner of a cube and one in another: at least half the due, and the fourth root."""
    means = np.concatenate([np.zeros((100, 3)), np.full((1, 3), 9.0)])
    sampler = GaussianSampler.of(means, np.ones(101))
    drawn = np.array([sampler.at(number) for number in (np.arange(20_000) + 0.5) / 20_000])
    root = 100**0.25
    assert (drawn == 100).mean() == pytest.approx(0.5 / 101 + 0.5 / (root + 1), abs=1e-3)
    assert np.bincount(drawn, minlength=101)[:100].std() < 1
    assert sampler.at(0.0) in range(101)
    assert sampler.at(1.0) in range(101)
