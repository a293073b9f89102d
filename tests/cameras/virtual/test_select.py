"""Oracle: scenes made so that it is known where a visitor would stand, and the real cameras of a real one."""

import numpy as np
import pytest
from helpers.fewer_cameras import try_fewer
from helpers.hollow_scenes import box, surface

from kissgs import sample_scene
from kissgs.cameras.captures.load import load_views
from kissgs.cameras.virtual.scene_bounds import scene_bounds, weighted_median
from kissgs.cameras.virtual.select import best_view, virtual_views
from kissgs.core.errors import Cancelled, InvalidViewsError
from kissgs.core.splats import Splats, clean
from kissgs.io.ply import read_ply
from kissgs.rendering.rasterizer import render


@pytest.fixture
def fewer(monkeypatch):
    try_fewer(monkeypatch)


def everything(views):
    return sorted(views.train + views.test, key=lambda view: view.name)


def turned(splats, matrix):
    """The scene after a rotation of the world whose quaternion is easily had: a quarter or half turn about x."""
    half_angle = 0.5 * np.arctan2(matrix[2, 1], matrix[1, 1])
    w, x = np.cos(half_angle), np.sin(half_angle)
    a, b, c, d = splats.quats.astype(np.float64).T
    quats = np.stack([w * a - x * b, w * b + x * a, w * c - x * d, w * d + x * c], axis=1)
    means = splats.means @ matrix.T.astype(np.float32)
    return Splats(
        means=means,
        quats=quats.astype(np.float32),
        scales=splats.scales,
        opacities=splats.opacities,
        sh0=splats.sh0,
        shN=np.empty((len(splats), 0, 3), np.float32),
    )


@pytest.fixture(scope="module")
def table():
    return sample_scene(20_000, sh_degree=0)


@pytest.mark.usefixtures("fewer")
def test_views_are_split_named_and_of_the_size_asked_for(table):
    views = virtual_views(table, width=200, height=120, count=17)
    assert [view.name for view in everything(views)] == [f"virtual_{n:02}" for n in range(17)]
    assert [view.name for view in views.test] == ["virtual_00", "virtual_08", "virtual_16"]
    for view in everything(views):
        assert (view.camera.width, view.camera.height) == (200, 120)
        assert view.camera.K[0, 0] == view.camera.K[1, 1] == pytest.approx(100 / np.tan(np.radians(30)))
        assert view.photo is None
    assert len({tuple(view.camera.viewmat.ravel()) for view in everything(views)}) == 17


@pytest.mark.usefixtures("fewer")
def test_the_same_scene_gives_the_same_cameras_for_any_number_of_threads(table):
    first, second = (virtual_views(table, count=8, threads=threads) for threads in (1, 3))
    for one, other in zip(everything(first), everything(second), strict=True):
        assert np.array_equal(one.camera.viewmat, other.camera.viewmat)


@pytest.mark.usefixtures("fewer")
def test_pictures_are_full_and_level_where_the_scene_surrounds(table):
    up = np.array([0.0, -1.0, 0.0])
    for view in everything(virtual_views(table, width=64, height=48, count=16)):
        _, alpha = render(table, view.camera)
        assert alpha.mean() > 0.85
        assert -view.camera.viewmat[1, :3] @ up > 0.7, "the camera is upright"
        assert view.camera.position @ up > -0.1, "and above the table"


@pytest.mark.usefixtures("fewer")
def test_an_object_is_seen_whole_from_all_around():
    half = np.array([0.5, 1.5, 0.3])
    thing = box(half, 5000, 0.1)
    views = everything(virtual_views(thing, width=96, height=72, count=16))
    corners = np.array(np.meshgrid(*zip(-half, half, strict=True))).reshape(3, -1).T
    whole = 0
    for view in views:
        assert (np.abs(view.camera.position) > half).any(), "the camera is outside"
        seen = corners @ view.camera.viewmat[:3, :3].T + view.camera.viewmat[:3, 3]
        assert (seen[:, 2] > 0).all()
        pixels = seen @ view.camera.K.T
        pixels = pixels[:, :2] / pixels[:, 2:]
        whole += bool(((pixels > 0) & (pixels < [96, 72])).all())
        _, alpha = render(thing, view.camera)
        assert alpha.mean() > 0.05
    assert whole >= len(views) / 2
    azimuths = np.arctan2(*np.array([view.camera.position[[0, 2]] for view in views]).T)
    assert np.diff(np.sort(azimuths)).max() < np.pi / 2


@pytest.mark.usefixtures("fewer")
def test_tall_pictures_know_an_object_from_a_scene():
    """Narrow pictures were filled by it, so that it was taken for a scene with a background."""
    half = np.array([0.5, 1.5, 0.3])
    corners = np.array(np.meshgrid(*zip(-half, half, strict=True))).reshape(3, -1).T
    view = best_view(box(half, 2000, 0.15), width=36, height=96, count=8)
    pixels = (corners @ view.camera.viewmat[:3, :3].T + view.camera.viewmat[:3, 3]) @ view.camera.K.T
    pixels = pixels[:, :2] / pixels[:, 2:]
    assert ((pixels > 0) & (pixels < [36, 96])).all()


@pytest.mark.usefixtures("fewer")
def test_the_best_view_is_one_of_all_and_no_close_up():
    thing = box((0.5, 1.5, 0.3), 2000, 0.15)
    options = {"width": 60, "height": 40, "count": 12}
    best, views = best_view(thing, **options), everything(virtual_views(thing, **options))
    (same,) = [view for view in views if view.name == best.name]
    assert np.array_equal(best.camera.viewmat, same.camera.viewmat)
    assert np.array_equal(best.camera.K, same.camera.K)
    distances = [np.linalg.norm(view.camera.position) for view in views]
    assert np.linalg.norm(best.camera.position) > 0.8 * max(distances)


@pytest.mark.usefixtures("fewer")
def test_a_room_is_seen_from_inside():
    half = np.array([4.0, 1.4, 3.0])
    room = box(half, 10_000, 0.12)
    for view in everything(virtual_views(room, width=64, height=48, count=16)):
        assert (np.abs(view.camera.position) < half - 0.05).all()
        _, alpha = render(room, view.camera)
        assert alpha.mean() > 0.9


def test_floaters_and_a_far_sky_do_not_move_the_middle():
    rng = np.random.default_rng(0)
    far = surface(rng.normal(0, 40, (2000, 3)) + 60, np.zeros(2000, int), 5.0)
    arrays = {name: np.concatenate([getattr(box((1, 1, 1)), name), getattr(far, name)]) for name in Splats.__slots__}
    scene = scene_bounds(Splats(**arrays))
    assert np.abs(scene.centre).max() < 0.2
    assert 0.5 < scene.radius < 2


@pytest.mark.parametrize(
    ("matrix", "up"),
    [
        (np.eye(3), (0, -1, 0)),
        (np.diag([1.0, -1, -1]), (0, 1, 0)),
        (np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]]), (0, 0, 1)),
    ],
)
def test_up_is_found_in_files_of_all_customs(table, matrix, up):
    found = scene_bounds(turned(table, matrix)).up
    assert found @ up > np.cos(np.radians(3))


def test_the_side_that_was_photographed_is_found(shared_data):
    """Behind the fox is a wall: none of its cameras stood there, none of ours should."""
    splats, _ = clean(read_ply(shared_data / "fox" / "point_cloud.ply"))
    real = load_views(shared_data / "fox")
    looks = np.array([view.camera.viewmat[2, :3] for view in real.train])
    for view in everything(virtual_views(splats)):
        nearest = (looks @ view.camera.viewmat[2, :3]).max()
        assert nearest > np.cos(np.radians(50)), f"{view.name} looks {np.degrees(np.arccos(nearest)):.0f}° off"


@pytest.mark.usefixtures("fewer")
def test_cameras_are_never_inside_matter(shared_data):
    splats, _ = clean(read_ply(shared_data / "guitar" / "guitar.ply"))
    scene = scene_bounds(splats)
    opaque = splats.means[splats.opacities > 0]
    for view in everything(virtual_views(splats)):
        nearest = np.linalg.norm(opaque - view.camera.position, axis=1).min()
        assert nearest > 0.2 * scene.radius


@pytest.mark.parametrize(
    ("count", "size", "offset", "log_scale", "opacity"),
    [
        (0, 1, 0, 0, 0),
        (1, 1, 0, -3, 3),
        (1, 1, 1e6, -30, 13.8),
        (2, 0, 0, -30, 0),
        (7, 1e-6, 0, -15, 3),
        (8, 1e6, 1e6, 10, 3),
        (9, 1, 0, 30, 3),
        (9, 1, 0, -3, -13.8),
        (40, 1e-6, 1e6, -3, -5),
    ],
)
def test_any_scene_gets_cameras(monkeypatch, count, size, offset, log_scale, opacity):
    try_fewer(monkeypatch, azimuths=4, radii=(1.1,))
    rng = np.random.default_rng(0)
    splats = Splats(
        means=(rng.normal(0, 1, (count, 3)) * size + offset).astype(np.float32),
        quats=rng.normal(0, 1, (count, 4)).astype(np.float32),
        scales=np.full((count, 3), log_scale, np.float32),
        opacities=np.full(count, opacity, np.float32),
        sh0=rng.normal(0, 1, (count, 3)).astype(np.float32),
        shN=np.empty((count, 0, 3), np.float32),
    )
    views = virtual_views(splats, width=40, height=30, count=9)
    assert len(everything(views)) == 9
    assert len(views.test) == 2
    for view in everything(views):
        image, _ = render(splats, view.camera)
        assert np.isfinite(image).all()


@pytest.mark.usefixtures("fewer")
def test_one_view_is_for_training():
    views = virtual_views(box((1, 1, 1), 500), count=1)
    assert (len(views.train), len(views.test)) == (1, 0)


@pytest.mark.parametrize("wrong", [{"count": 0}, {"width": 0}, {"height": -1}])
def test_impossible_sizes_are_refused(wrong):
    with pytest.raises(InvalidViewsError, match="at least 1 view"):
        virtual_views(box((1, 1, 1), 10), **wrong)


@pytest.mark.usefixtures("fewer")
def test_progress_goes_up_to_one_and_can_stop_the_work(table):
    told = []
    virtual_views(table, count=4, progress=lambda stage, fraction: told.append((stage, fraction)))
    assert {stage for stage, _ in told} == {"cameras"}
    fractions = [fraction for _, fraction in told]
    assert fractions == sorted(fractions)
    assert fractions[-1] == 1

    def stop(stage, fraction):
        raise Cancelled("enough")

    with pytest.raises(Cancelled):
        virtual_views(table, progress=stop)


def test_weighted_medians():
    values = np.array([3.0, 1.0, 2.0])
    assert weighted_median(values, np.ones(3)) == 2
    assert weighted_median(values, np.array([9.0, 1, 1])) == 3
    assert weighted_median(values, np.ones(3), 0.99) == 3
    assert weighted_median(values, np.ones(3), 0.01) == 1
