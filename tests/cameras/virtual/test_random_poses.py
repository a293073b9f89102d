"""Oracle: scenes whose inside, outside and objects are known by construction, and the cameras of a real capture."""

import numpy as np
import pytest
from helpers.fewer_cameras import try_fewer
from helpers.hollow_scenes import box
from helpers.whole_scenes import SCENES, two

from kissgs.cameras.captures.load import load_views
from kissgs.cameras.virtual.samples import FIELDS_OF_VIEW, random_poses, scene_views
from kissgs.core.splats import clean
from kissgs.io.ply import read_ply
from kissgs.rendering.rasterizer import render


@pytest.fixture(scope="module")
def tall_box():
    return box((0.5, 1.5, 0.3), 3000, 0.1)


@pytest.fixture(scope="module")
def views(tall_box):
    with pytest.MonkeyPatch.context() as patch:
        try_fewer(patch)
        return random_poses(tall_box, side=24, count=40)


@pytest.fixture(autouse=True)
def fewer(monkeypatch):
    try_fewer(monkeypatch)


def positions_of(views):
    return np.array([view.camera.position for view in views.all])


def test_views_are_split_named_square_and_of_several_fields_of_view(tall_box, views):
    assert 40 <= len(views.all) <= 4 * 40
    assert sorted(view.name for view in views.all) == [f"virtual_{n:02}" for n in range(len(views.all))]
    assert [view.name for view in views.test[:3]] == ["virtual_00", "virtual_08", "virtual_16"]
    assert len(views.test) == -(-len(views.all) // 8)
    assert {(view.camera.width, view.camera.height) for view in views.all} == {(24, 24)}
    angles = np.array([2 * np.arctan(12 / view.camera.K[0, 0]) for view in views.all])
    assert FIELDS_OF_VIEW[0] <= angles.min() < angles.max() <= FIELDS_OF_VIEW[1]
    assert np.ptp(angles) > 0.2
    single = random_poses(tall_box, side=24, count=1)
    assert (len(single.train), len(single.test)) == (1, 0)


def test_another_seed_gives_other_views(tall_box, views):
    one, other = (
        set(map(tuple, positions_of(each))) for each in (views, random_poses(tall_box, side=24, count=9, seed=4))
    )
    assert not one & other


def test_an_object_is_seen_from_all_around_and_from_outside(tall_box, views):
    positions = positions_of(views)
    outside = (np.abs(positions) > (0.5, 1.5, 0.3)).any(axis=1)
    assert outside.mean() > 0.9  # further regions may lie on the inner side
    assert np.diff(np.sort(np.arctan2(*positions[:, [0, 2]].T))).max() < np.pi / 3
    for view in views.all:
        _, alpha = render(tall_box, view.camera)
        assert alpha.mean() > 0.01


def test_a_room_is_seen_from_inside_in_all_directions():
    half = np.array([4.0, 1.4, 3.0])
    room = box(half, 5000, 0.15)
    views = random_poses(room, side=24, count=40)
    within = (np.abs(positions_of(views)) < half).all(axis=1)
    assert within.mean() > 0.8  # further regions may lie on the outer side
    directions = np.array([view.camera.viewmat[2, :3] for view in views.all])
    assert np.diff(np.sort(np.arctan2(*directions[:, [0, 2]].T))).max() < np.pi / 3
    for view, inside in zip(views.all, within, strict=True):
        _, alpha = render(room, view.camera)
        assert alpha.mean() > (0.8 if inside else 0.01)


@pytest.mark.quick(0)
def test_poses_of_photographs_are_among_them(shared_data):
    """A random camera is near the position of each held-out photograph and looks in a similar direction."""
    splats, _ = clean(read_ply(shared_data / "fox" / "point_cloud.ply"))
    views = random_poses(splats, side=64, count=384).all
    positions = np.array([view.camera.position for view in views])
    directions = np.array([view.camera.viewmat[2, :3] for view in views])
    for view in load_views(shared_data / "fox").test:
        near = np.linalg.norm(positions - view.camera.position, axis=1) < 2.0  # the scene is about 6 across
        assert (directions[near] @ view.camera.viewmat[2, :3]).max() > np.cos(np.radians(20)), view.name


def count_near(cameras, position, radius):
    return sum(float(np.linalg.norm(camera.position - position)) < radius for camera in cameras)


def cameras_of(splats, count=24):
    views = scene_views(clean(splats)[0], width=48, height=48, count=count)
    assert len(views.all) == count
    return [view.camera for view in views.all]


@pytest.mark.parametrize("distance", [100, 10_000])
@pytest.mark.quick(1)
def test_two_distant_objects_both_have_cameras(distance):
    cameras = cameras_of(two(distance, count=2000))
    assert count_near(cameras, (0, 0, 0), 30) >= 6
    assert count_near(cameras, (distance, 0, 0), 30) >= 6


def test_a_small_object_has_cameras_at_its_own_scale():
    cameras = cameras_of(two(12, 1 / 50, count=2000))
    assert count_near(cameras, (12, 0, 0), 0.6) >= 4
    assert count_near(cameras, (0, 0, 0), 8) >= 4


@pytest.mark.quick(0)
def test_each_of_five_objects_has_cameras():
    cameras = cameras_of(SCENES["five of different density"](), count=48)
    for position in ((0, 0, 0), (150, 0, 0), (0, 0, 150), (-150, 20, 0), (300, 0, 300)):
        assert count_near(cameras, position, 60) >= 2


def test_random_poses_are_divided_among_both_objects():
    views = random_poses(clean(two(1000, count=2000))[0], side=24, count=40)
    cameras = [view.camera for view in views.all]
    assert count_near(cameras, (0, 0, 0), 40) >= 12
    assert count_near(cameras, (1000, 0, 0), 40) >= 12
