"""Oracle: geometry by hand, scenes whose good sides are known by making, and a real one's real cameras."""

import itertools

import numpy as np
import pytest
from helpers.fewer_cameras import try_fewer
from helpers.hollow_scenes import box

from kissgs import sample_scene
from kissgs.cameras.captures.load import load_views
from kissgs.cameras.virtual import orbit as orbits
from kissgs.cameras.virtual.orbit import LEAST, Orbit, _longest, _stretch, find_orbit
from kissgs.core.errors import Cancelled, InvalidViewsError
from kissgs.core.splats import Splats, clean
from kissgs.io.ply import read_ply
from kissgs.rendering.rasterizer import render

UP = np.array([0.0, -1, 0])
HALF = Orbit(hub=np.array([1.0, 2, 3]), reach=4.0, elevation=0.3, up=UP, middle=1.0, sweep=1.2)
FULL = Orbit(hub=np.array([1.0, 2, 3]), reach=4.0, elevation=0.3, up=UP, middle=1.0)


def azimuths(orbit, cameras):
    """Of each camera, from the orbit's middle."""
    middle = orbit.camera(orbit.middle, 4, 3).position - orbit.hub
    middle -= middle @ UP * UP
    side = np.cross(middle, UP)
    return np.array([np.arctan2((c.position - orbit.hub) @ side, (c.position - orbit.hub) @ middle) for c in cameras])


def step_wider(patch):
    """Fewer thumbnails: for checks that do not hang on how many were tried."""
    try_fewer(patch)
    patch.setattr(orbits, "RADII", (1.1, 2.0))
    patch.setattr(orbits, "STEPS", 12)
    patch.setattr(orbits, "FINE_STEPS", 24)


@pytest.fixture
def wider(monkeypatch):
    step_wider(monkeypatch)


@pytest.fixture(scope="module")
def thing():
    return box((0.5, 1.5, 0.3), 2000, size=0.15)


@pytest.fixture(scope="module")
def around_thing(thing):
    with pytest.MonkeyPatch.context() as patch:
        step_wider(patch)
        return find_orbit(thing, width=96, height=72)


@pytest.mark.parametrize("orbit", [HALF, FULL])
def test_cameras_stand_on_a_level_circle_and_look_at_its_hub(orbit):
    for camera in orbit.loop(7, 40, 30):
        offset = camera.position - orbit.hub
        assert np.linalg.norm(offset) == pytest.approx(4)
        assert offset @ UP == pytest.approx(4 * np.sin(0.3))
        assert camera.viewmat[2, :3] == pytest.approx(-offset / 4)
        assert camera.viewmat[0, :3] @ UP == pytest.approx(0, abs=1e-12)
        assert camera.viewmat[1, :3] @ UP < 0


def test_a_full_circle_has_even_steps_and_no_seam():
    places = [camera.position for camera in FULL.loop(9, 40, 30)]
    steps = [np.linalg.norm(a - b) for a, b in zip(places, [*places[1:], places[0]], strict=True)]
    assert steps == pytest.approx([steps[0]] * 9)
    assert FULL.in_words == "a full circle"


@pytest.mark.parametrize("frames", [3, 8, 47, 48, 50])
def test_to_and_fro_stays_on_the_stretch_and_moves_like_a_pendulum(frames):
    cameras = HALF.loop(frames, 40, 30)
    found = np.abs(azimuths(HALF, cameras)) * np.sign(np.sin(2 * np.pi * np.arange(frames) / frames).round(9))
    assert found == pytest.approx(0.6 * np.sin(2 * np.pi * np.arange(frames) / frames), abs=1e-9)
    if frames % 2 == 0:
        assert len({id(camera) for camera in cameras}) <= frames // 2 + 1, "the way back shows the same pictures"


def test_stops_go_once_from_end_to_end():
    found = azimuths(HALF, HALF.stops(5, 40, 30))
    assert np.sort(found) == pytest.approx(0.6 * np.linspace(-1, 1, 5))
    assert (np.diff(found) > 0).all() or (np.diff(found) < 0).all()
    assert len(FULL.stops(6, 40, 30)) == 6
    (only,) = HALF.stops(1, 40, 30)
    assert only.position == pytest.approx(HALF.camera(1.0, 4, 3).position)


def test_what_stands_alone_is_seen_whole_from_all_sides(thing, around_thing):
    assert around_thing.full
    corners = np.array(list(itertools.product((-0.5, 0.5), (-1.5, 1.5), (-0.3, 0.3))))
    for camera in around_thing.loop(12, 96, 72):
        seen = (corners @ camera.viewmat[:3, :3].T + camera.viewmat[:3, 3]) @ camera.K.T
        assert (seen[:, 2] > 0).all()
        pixels = seen[:, :2] / seen[:, 2:]
        assert (pixels > 0).all()
        assert (pixels < [96, 72]).all()
        assert render(thing, camera)[1].mean() > 0.04


@pytest.mark.usefixtures("wider")
def test_tall_pictures_show_it_whole_too(thing):
    orbit = find_orbit(thing, width=36, height=96)
    assert orbit.full
    corners = np.array(list(itertools.product((-0.5, 0.5), (-1.5, 1.5), (-0.3, 0.3))))
    for camera in orbit.loop(8, 36, 96):
        seen = (corners @ camera.viewmat[:3, :3].T + camera.viewmat[:3, 3]) @ camera.K.T
        pixels = seen[:, :2] / seen[:, 2:]
        assert ((pixels > 0) & (pixels < [36, 96])).all()


@pytest.mark.usefixtures("wider")
def test_the_same_for_any_number_of_threads(thing, around_thing):
    again = find_orbit(thing, width=96, height=72, threads=3)
    for one, other in zip(around_thing.loop(3, 96, 72), again.loop(3, 96, 72), strict=True):
        assert np.array_equal(one.viewmat, other.viewmat)


@pytest.mark.usefixtures("wider")
def test_a_table_is_circled_above_it():
    table = sample_scene(3000, sh_degree=0)
    orbit = find_orbit(table, width=64, height=48)
    for camera in orbit.loop(8, 64, 48):
        assert camera.position @ UP > 0
        assert render(table, camera)[1].mean() > 0.85


@pytest.mark.usefixtures("wider")
def test_in_a_room_one_stays_in_it():
    half = np.array([4.0, 1.4, 3.0])
    room = box(half, 4000, size=0.15)
    orbit = find_orbit(room, width=64, height=48)
    for camera in orbit.loop(8, 64, 48):
        assert (np.abs(camera.position) < half - 0.05).all()
        assert render(room, camera)[1].mean() > 0.9


def test_only_the_side_that_was_photographed_is_shown(shared_data, monkeypatch):
    """Behind the fox is a wall: the way turns back before it."""
    monkeypatch.setattr(orbits, "STEPS", 12)
    splats, _ = clean(read_ply(shared_data / "fox" / "point_cloud.ply"))
    orbit = find_orbit(splats)
    assert np.radians(45) < orbit.sweep < np.radians(150)
    looks = np.array([view.camera.viewmat[2, :3] for view in load_views(shared_data / "fox").train])
    for camera in orbit.stops(5, 64, 48):
        assert (looks @ camera.viewmat[2, :3]).max() > np.cos(np.radians(35))


def test_the_longest_stretch_may_pass_the_seam():
    """Against trying all."""
    for good in itertools.product((False, True), repeat=7):
        best = max(
            (length for start in range(7) for length in range(1, 8) if all((good * 2)[start : start + length])),
            default=0,
        )
        found = _longest(np.array(good))
        assert len(found) == best
        assert all((good * 2)[step] for step in found)
        assert (np.diff(found) == 1).all()


def test_a_stretch_is_never_too_short_and_forgives_a_full_circle_a_little():
    assert _stretch(FULL, np.array([1.0] * 10 + [0.0] * 62), 0.9).sweep == pytest.approx(9 * 2 * np.pi / 72)
    lonely = _stretch(FULL, np.eye(72)[30], 0.9)
    assert (lonely.sweep, lonely.middle) == (pytest.approx(LEAST), pytest.approx(30 * 2 * np.pi / 72))
    none = _stretch(FULL, np.eye(72)[30], 1.9)
    assert (none.sweep, none.middle) == (pytest.approx(LEAST), lonely.middle)
    assert _stretch(FULL, np.full(72, 0.8), 0.9).full
    assert not _stretch(FULL, np.array([1.0] * 71 + [0.7]), 0.9).full


@pytest.mark.usefixtures("wider")
@pytest.mark.parametrize("count", [0, 1, 3])
def test_any_scene_can_be_circled(count):
    splats = Splats(
        means=np.full((count, 3), 1e5, np.float32),
        quats=np.tile(np.float32([1, 0, 0, 0]), (count, 1)),
        scales=np.full((count, 3), -20, np.float32),
        opacities=np.zeros(count, np.float32),
        sh0=np.zeros((count, 3), np.float32),
        shN=np.empty((count, 0, 3), np.float32),
    )
    for camera in find_orbit(splats, width=40, height=30).loop(4, 40, 30):
        assert np.isfinite(render(splats, camera)[0]).all()


def test_impossible_sizes_are_refused_and_the_work_can_be_stopped(thing):
    with pytest.raises(InvalidViewsError, match="at least 1x1 pixels, not 0x9"):
        find_orbit(thing, width=0, height=9)
    for wrong in ((0, 9, 9), (3, 0, 9), (3, 9, -1)):
        with pytest.raises(InvalidViewsError, match="at least 1 frame"):
            HALF.loop(*wrong)

    def stop(stage, fraction):
        raise Cancelled("enough")

    with pytest.raises(Cancelled):
        find_orbit(thing, progress=stop)
