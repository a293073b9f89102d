"""Properties of all functions that place cameras. Oracle: finite images, arguments that make no sense."""

import numpy as np
import pytest
from helpers.fewer_cameras import try_fewer
from helpers.hollow_scenes import box

from kissgs.cameras import render as camera_paths
from kissgs.cameras.render import find_orbit
from kissgs.cameras.virtual.samples import random_poses, scene_views
from kissgs.cameras.virtual.select import virtual_views
from kissgs.core.context import Context
from kissgs.core.errors import Cancelled, InvalidViewsError
from kissgs.core.splats import Splats
from kissgs.rendering.rasterizer import render


def cameras_of(place, scene, *, side=32, count=9, **options):
    if place is not virtual_views:  # the public function
        options = {"context": Context(**options)}
    if place is find_orbit:
        return place(scene, width=side, height=side, **options).loop_cameras(count, side, side)
    size = {"side": side} if place is random_poses else {"width": side, "height": side}
    return [view.camera for view in place(scene, **size, count=count, **options).all]


places = pytest.mark.parametrize("place", [virtual_views, scene_views, random_poses, find_orbit])


@pytest.fixture(autouse=True)
def fewer(monkeypatch):
    try_fewer(monkeypatch, azimuths=4, radii=(1.1,))
    for name, value in (("RADII", (1.1, 2.0)), ("COARSE_STEPS", 12), ("FINE_STEPS", 24)):
        monkeypatch.setattr(camera_paths, name, value)


@places
@pytest.mark.quick(2)
def test_cameras_are_the_same_for_any_number_of_threads(place):
    one, many = (cameras_of(place, box((0.5, 1.5, 0.3), 1000, 0.1), threads=threads) for threads in (1, 3))
    for first, second in zip(one, many, strict=True):
        assert np.array_equal(first.viewmat, second.viewmat)
        assert np.array_equal(first.K, second.K)


@places
@pytest.mark.parametrize(
    ("count", "size", "offset", "log_scale", "opacity"),
    [
        (0, 1, 0, 0, 0),
        (1, 1, 1e6, -30, 13.8),
        (2, 0, 0, -30, 0),
        (7, 1e-6, 0, -15, 3),
        (8, 1e6, 1e6, 10, 3),
        (9, 1, 0, 30, 3),
        (9, 1, 0, -3, -13.8),
        (40, 1e-6, 1e6, -3, -5),
    ],
)
@pytest.mark.quick(17)  # each other one, and of the last two places the others
def test_any_scene_gets_cameras(place, count, size, offset, log_scale, opacity):
    rng = np.random.default_rng(0)
    splats = Splats(
        means=(rng.normal(0, 1, (count, 3)) * size + offset).astype(np.float32),
        quats=rng.normal(0, 1, (count, 4)).astype(np.float32),
        scales=np.full((count, 3), log_scale, np.float32),
        opacities=np.full(count, opacity, np.float32),
        sh0=rng.normal(0, 1, (count, 3)).astype(np.float32),
        shN=np.empty((count, 0, 3), np.float32),
    )
    cameras = cameras_of(place, splats)
    assert 2 <= len(cameras) <= 4 * 9  # random poses are more where there are several regions
    for camera in cameras:
        assert np.isfinite(render(splats, camera)[0]).all()


@places
@pytest.mark.parametrize("wrong", [{"count": 0}, {"side": 0}, {"side": -1}])
def test_numbers_below_one_are_refused(place, wrong):
    with pytest.raises(InvalidViewsError, match="at least 1 image of at least 1x1 pixels"):
        cameras_of(place, box((1, 1, 1), 10), **wrong)


@places
def test_progress_increases_and_can_stop_the_work(place):
    events = []

    def stop(stage, fraction):
        events.append((stage, fraction))
        if len(events) == 3:
            raise Cancelled("stopped")

    with pytest.raises(Cancelled):
        cameras_of(place, box((1, 1, 1), 100), progress=stop)
    assert [stage for stage, _ in events] == ["cameras"] * 3
    assert events == sorted(events)
