"""Oracle: scenes whose inside and outside are known by construction, and the cameras of a real capture."""

import numpy as np
import pytest
from helpers.fewer_cameras import try_fewer
from helpers.hollow_scenes import box

from kissgs import sample_scene
from kissgs.cameras.captures.load import load_views
from kissgs.cameras.virtual.select import best_view, scene_bounds, virtual_views
from kissgs.core.splats import clean
from kissgs.io.ply import read_ply
from kissgs.rendering.rasterizer import render


@pytest.fixture
def fewer(monkeypatch):
    try_fewer(monkeypatch)


def by_name(views):
    return sorted(views.train + views.test, key=lambda view: view.name)


@pytest.fixture(scope="module")
def table():
    return sample_scene(8000, sh_degree=0)


@pytest.mark.usefixtures("fewer")
def test_views_are_split_named_and_of_the_requested_size(table):
    views = virtual_views(table, width=200, height=120, count=17)
    assert [view.name for view in by_name(views)] == [f"virtual_{n:02}" for n in range(17)]
    assert [view.name for view in views.test] == ["virtual_00", "virtual_08", "virtual_16"]
    for view in by_name(views):
        assert (view.camera.width, view.camera.height) == (200, 120)
        assert view.camera.K[0, 0] == view.camera.K[1, 1] == pytest.approx(100 / np.tan(np.radians(30)))
        assert view.photo is None
    assert len({tuple(view.camera.viewmat.ravel()) for view in by_name(views)}) == 17


@pytest.mark.usefixtures("fewer")
def test_images_of_a_scene_under_a_sky_are_full_and_upright(table):
    up = np.array([0.0, -1.0, 0.0])
    for view in by_name(virtual_views(table, width=64, height=48, count=16)):
        _, alpha = render(table, view.camera)
        assert alpha.mean() > 0.85
        assert -view.camera.viewmat[1, :3] @ up > 0.7, "the camera is upright"
        assert view.camera.position @ up > -0.1, "and above the table"


@pytest.mark.usefixtures("fewer")
def test_an_object_is_seen_whole_from_all_sides():
    half = np.array([0.5, 1.5, 0.3])
    tall_box = box(half, 5000, 0.1)
    views = by_name(virtual_views(tall_box, width=96, height=72, count=16))
    corners = np.array(np.meshgrid(*zip(-half, half, strict=True))).reshape(3, -1).T
    whole = 0
    for view in views:
        assert (np.abs(view.camera.position) > half).any(), "the camera is outside"
        seen = corners @ view.camera.viewmat[:3, :3].T + view.camera.viewmat[:3, 3]
        assert (seen[:, 2] > 0).all()
        pixels = seen @ view.camera.K.T
        pixels = pixels[:, :2] / pixels[:, 2:]
        whole += bool(((pixels > 0) & (pixels < [96, 72])).all())
        _, alpha = render(tall_box, view.camera)
        assert alpha.mean() > 0.05
    assert whole >= len(views) / 2
    azimuths = np.arctan2(*np.array([view.camera.position[[0, 2]] for view in views]).T)
    assert np.diff(np.sort(azimuths)).max() < np.pi / 2


@pytest.mark.usefixtures("fewer")
def test_an_object_in_portrait_images_is_not_taken_for_a_background():
    """The object fills narrow images, and once was treated as a scene with a background."""
    half = np.array([0.5, 1.5, 0.3])
    corners = np.array(np.meshgrid(*zip(-half, half, strict=True))).reshape(3, -1).T
    view = best_view(box(half, 2000, 0.15), width=36, height=96)
    pixels = (corners @ view.camera.viewmat[:3, :3].T + view.camera.viewmat[:3, 3]) @ view.camera.K.T
    pixels = pixels[:, :2] / pixels[:, 2:]
    assert ((pixels > 0) & (pixels < [36, 96])).all()


@pytest.mark.usefixtures("fewer")
def test_the_best_view_is_one_of_all_views_and_not_a_close_up():
    tall_box = box((0.5, 1.5, 0.3), 2000, 0.15)
    best, views = (place(tall_box, width=60, height=40) for place in (best_view, virtual_views))
    views = by_name(views)
    (same,) = [view for view in views if view.name == best.name]
    assert np.array_equal(best.camera.viewmat, same.camera.viewmat)
    assert np.array_equal(best.camera.K, same.camera.K)
    distances = [np.linalg.norm(view.camera.position) for view in views]
    assert np.linalg.norm(best.camera.position) > 0.8 * max(distances)


@pytest.mark.usefixtures("fewer")
def test_a_room_is_seen_from_inside():
    half = np.array([4.0, 1.4, 3.0])
    room = box(half, 5000, 0.15)
    for view in by_name(virtual_views(room, width=64, height=48, count=16)):
        assert (np.abs(view.camera.position) < half - 0.05).all()
        _, alpha = render(room, view.camera)
        assert alpha.mean() > 0.9


@pytest.mark.quick(0)
def test_the_photographed_side_is_found(shared_data):
    """Behind the fox is a wall: no photograph was taken from there, so no virtual camera should be there."""
    splats, _ = clean(read_ply(shared_data / "fox" / "point_cloud.ply"))
    real = load_views(shared_data / "fox")
    directions = np.array([view.camera.viewmat[2, :3] for view in real.train])
    for view in by_name(virtual_views(splats)):
        nearest = (directions @ view.camera.viewmat[2, :3]).max()
        assert nearest > np.cos(np.radians(50)), f"{view.name} looks {np.degrees(np.arccos(nearest)):.0f}° off"


@pytest.mark.quick(0)
@pytest.mark.usefixtures("fewer")
def test_cameras_are_not_next_to_opaque_gaussians(shared_data):
    splats, _ = clean(read_ply(shared_data / "guitar" / "guitar.ply"))
    bounds = scene_bounds(splats)
    opaque = splats.means[splats.opacities > 0]
    for view in by_name(virtual_views(splats)):
        nearest = np.linalg.norm(opaque - view.camera.position, axis=1).min()
        assert nearest > 0.2 * bounds.radius
