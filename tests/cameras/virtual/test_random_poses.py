"""Oracle: scenes whose inside and outside are known by construction, and the cameras of a real capture."""

import numpy as np
import pytest
from helpers.hollow_scenes import box, surface

from kissgs.cameras.captures.load import load_views
from kissgs.cameras.virtual.samples import FIELDS_OF_VIEW, random_poses
from kissgs.core.errors import Cancelled, InvalidViewsError
from kissgs.core.splats import Splats, clean
from kissgs.io.ply import read_ply
from kissgs.rendering.rasterizer import render


@pytest.fixture(scope="module")
def tall_box():
    return box((0.5, 1.5, 0.3), 3000, 0.1)


def positions_of(views):
    return np.array([view.camera.position for view in views.all])


def test_views_are_split_named_square_and_of_several_fields_of_view(tall_box):
    views = random_poses(tall_box, side=24, count=17)
    assert 17 <= len(views.all) <= 4 * 17
    assert sorted(view.name for view in views.all) == [f"virtual_{n:02}" for n in range(len(views.all))]
    assert [view.name for view in views.test] == ["virtual_00", "virtual_08", "virtual_16"]
    assert {(view.camera.width, view.camera.height) for view in views.all} == {(24, 24)}
    angles = np.array([2 * np.arctan(12 / view.camera.K[0, 0]) for view in views.all])
    assert FIELDS_OF_VIEW[0] <= angles.min() < angles.max() <= FIELDS_OF_VIEW[1]
    assert np.ptp(angles) > 0.2
    single = random_poses(tall_box, side=24, count=1)
    assert (len(single.train), len(single.test)) == (1, 0)


@pytest.mark.quick(0)
def test_the_same_seed_gives_the_same_views_for_any_number_of_threads(tall_box):
    one, same = (random_poses(tall_box, side=32, count=9, seed=3, threads=threads) for threads in (1, 3))
    assert np.array_equal(positions_of(one), positions_of(same))
    other = random_poses(tall_box, side=32, count=9, seed=4)
    assert not set(map(tuple, positions_of(one))) & set(map(tuple, positions_of(other)))


def test_an_object_is_seen_from_all_around_and_from_outside(tall_box):
    views = random_poses(tall_box, side=24, count=40)
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


@pytest.mark.parametrize(("count", "size", "log_scale", "opacity"), [(0, 1, 0, 0), (1, 1, 30, 3), (9, 1e6, -30, -13)])
def test_any_scene_gets_views(count, size, log_scale, opacity):
    points = np.random.default_rng(0).normal(0, size, (count, 3))
    flat = surface(points, np.zeros(count, int), 1.0)
    scene = Splats(
        means=flat.means,
        quats=flat.quats,
        scales=np.full((count, 3), log_scale, np.float32),
        opacities=np.full(count, opacity, np.float32),
        sh0=flat.sh0,
        shN=flat.shN,
    )
    views = random_poses(scene, side=24, count=9)
    assert 2 <= len(views.all) <= 9
    for view in views.all:
        image, _ = render(scene, view.camera)
        assert np.isfinite(image).all()


@pytest.mark.parametrize("wrong", [{"count": 0, "side": 8}, {"count": 1, "side": 0}])
def test_numbers_below_one_are_refused(tall_box, wrong):
    with pytest.raises(InvalidViewsError, match="at least"):
        random_poses(tall_box, **wrong)


def test_the_work_can_be_stopped(tall_box):
    def stop(stage, fraction):
        assert stage == "cameras"
        raise Cancelled("stopped")

    with pytest.raises(Cancelled):
        random_poses(tall_box, side=24, count=4, progress=stop)
