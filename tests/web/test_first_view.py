"""The view that the preview opens a scene with. Oracle: corners of known boxes, projected from eye, target, up, fov."""

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
