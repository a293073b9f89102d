"""The view that viewers open a scene with. Oracle: corners of known boxes, projected from eye, target, up and fov."""

import json
from dataclasses import replace

import numpy as np
import pytest
from helpers.fewer_cameras import try_fewer
from helpers.hollow_scenes import box, surface

import kissgs
from kissgs.cameras.views import black
from kissgs.cameras.virtual.first_view import first_view, first_view_of
from kissgs.cameras.virtual.samples import sensitivity_cameras
from kissgs.cameras.virtual.select import score_candidates
from kissgs.core.context import Context, Workers, silent
from kissgs.core.splats import concatenate
from kissgs.rendering.camera import look_at

HALF = np.array([0.5, 1.0, 0.2])
CORNERS = np.array(np.meshgrid(*zip(-HALF, HALF, strict=True))).reshape(3, -1).T
UP = np.array([0.0, -1.0, 0.0])


@pytest.fixture(autouse=True)
def fewer(monkeypatch):
    try_fewer(monkeypatch)


def projected(record, points):
    """Return where points are in a square image whose sides are at -1 and 1, and check that they are ahead."""
    eye, target, up = (np.array(record[name]) for name in ("eye", "target", "up"))
    forward = (target - eye) / np.linalg.norm(target - eye)
    right = np.cross(forward, up) / np.linalg.norm(np.cross(forward, up))
    offsets = points - eye
    assert (offsets @ forward > 0).all()
    places = np.stack([offsets @ right, offsets @ np.cross(forward, right)], axis=1) / (offsets @ forward)[:, None]
    return places / np.tan(np.radians(record["fov"] / 2))


def plain_box():
    """Return a box, striped on the side towards +x + z only, with floaters all around it."""
    scene = box(HALF, 6000, 0.04)
    striped = scene.means[:, 2] > 0.19
    scene.sh0[striped] = np.sign(np.sin(20 * scene.means[striped, :1]))
    rng = np.random.default_rng(0)
    directions = rng.normal(size=(300, 3))
    far = 12 * directions / np.linalg.norm(directions, axis=1, keepdims=True)
    floaters = surface(far, np.zeros(300, int), 0.1)
    return concatenate([scene, replace(floaters, opacities=floaters.opacities - 3)])


def test_an_object_is_whole_upright_in_the_middle_and_seen_from_its_front():
    record = first_view_of(plain_box())
    places = projected(record, CORNERS)
    assert np.abs(places).max() < 1
    assert np.abs(places).max() > 0.6, "not far away"
    assert np.abs(places.min(axis=0) + places.max(axis=0)).max() < 0.2
    assert np.array(record["up"]) @ UP > 0.99
    eye = np.array(record["eye"])
    assert eye[2] > 0.7 * np.linalg.norm(eye), "the side with the most detail"
    assert np.abs(record["target"]).max() < 0.3


def test_a_head_with_more_gaussians_than_the_rest_is_up():
    """The density falls off downwards, and there is no ground: such a person was once shown upside down."""
    rng = np.random.default_rng(1)
    directions = rng.normal(size=(9000, 3))
    ball = directions / np.linalg.norm(directions, axis=1, keepdims=True)
    head, body = ball[:4500] * 0.12 - [0, 0.9, 0], ball[4500:] * [0.2, 0.8, 0.15]
    person = surface(np.concatenate([head, body]), rng.integers(0, 3, 9000), 0.02)
    assert np.array(first_view_of(person)["up"]) @ UP > 0.99


def camera(position, target=(0, 0, 0), up=UP):
    place, at = np.array(position, float), np.array(target, float)
    return look_at(place, at, np.array(up, float), fov=0.9, width=400, height=300)


def test_of_a_capture_it_is_the_middle_one_of_the_cameras_that_show_the_object():
    with Workers(1) as pool:
        candidates = score_candidates(box(HALF, 3000, 0.1), (64, 64), pool, silent)
    row = [camera((x, 0, -4)) for x in np.linspace(-3, 3, 9)]
    away = [camera((x, 0, -4), (x, 0, -8)) for x in (-0.1, 0.1)]
    beside = [camera((0.05, 0, -4), (3, 0, 0))]
    for captured in ([*row, *away, *beside], [camera(each.position, up=-UP) for each in row]):
        record = first_view(candidates, captured)
        np.testing.assert_allclose(record["eye"], [0, 0, -4], atol=0.8)
        np.testing.assert_allclose(record["target"], [0, 0, 0], atol=0.1)
        assert abs(np.array(record["up"]) @ UP) > 0.99
        assert np.array(record["up"]) @ -captured[0].viewmat[1, :3] > 0, "photographs are held upright"
        assert record["fov"] == round(np.degrees(2 * np.arctan(0.75 * np.tan(0.45))), 1)
    assert first_view(candidates, away) == first_view(candidates), "none shows it"
    capture = kissgs.Views(tuple(kissgs.View(str(n), each) for n, each in enumerate(row)), (), black(), "a capture")
    _, found = sensitivity_cameras(box(HALF, 3000, 0.1), capture, Context(2), count=9, size=64)
    np.testing.assert_allclose(found["eye"], [0, 0, -4], atol=0.8)


def test_numbers_are_short_and_fine_enough_far_from_the_origin():
    near = first_view_of(box(HALF, 2000, 0.1))
    scene = box(HALF, 2000, 0.1)
    far = first_view_of(replace(scene, means=scene.means + np.float32([4096, -8192, 0])))
    assert len(json.dumps({"view": near}, separators=(",", ":"))) < 120
    for name in ("eye", "target"):
        np.testing.assert_allclose(np.array(far[name]) - [4096, -8192, 0], near[name], atol=0.01)
    assert first_view_of(replace(scene, opacities=np.full(2000, -np.inf, np.float32))) is None


def test_both_containers_hold_it_and_no_image_depends_on_it(monkeypatch):
    scene = box(HALF, 300, 0.1)
    few = kissgs.Settings.research("balanced", sensitivity_views=4, sensitivity_view_size=64)

    def files(container):
        return kissgs.compress(scene, container=container, settings=few).files

    made = {container: files(container) for container in ("sogxt", "sog")}
    records = [json.loads(each["meta.json"])["kissgs"]["view"] for each in made.values()]
    assert records[0] == records[1]
    assert set(records[0]) == {"eye", "target", "up", "fov"}
    fast = kissgs.compress(scene, container="sog", settings=kissgs.Settings(preset="fast")).files["meta.json"]
    assert "kissgs" not in json.loads(fast), "no cameras are drawn, so choosing one would take as long as the rest"
    monkeypatch.setattr("kissgs.cameras.virtual.samples.first_view", lambda *_: {"fov": 1.0})
    for container, with_view in made.items():
        without = files(container)
        images = [name for name in without if name.endswith(".webp")]
        assert images
        assert all(without[name] == with_view[name] for name in images)
