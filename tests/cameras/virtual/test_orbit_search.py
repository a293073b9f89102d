"""Oracle: scenes whose good sides are known by construction, and the cameras of a real capture."""

import itertools

import numpy as np
import pytest
from helpers.fewer_cameras import try_fewer
from helpers.hollow_scenes import box

from kissgs import sample_scene
from kissgs.cameras import render as camera_paths
from kissgs.cameras.captures.load import load_views
from kissgs.cameras.render import MIN_SWEEP, Orbit, _longest_run, _with_arc, find_orbit
from kissgs.core.errors import Cancelled, InvalidViewsError
from kissgs.core.splats import Splats, clean
from kissgs.io.ply import read_ply
from kissgs.rendering.rasterizer import render

UP = np.array([0.0, -1, 0])
FULL = Orbit(target=np.zeros(3), radius=4.0, elevation=0.3, up=UP)


def use_fewer_thumbnails(patch):
    """Reduce circles and thumbnails, for tests that do not depend on their number."""
    try_fewer(patch)
    patch.setattr(camera_paths, "RADII", (1.1, 2.0))
    patch.setattr(camera_paths, "COARSE_STEPS", 12)
    patch.setattr(camera_paths, "FINE_STEPS", 24)


@pytest.fixture
def fewer(monkeypatch):
    use_fewer_thumbnails(monkeypatch)


@pytest.fixture(scope="module")
def tall_box():
    return box((0.5, 1.5, 0.3), 2000, size=0.15)


@pytest.fixture(scope="module")
def around_box(tall_box):
    with pytest.MonkeyPatch.context() as patch:
        use_fewer_thumbnails(patch)
        return find_orbit(tall_box, width=96, height=72)


@pytest.mark.usefixtures("fewer")
@pytest.mark.parametrize("size", [(96, 72), (36, 96)])
def test_an_object_is_seen_whole_from_all_sides(tall_box, around_box, size):
    orbit = around_box if size == (96, 72) else find_orbit(tall_box, width=36, height=96)
    assert orbit.full
    corners = np.array(list(itertools.product((-0.5, 0.5), (-1.5, 1.5), (-0.3, 0.3))))
    for camera in orbit.loop_cameras(12, *size):
        seen = (corners @ camera.viewmat[:3, :3].T + camera.viewmat[:3, 3]) @ camera.K.T
        assert (seen[:, 2] > 0).all()
        pixels = seen[:, :2] / seen[:, 2:]
        assert ((pixels > 0) & (pixels < size)).all()
        assert render(tall_box, camera)[1].mean() > 0.04


@pytest.mark.usefixtures("fewer")
def test_the_result_is_the_same_for_any_number_of_threads(tall_box, around_box):
    again = find_orbit(tall_box, width=96, height=72, threads=3)
    for one, other in zip(around_box.loop_cameras(3, 96, 72), again.loop_cameras(3, 96, 72), strict=True):
        assert np.array_equal(one.viewmat, other.viewmat)


@pytest.mark.usefixtures("fewer")
def test_the_orbit_around_a_table_is_above_it():
    table = sample_scene(3000, sh_degree=0)
    orbit = find_orbit(table, width=64, height=48)
    for camera in orbit.loop_cameras(8, 64, 48):
        assert camera.position @ UP > 0
        assert render(table, camera)[1].mean() > 0.85


@pytest.mark.usefixtures("fewer")
def test_the_orbit_of_a_room_stays_inside():
    half = np.array([4.0, 1.4, 3.0])
    room = box(half, 4000, size=0.15)
    orbit = find_orbit(room, width=64, height=48)
    for camera in orbit.loop_cameras(8, 64, 48):
        assert (np.abs(camera.position) < half - 0.05).all()
        assert render(room, camera)[1].mean() > 0.9


@pytest.mark.quick(0)
def test_only_the_photographed_side_is_shown(shared_data, monkeypatch):
    """Behind the fox is a wall, before which the path turns back."""
    monkeypatch.setattr(camera_paths, "COARSE_STEPS", 12)
    splats, _ = clean(read_ply(shared_data / "fox" / "point_cloud.ply"))
    orbit = find_orbit(splats)
    assert np.radians(45) < orbit.sweep < np.radians(150)
    directions = np.array([view.camera.viewmat[2, :3] for view in load_views(shared_data / "fox").train])
    for camera in orbit.sheet_cameras(5, 64, 48):
        assert (directions @ camera.viewmat[2, :3]).max() > np.cos(np.radians(35))


def test_the_longest_run_may_pass_the_last_step():
    """Reference: all runs of all circles of seven steps."""
    for good in itertools.product((False, True), repeat=7):
        best = max(
            (length for start in range(7) for length in range(1, 8) if all((good * 2)[start : start + length])),
            default=0,
        )
        found = _longest_run(np.array(good))
        assert len(found) == best
        assert all((good * 2)[step] for step in found)
        assert (np.diff(found) == 1).all()


def test_an_arc_has_a_minimum_length_and_a_full_circle_may_have_weaker_views():
    assert _with_arc(FULL, np.array([1.0] * 10 + [0.0] * 62), 0.9).sweep == pytest.approx(9 * 2 * np.pi / 72)
    single = _with_arc(FULL, np.eye(72)[30], 0.9)
    assert (single.sweep, single.mid_azimuth) == (pytest.approx(MIN_SWEEP), pytest.approx(30 * 2 * np.pi / 72))
    none = _with_arc(FULL, np.eye(72)[30], 1.9)
    assert (none.sweep, none.mid_azimuth) == (pytest.approx(MIN_SWEEP), single.mid_azimuth)
    assert _with_arc(FULL, np.full(72, 0.8), 0.9).full
    assert not _with_arc(FULL, np.array([1.0] * 71 + [0.7]), 0.9).full


@pytest.mark.usefixtures("fewer")
@pytest.mark.parametrize("count", [0, 1, 3])
def test_any_scene_has_an_orbit(count):
    splats = Splats(
        means=np.full((count, 3), 1e5, np.float32),
        quats=np.tile(np.float32([1, 0, 0, 0]), (count, 1)),
        scales=np.full((count, 3), -20, np.float32),
        opacities=np.zeros(count, np.float32),
        sh0=np.zeros((count, 3), np.float32),
        shN=np.empty((count, 0, 3), np.float32),
    )
    for camera in find_orbit(splats, width=40, height=30).loop_cameras(4, 40, 30):
        assert np.isfinite(render(splats, camera)[0]).all()


def test_images_without_pixels_are_refused_and_the_work_can_be_stopped(tall_box):
    with pytest.raises(InvalidViewsError, match="at least 1x1 pixels, not 0x9"):
        find_orbit(tall_box, width=0, height=9)

    def stop(stage, fraction):
        raise Cancelled("stopped")

    with pytest.raises(Cancelled):
        find_orbit(tall_box, progress=stop)
