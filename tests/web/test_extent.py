"""Position and size of a scene in the preview. Oracle: medians and sorted distances in NumPy."""

import json

import numpy as np
import pytest
from helpers.web_tools import run_node


def measure(points, **job):
    """Return the extent of a scene as one container, and as the coarsest level of a streamed scene."""
    (found,) = json.loads(run_node("measure_extents.mjs", json.dumps([{"points": np.asarray(points).tolist(), **job}])))
    return found["whole"], found["coarsest"]


def radius_of(points, share=0.85):
    """Return the radius around the median that contains a share of equal points, whose number has no exact shares."""
    points = np.float32(points).astype(np.float64)
    centre = np.sort(points, axis=0)[int(np.ceil(len(points) / 2)) - 1]
    return np.sort(np.linalg.norm(points - centre, axis=1))[int(np.ceil(share * len(points))) - 1]


def ball(count, centre=0.0):
    rng = np.random.default_rng(0)
    directions = rng.normal(size=(count, 3))
    radii = np.cbrt(rng.random(count))
    return directions / np.linalg.norm(directions, axis=1, keepdims=True) * radii[:, None] + [centre, 0, 0]


def sky(count, half=False):
    directions = np.random.default_rng(1).normal(size=(count, 3))
    if half:
        directions[:, 1] = -np.abs(directions[:, 1])
    return 20 * directions / np.linalg.norm(directions, axis=1, keepdims=True)


@pytest.mark.parametrize("share", [0.25, 0.45])
def test_two_towns(share):
    """The smaller one is no sky: it lies on one side. Streamed or not, both towns are in the image."""
    far = round(1001 * share)
    points = np.concatenate([ball(1001 - far), ball(far, 20)])
    whole, coarsest = measure(points)
    assert coarsest == whole
    assert np.isclose(coarsest["radius"], radius_of(points), rtol=1e-6)
    assert coarsest["radius"] > 18


@pytest.mark.parametrize("half", [False, True])
def test_a_sky_does_not_set_the_radius(half):
    points = np.concatenate([ball(650), sky(351, half)])
    whole, coarsest = measure(points)
    assert whole["radius"] > 18
    assert coarsest["centre"] == whole["centre"]
    assert np.isclose(coarsest["radius"], 2.5 * radius_of(points, 0.4), rtol=1e-6)
    assert coarsest["radius"] < 3


def test_many_at_one_position():
    """More than the nearest 40 % without any size: a limit in units of that would be 0."""
    points = [[0, 0, 0]] * 51 + [[10 + i, i, 3] for i in range(50)]
    for extent in measure(points):
        assert np.isclose(extent["radius"], radius_of(points), rtol=1e-6)
    for extent in measure([[0, 0, 0], [100, 0, 0]]):
        assert extent == {"centre": [0, 0, 0], "radius": 100}


@pytest.mark.parametrize("count", [1, 3])
def test_no_size(count):
    """A streamed scene keeps the extent of its boxes."""
    assert measure([[5, 6, 7]] * count) == ({"centre": [5, 6, 7], "radius": 1}, None)


def test_files_that_no_leaf_names():
    """A scene whose coarsest file is lost has no extent by an environment or by files of finer levels."""
    assert measure(ball(100, 50), lost=[0])[1] is None


def test_each_gaussian_stands_for_those_of_the_finest_level():
    """Two leaves, of which the second stands for nine times as many Gaussians."""
    points = np.concatenate([ball(101), ball(100, 20)])
    leaves = [
        {"levels": [{"file": 0, "offset": at, "count": count}, {"file": 1, "offset": 0, "count": finest}]}
        for at, count, finest in ((0, 101, 101), (101, 100, 900))
    ]
    coarsest = measure(points, leaves=leaves)[1]
    repeated = np.concatenate([points[:101], np.repeat(points[101:], 9, axis=0)])
    assert np.isclose(coarsest["radius"], radius_of(repeated), rtol=1e-6)
    assert abs(coarsest["centre"][0] - 20) < 0.5
