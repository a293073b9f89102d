"""Oracle: scenes whose centre and up direction are known by construction."""

import numpy as np
import pytest
from helpers.hollow_scenes import box, surface

from kissgs import sample_scene
from kissgs.cameras.virtual.select import scene_bounds, weighted_median, weighted_quantiles
from kissgs.core.splats import ATTRIBUTES, Splats


def rotated(splats, matrix):
    """Return the scene rotated about x by ``matrix``, without SH rest."""
    half_angle = 0.5 * np.arctan2(matrix[2, 1], matrix[1, 1])
    w, x = np.cos(half_angle), np.sin(half_angle)
    a, b, c, d = splats.quats.astype(np.float64).T
    quats = np.stack([w * a - x * b, w * b + x * a, w * c - x * d, w * d + x * c], axis=1)
    means = splats.means @ matrix.T.astype(np.float32)
    return Splats(
        means=means,
        quats=quats.astype(np.float32),
        scales=splats.scales,
        opacities=splats.opacities,
        sh0=splats.sh0,
        shN=np.empty((len(splats), 0, 3), np.float32),
    )


@pytest.fixture(scope="module")
def table():
    return sample_scene(20_000, sh_degree=0)


def test_floaters_and_a_far_sky_do_not_move_the_centre():
    rng = np.random.default_rng(0)
    far = surface(rng.normal(0, 40, (2000, 3)) + 60, np.zeros(2000, int), 5.0)
    arrays = {name: np.concatenate([getattr(box((1, 1, 1)), name), getattr(far, name)]) for name in ATTRIBUTES}
    bounds = scene_bounds(Splats(**arrays))
    assert np.abs(bounds.centre).max() < 0.2
    assert 0.5 < bounds.radius < 2


@pytest.mark.parametrize(
    ("matrix", "up"),
    [
        (np.eye(3), (0, -1, 0)),
        (np.diag([1.0, -1, -1]), (0, 1, 0)),
        (np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]]), (0, 0, 1)),
    ],
)
def test_the_up_direction_is_found_for_all_axis_conventions(table, matrix, up):
    assert scene_bounds(rotated(table, matrix)).up @ up > np.cos(np.radians(3))


def test_weighted_quantiles():
    values = np.array([3.0, 1.0, 2.0])
    assert weighted_median(values, np.ones(3)) == 2
    assert weighted_median(values, np.array([9.0, 1, 1])) == 3
    assert weighted_quantiles(values, np.ones(3), 0.99, 0.01) == [3, 1]
