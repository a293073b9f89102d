"""View, position and size with which the preview opens a scene. Oracles: corners of known boxes, projected from eye,
target, up, fov; medians and sorted distances in NumPy."""

import json

import numpy as np
import pytest
from helpers.web_tools import run_node

VIEW = {"eye": [1, 2, 3], "target": [1, 2, 5.5], "up": [0, -1, 0], "fov": 60}


def views(records=(), headers=(), scenes=()):
    job = {"records": list(records), "headers": list(headers), "scenes": [np.asarray(each).tolist() for each in scenes]}
    return json.loads(run_node("first_views.mjs", json.dumps(job)))


def test_only_possible_records_are_taken():
    changes = [
        {"up": [0, 0, -2]},  # along the line of sight
        {"up": [0, 0, 0]},
        {"target": [1, 2, 3]},
        {"target": [1, 2, 3.000000001]},
        {"eye": [1, 2]},
        {"eye": [1, 2, "3"]},
        {"eye": [1, 2, 1e16]},
        {"eye": None},
        {"fov": 0},
        {"fov": 179},
        {"fov": "60"},
    ]
    impossible = [*({**VIEW, **change} for change in changes), None, 5, [], {}]
    far = {**VIEW, "eye": [5e5, 4e6, 97], "target": [5e5, 4e6, 100]}
    found = views(records=[VIEW, {**VIEW, "up": [0, -3, 1], "more": 1}, far, *impossible])["records"]
    assert found[0] == VIEW
    assert found[1] == {**VIEW, "up": pytest.approx([0, -0.9487, 0.3162], abs=1e-4)}
    assert found[2] == far, "near its target, far from the origin"
    assert found[3:] == [None] * len(impossible)


def test_a_ply_has_it_in_a_comment():
    text = "ply\ncomment kissgs view {}\nelement vertex 0\nend_header\n"
    recorded, broken = (text.replace("{}", value) for value in (json.dumps(VIEW), '{"eye": '))
    after = "ply\nend_header\n" + recorded
    assert views(headers=[recorded, text, broken, after, "ply"])["headers"] == [VIEW, None, None, None, None]


def solid(half, count=4000):
    return np.random.default_rng(0).uniform(-1, 1, (count, 3)) * half


@pytest.mark.parametrize("half", [(0.2, 1.0, 0.6), (1.5, 0.3, 0.3)])
def test_without_a_record_what_is_dense_is_whole_and_in_the_middle(half):
    """A fifth of the Gaussians are floaters, up to 40 times as far away as the object is large."""
    half, centre = np.array(half), np.array([7.0, -3, 2])
    rng = np.random.default_rng(1)
    directions = rng.normal(size=(1000, 3))
    floaters = directions / np.linalg.norm(directions, axis=1, keepdims=True) * rng.uniform(8, 40, (1000, 1))
    (view,) = views(scenes=[centre + np.concatenate([solid(half), floaters])])["scenes"]
    eye, target, up = (np.array(view[name]) for name in ("eye", "target", "up"))
    forward = (target - eye) / np.linalg.norm(target - eye)
    right = np.cross(forward, up) / np.linalg.norm(np.cross(forward, up))
    corners = centre + np.array(np.meshgrid(*zip(-half, half, strict=True))).reshape(3, -1).T - eye
    places = corners @ np.stack([right, np.cross(forward, right)], axis=1) / (corners @ forward)[:, None]
    places /= np.tan(np.radians(view["fov"] / 2))
    assert 0.6 < np.abs(places).max() < 1.1
    assert np.abs(places.min(axis=0) + places.max(axis=0)).max() < 0.2
    assert up.tolist() == [0, -1, 0]
    assert (eye - target) @ up > 0, "slightly from above"
    broad = np.array([1.0, 0, 0]) if half[0] < half[2] else np.array([0, 0, 1.0])
    assert abs(forward @ broad) > 0.7, "from the broad side, where more of it is visible"


def test_scenes_of_no_size_have_a_view():
    for view in views(scenes=[[], [[1, 2, 3]], [[1, 2, 3]] * 50])["scenes"]:
        assert np.isfinite([*view["eye"], *view["target"]]).all()
        assert np.linalg.norm(np.subtract(view["eye"], view["target"])) > 0


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
