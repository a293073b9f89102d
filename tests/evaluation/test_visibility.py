"""Share of a scene that views show, and prominence. Oracle: a float64 renderer that adds up weights per pixel."""

import numpy as np
import pytest
from helpers import reference_float64
from scipy.spatial.transform import Rotation

import kissgs
from kissgs.core.context import Workers
from kissgs.core.splats import ATTRIBUTES, Splats
from kissgs.evaluation.scene_parts import (
    MAX_SIDE,
    NEIGHBOURS,
    SHOWN_SHARE,
    GaussianSampler,
    base_colors_only,
    blending_weights,
    mahalanobis_distances,
    prominence,
    share_shown,
)
from kissgs.rendering.camera import look_at
from kissgs.rendering.cpu.frame import draw, drawn_opacities

SCENE = kissgs.sample_scene(150, sh_degree=1, seed=7)
UP = np.array([0.0, -1, 0])


def camera(position, target=(0, -0.8, 0), size=(32, 24)):
    return look_at(np.array(position, float), np.array(target, float), UP, fov=1.0, width=size[0], height=size[1])


CAMERAS = [camera((0, -2.2, -5)), camera((4, -1, 2)), camera((0, -1, 0.5), (0, -1, 9))]


def brute_force(scene, view):
    """Return the sum of alpha times transmittance of each Gaussian."""
    drawn = reference_float64.draw(reference_float64.tensors(scene), view, np.zeros(3))
    return drawn.weights(len(scene)).sum(axis=1)


def test_weights_equal_those_of_the_reference():
    with Workers(1) as pool:
        for view in CAMERAS:
            frame = draw(SCENE, view, np.zeros(3, np.float32), pool)
            found = blending_weights(frame, pool)
            np.testing.assert_allclose(found, brute_force(SCENE, view), atol=2e-2, rtol=1e-3)
            assert found.sum() + frame.transmittance.sum() == pytest.approx(32 * 24, rel=1e-5)


@pytest.mark.parametrize("number", [0, 1, 2, 3])
def test_the_share_equals_that_of_brute_force(number):
    views, counts = CAMERAS[:number], prominence(SCENE)
    most = np.max([np.zeros(len(SCENE)), *(brute_force(SCENE, view) / (32 * 24) for view in views)], axis=0)
    uncertain = np.abs(most - SHOWN_SHARE) < 0.1 * SHOWN_SHARE
    wanted = counts[most > SHOWN_SHARE].sum() / counts.sum()
    assert share_shown(SCENE, views) == pytest.approx(wanted, abs=counts[uncertain].sum() / counts.sum() + 1e-9)
    assert number == 0 or 0.1 < wanted < 1


def test_hidden_gaussians_are_not_shown_and_transparent_ones_do_not_count():
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


def test_large_images_are_reduced():
    large, small = camera((0, -2.2, -5), size=(1600, 1200)), camera((0, -2.2, -5), size=(MAX_SIDE, 120))
    assert share_shown(SCENE, [large]) == share_shown(SCENE, [small])


def test_view_dependent_colour_does_not_change_the_share():
    assert share_shown(base_colors_only(SCENE), CAMERAS) == share_shown(SCENE, CAMERAS)


# --- Prominence -----------------------------------------------------------------------------------


def test_prominence_is_opacity_times_relative_area():
    """Oracle: the definition, for the Gaussians of one neighbourhood."""
    few = SCENE.select(slice(0, NEIGHBOURS))
    few = few.select(drawn_opacities(few) > 0)
    axes = np.sort(np.exp(few.scales.astype(np.float64)), axis=1)
    areas = axes[:, 1] * axes[:, 2]
    relative = prominence(few) / drawn_opacities(few)
    medians = areas * (1 / relative - 1)
    np.testing.assert_allclose(medians, medians[0], rtol=1e-9)
    assert np.quantile(areas, 0.2) < medians[0] < np.quantile(areas, 0.8)


def test_distances_equal_those_of_the_covariances():
    point = np.array([0.3, -1.0, 2.0])
    for n in range(5):
        rotation = Rotation.from_quat(SCENE.quats[n, [1, 2, 3, 0]]).as_matrix()
        covariance = rotation @ np.diag(np.exp(2 * SCENE.scales[n].astype(np.float64))) @ rotation.T
        offset = point - SCENE.means[n]
        wanted = np.sqrt(offset @ np.linalg.inv(covariance) @ offset)
        assert mahalanobis_distances(SCENE, point)[n] == pytest.approx(wanted, rel=1e-3)


def test_gaussians_are_drawn_by_weight_and_by_octree_cell():
    """A hundred in one corner of a cube, one in another. Oracle: half by weight, half by the fourth root per cell."""
    means = np.concatenate([np.zeros((100, 3)), np.full((1, 3), 9.0)])
    sampler = GaussianSampler.of(means, np.ones(101))
    drawn = np.array([sampler.at(number) for number in (np.arange(20_000) + 0.5) / 20_000])
    root = 100**0.25
    assert (drawn == 100).mean() == pytest.approx(0.5 / 101 + 0.5 / (root + 1), abs=1e-3)
    assert np.bincount(drawn, minlength=101)[:100].std() < 1
    assert sampler.at(0.0) in range(101)
    assert sampler.at(1.0) in range(101)
