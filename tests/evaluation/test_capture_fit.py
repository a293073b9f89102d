"""Oracle: a scene moved by SciPy, and photographs that are renderings of the scene before it was moved."""

import json
from dataclasses import replace

import numpy as np
import pytest
from helpers.captured_scene import SCENE as CAPTURED
from helpers.captured_scene import camera
from helpers.command_line import failure, run
from helpers.reference_cameras import Pose, point_bytes, write_binary, write_json
from PIL import Image
from scipy.spatial.transform import Rotation

import kissgs
from kissgs.cameras.captures.colmap import gsplat_similarities
from kissgs.cameras.views import View, Views, black
from kissgs.core.errors import InvalidViewsError
from kissgs.evaluation.evaluate import fitting_views, in_scene_frame
from kissgs.rendering.rasterizer import render

SCENE = replace(CAPTURED, shN=np.empty((len(CAPTURED), 0, 3), np.float32))
TURN, SHIFT, SCALE = Rotation.from_rotvec([0.7, -0.4, 1.9]), np.array([4.3, -0.2, -3.0]), 0.31
APPLIED = np.array([[0, 1, 0, 0.5], [1, 0, 0, 0], [0, 0, -1, 0], [0, 0, 0, 1.0]])
DATAPARSER = np.c_[TURN.as_matrix(), SHIFT]
SIZE = (60, 40)
CAMERAS = [camera(0.3 * n, SIZE) for n in range(4)]


def moved_scene(turn=TURN, shift=SHIFT, scale=SCALE):
    """Return the scene in nerfstudio's coordinates, s (R p + t)."""
    quats = turn * Rotation.from_quat(SCENE.quats[:, [1, 2, 3, 0]])
    return replace(
        SCENE,
        means=np.float32(scale * (turn.apply(SCENE.means) + shift)),
        scales=np.float32(SCENE.scales + np.log(scale)),
        quats=np.float32(quats.as_quat()[:, [3, 0, 1, 2]]),
    )


def rendered(scene, found):
    return np.clip(render(scene, found)[0], 0, 1)


def write_photos(folder, change=lambda image: image, **options):
    folder.mkdir(parents=True)
    for n, each in enumerate(CAMERAS):
        image = np.rint(255 * np.clip(change(rendered(SCENE, each)), 0, 1)).astype(np.uint8)
        Image.fromarray(image).save(folder / f"{n}.png", **options)


def write_transforms(folder, applied=None):
    matrices = [np.linalg.inv(each.viewmat) @ np.diag([1.0, -1, -1, 1]) for each in CAMERAS]
    if applied is not None:
        matrices = [applied @ matrix for matrix in matrices]
    frames = [{"file_path": f"images/{n}.png", "transform_matrix": m.tolist()} for n, m in enumerate(matrices)]
    extra = {} if applied is None else {"applied_transform": applied[:3].tolist()}
    document = {"fl_x": float(CAMERAS[0].K[0, 0]), "w": SIZE[0], "h": SIZE[1], "frames": frames, **extra}
    return write_json(folder / "transforms.json", document)


def write_dataparser(folder, transform=DATAPARSER):
    write_json(folder / "dataparser_transforms.json", {"transform": np.array(transform).tolist(), "scale": SCALE})


def write_colmap(folder):
    images = [
        Pose(f"{n}.png", Rotation.from_matrix(each.viewmat[:3, :3]), each.viewmat[:3, 3])
        for n, each in enumerate(CAMERAS)
    ]
    focal = float(CAMERAS[0].K[0, 0])
    write_binary(folder / "sparse" / "0", {1: ("PINHOLE", *SIZE, (focal, focal, SIZE[0] / 2, SIZE[1] / 2))}, images)


@pytest.mark.parametrize(
    ("kind", "photographs"),
    [
        ("transforms", True),
        ("transforms", False),
        ("its file", False),
        ("applied", True),
        ("oldest", True),
        ("colmap", True),
    ],
)
def test_cameras_are_moved_into_nerfstudios_frame_where_the_scene_is_there(tmp_path, kind, photographs):
    """nerfstudio writes the product with applied_transform; its oldest versions left that out."""
    if photographs:
        write_photos(tmp_path / "images")
    applied = APPLIED if kind in ("applied", "oldest") else None
    path = tmp_path if kind != "its file" else tmp_path / "transforms.json"
    if kind == "colmap":
        write_colmap(tmp_path)
    else:
        write_transforms(tmp_path, applied)
    transform = DATAPARSER if kind != "oldest" else (np.r_[DATAPARSER, [[0, 0, 0, 1]]] @ np.linalg.inv(APPLIED))[:3]
    write_dataparser(tmp_path, transform)
    views = kissgs.load_views(path, hold_out=2)
    found = in_scene_frame(moved_scene(), views)
    assert "moved by dataparser_transforms.json" in found.note
    assert not found.similarities
    for view in found.all:
        expected = rendered(SCENE, CAMERAS[int(view.name.removeprefix("images/")[0])])
        np.testing.assert_allclose(rendered(moved_scene(), view.camera), expected, atol=0.02)


def test_the_run_of_a_scene_has_nerfstudios_frame(tmp_path):
    """nerfstudio writes the transform beside the folder of checkpoints, not into the capture."""
    write_photos(tmp_path / "data/images")
    write_transforms(tmp_path / "data")
    run_folder = tmp_path / "outputs/data/splatfacto/2026-01-01"
    (run_folder / "nerfstudio_models").mkdir(parents=True)
    write_dataparser(run_folder)
    (run_folder / "config.yml").touch()
    for scene in (run_folder / "nerfstudio_models/step-000029999.ckpt", run_folder / "splat.ply"):
        views = kissgs.load_views(tmp_path / "data", scene=scene)
        assert "moved by dataparser_transforms.json" in fitting_views(moved_scene(), views)[1]
    for text in ("no JSON", '{"transform": [[1,0,0,9],[0,1,0,9],[0,0,1,9]], "scale": 3}'):
        write_dataparser(tmp_path / "data")
        (run_folder / "dataparser_transforms.json").write_text(text)
        views = kissgs.load_views(tmp_path / "data", scene=scene)
        assert "moved by dataparser_transforms.json" in fitting_views(moved_scene(), views)[1], "the capture's own"
    kissgs.save(moved_scene(), scene)
    settings = kissgs.Settings.from_preset("fast")
    report = kissgs.compress(scene, settings=settings, evaluate=True, views=tmp_path / "data").report
    assert "moved by dataparser_transforms.json" in report.note


def test_evaluate_moves_cameras_too(tmp_path):
    write_photos(tmp_path / "images")
    write_transforms(tmp_path)
    write_dataparser(tmp_path)
    found = kissgs.evaluate(moved_scene(), moved_scene(), kissgs.load_views(tmp_path))
    assert found.mean.reference.psnr > 50
    assert "dataparser_transforms.json" in found.note


def test_cameras_stay_where_the_scene_is_in_their_coordinates(tmp_path):
    write_photos(tmp_path / "images")
    write_transforms(tmp_path)
    write_dataparser(tmp_path)
    views = kissgs.load_views(tmp_path)
    found, note = fitting_views(SCENE, views)
    assert found.train == views.train  # the same objects
    assert "dataparser_transforms.json is not applied" in note


def test_a_scene_of_the_colmap_model_fits_the_transforms_that_nerfstudio_made_of_it(tmp_path):
    write_photos(tmp_path / "images")
    write_transforms(tmp_path, APPLIED)
    found, note = fitting_views(SCENE, kissgs.load_views(tmp_path, hold_out=0))
    assert "applied_transform" in note
    for view, expected in zip(found.train, CAMERAS, strict=True):
        np.testing.assert_allclose(view.camera.viewmat, expected.viewmat, atol=1e-9)


@pytest.mark.parametrize(
    "content", ["[", '{"transform": [[1, 0, 0, 0]], "scale": 1}', json.dumps({"transform": np.ones((3, 4)).tolist()})]
)
def test_a_damaged_file_of_transforms_is_named(tmp_path, content):
    write_transforms(tmp_path)
    (tmp_path / "dataparser_transforms.json").write_text(content)
    with pytest.raises(InvalidViewsError, match=r"dataparser_transforms\.json"):
        kissgs.load_views(tmp_path)


def gsplat_scene(points, signs):
    """Return the scene as gsplat's trainer normalises it: its examples/datasets/normalize.py in other words."""
    poses = [np.linalg.inv(each.viewmat) for each in CAMERAS]
    up = -np.mean([pose[:3, 1] for pose in poses], axis=0)
    axis = np.cross(up, (0, -1, 0))
    angle = np.arctan2(np.linalg.norm(axis), -up[1])
    upright = Rotation.from_rotvec(axis / np.linalg.norm(axis) * angle)
    centres = upright.apply([pose[:3, 3] for pose in poses])
    views = upright.apply([pose[:3, 2] for pose in poses])
    middle = np.median([c - v * (v @ c) for c, v in zip(centres, views, strict=True)], axis=0)
    scale = 1 / np.median(np.linalg.norm(centres - middle, axis=1))
    points = scale * (upright.apply(points) - middle)
    axes = np.linalg.svd(points - points.mean(axis=0), full_matrices=False)[2]
    axes *= np.array(signs)[:, None] * (-1 if np.linalg.det(axes) < 0 else 1)
    turn = Rotation.from_matrix(axes) * upright
    shift = Rotation.from_matrix(axes).apply(-middle - np.median(points, axis=0) / scale)
    return moved_scene(turn, shift, scale)


POINTS = np.random.default_rng(5).normal((1, -0.5, 2), (4, 0.3, 1.5), (201, 3)) + [(0, 0, n / 99) for n in range(201)]


def write_points(folder, points=POINTS):
    write_colmap(folder)
    (folder / "sparse/0/points3D.bin").write_bytes(point_bytes(points))


@pytest.mark.parametrize("signs", [(1, 1, 1), (1, -1, -1), (-1, 1, -1), (-1, -1, 1)])
def test_cameras_are_moved_into_gsplats_frame_where_the_scene_is_there(tmp_path, signs):
    """The signs of its principal axes depend on the library that computes them, and on gsplat's version."""
    write_photos(tmp_path / "images")
    write_points(tmp_path)
    scene = gsplat_scene(POINTS, signs)
    views = kissgs.load_views(tmp_path)
    fitting, note = fitting_views(scene, views)
    assert "moved by gsplat's normalisation" in note
    for view in (*in_scene_frame(scene, views).all, *fitting.all):
        expected = rendered(SCENE, CAMERAS[int(view.name[0])])
        np.testing.assert_allclose(rendered(scene, view.camera), expected, atol=0.02)


def test_a_scene_in_the_models_coordinates_needs_no_points(tmp_path):
    write_photos(tmp_path / "images")
    write_points(tmp_path)
    (tmp_path / "sparse/0/points3D.bin").write_bytes(b"nothing that could be read")
    views = kissgs.load_views(tmp_path)
    found, note = fitting_views(SCENE, views)
    assert (found.train, note) == (views.train, "")  # the same objects


def test_gsplats_frame_is_not_guessed_without_photographs_that_show_the_scene(tmp_path):
    """Cameras around a scene show as much of it when they are turned by half."""
    write_points(tmp_path)
    scene = gsplat_scene(POINTS, (1, 1, 1))
    assert "gsplat's" not in fitting_views(scene, kissgs.load_views(tmp_path))[1]
    write_photos(tmp_path / "images", OTHERS["noise"])
    with pytest.raises(InvalidViewsError, match=r"or its COLMAP model with its points3D if gsplat did"):
        fitting_views(scene, kissgs.load_views(tmp_path))


def test_a_wrong_scene_does_not_pass_in_gsplats_frame_for_parts_of_its_images(tmp_path):
    """A small object in front of walls once passed, since only the pixels that it covers were compared."""
    write_photos(tmp_path / "images", lambda image: 0 * image + 0.7)
    write_points(tmp_path, POINTS + 50)  # in whose frame the model's own cameras see nothing of the scene
    scene, views = gsplat_scene(POINTS + 50, (1, 1, 1)), kissgs.load_views(tmp_path)
    with pytest.raises(InvalidViewsError, match="shows any of the scene"):
        fitting_views(replace(scene, sh0=np.full_like(scene.sh0, 0.7)).select(slice(1400, None)), views)


def test_damaged_points_stop_only_a_scene_that_nothing_else_shows(tmp_path):
    write_photos(tmp_path / "images")
    write_points(tmp_path)
    (tmp_path / "sparse/0/points3D.bin").write_bytes(b"nothing that could be read")
    views, scene = kissgs.load_views(tmp_path), moved_scene()
    with pytest.raises(InvalidViewsError, match=r"points3D\.bin.*--force-views"):
        fitting_views(scene, views)
    assert fitting_views(scene, views, force=True)[0].train == views.train
    assert "points3D.bin" in in_scene_frame(scene, views).note


@pytest.mark.parametrize("data", [point_bytes(POINTS)[:-9], point_bytes(POINTS) + b"1", b"\xff" * 80])
def test_damaged_points_are_named(tmp_path, data):
    path = tmp_path / "points3D.bin"
    path.write_bytes(data)
    with pytest.raises(InvalidViewsError, match=r"points3D\.bin.* (truncated|last point|declares)"):
        gsplat_similarities(path, [each.viewmat for each in CAMERAS])


def test_points_of_a_model_in_text(tmp_path):
    write_photos(tmp_path / "images")
    write_colmap(tmp_path)
    path = tmp_path / "sparse/0/points3D.txt"
    lines = [f"{n} {x!r} {y!r} {z!r} 9 8 7 0.5 1 2\n" for n, (x, y, z) in enumerate(POINTS.tolist())]
    path.write_text("".join(["# Number of points\n", *lines]))
    viewmats = [each.viewmat for each in CAMERAS]
    found = gsplat_similarities(kissgs.load_views(tmp_path).points, viewmats)
    (tmp_path / "same.bin").write_bytes(point_bytes(POINTS))
    for one, other in zip(found, gsplat_similarities(tmp_path / "same.bin", viewmats), strict=True):
        np.testing.assert_array_equal(one.matrix, other.matrix)
    path.write_text("# Number of points\n1 0.5 0.5\n")
    with pytest.raises(InvalidViewsError, match=r"points3D\.txt, line 2: not a point"):
        gsplat_similarities(path, viewmats)


@pytest.mark.parametrize("points", [POINTS[:1], POINTS[:0], POINTS * np.nan])
def test_points_and_cameras_that_determine_no_frame(tmp_path, points):
    (tmp_path / "points3D.bin").write_bytes(point_bytes(points))
    upright, upside_down = CAMERAS[0].viewmat, np.diag([-1, -1, 1, 1.0]) @ CAMERAS[0].viewmat
    for viewmats in ([each.viewmat for each in CAMERAS], [upright, upside_down]):
        assert gsplat_similarities(tmp_path / "points3D.bin", viewmats) == ()
        (tmp_path / "points3D.bin").write_bytes(point_bytes(POINTS))


def noisy(amount):
    return lambda image: image + np.random.default_rng(0).normal(0, amount, image.shape)


@pytest.mark.parametrize(
    ("change", "noted"),
    [
        (lambda image: image, False),
        (noisy(0.05), False),
        (noisy(0.2), True),
        (lambda image: 0.3 * image, True),
        (lambda image: 2 * image, True),
    ],
    ids=["exact", "grainy", "noisy", "dark", "bright"],
)
def test_captures_of_the_scene_are_accepted(tmp_path, change, noted):
    write_photos(tmp_path / "images", change)
    write_transforms(tmp_path)
    views = kissgs.load_views(tmp_path)
    found, note = fitting_views(SCENE, views)
    assert (found.train, found.test) == (views.train, views.test)
    assert ("differ much" in note) == noted


@pytest.mark.parametrize("background", [None, 1.0])
def test_an_object_that_was_trained_with_masks_is_accepted(tmp_path, background):
    """Around it, the photographs show the rest of the scene, or white, where renderings are black."""
    thing = SCENE.select(np.linalg.norm(SCENE.means - (0, -0.8, 0), axis=1) < 1.5)
    write_photos(tmp_path / "images")
    write_transforms(tmp_path)
    for n, each in enumerate(CAMERAS if background else ()):
        whitened = np.rint(255 * render(thing, each, background=(background,) * 3)[0].clip(0, 1))
        Image.fromarray(whitened.astype(np.uint8)).save(tmp_path / "images" / f"{n}.png")
    assert "differ much" in fitting_views(thing, kissgs.load_views(tmp_path))[1]


OTHERS = {
    "shifted": lambda image: np.roll(image, (11, 17), (0, 1)),
    "inverted": lambda image: 1 - image,
    "noise": lambda image: np.random.default_rng(1).random(image.shape),
}


@pytest.mark.parametrize("change", OTHERS.values(), ids=OTHERS.keys())
def test_a_capture_of_another_scene_is_refused_before_any_work(tmp_path, change):
    write_photos(tmp_path / "images", change)
    write_transforms(tmp_path)
    views = kissgs.load_views(tmp_path)
    for work in (kissgs.compress, kissgs.compact):
        settings = kissgs.Settings(compact={"ratio": 0.5})
        with pytest.raises(InvalidViewsError, match="--force-views"):
            work(SCENE, tmp_path / "a.ply" if work is kissgs.compact else None, settings=settings, views=views)
    assert not (tmp_path / "a.ply").exists()
    found, note = fitting_views(SCENE, views, force=True)
    assert found.train == views.train
    assert "differ much" in note


def test_photographs_that_exif_turns_upright_are_named(tmp_path):
    """They have the size of the camera, so that only their content shows it."""
    exif = Image.Exif()
    exif[0x0112] = 3
    write_photos(tmp_path / "images", lambda image: image[::-1, ::-1], exif=exif)
    write_transforms(tmp_path)
    _, note = fitting_views(SCENE, kissgs.load_views(tmp_path), force=True)
    assert "differ much" in note
    assert "EXIF orientation is ignored here: turn the pixels" in note


def away():
    """Return cameras that have the scene far behind them."""
    shift = np.array([[0.0, 0, 0, 0], [0, 0, 0, 0], [0, 0, 0, -100], [0, 0, 0, 0]])
    return tuple(View(f"{n}", replace(each, viewmat=each.viewmat + shift)) for n, each in enumerate(CAMERAS))


def test_cameras_that_see_nothing_are_refused_with_photographs_and_noted_without(tmp_path):
    """Dark photographs are so like an image of nothing that their PSNR would pass."""
    write_photos(tmp_path / "images", lambda image: 0.1 * image)
    views = Views(away(), (), black(), "turned away")
    assert "shows any" in fitting_views(SCENE, views)[1]
    photographed = tuple(replace(view, photo=tmp_path / "images" / f"{view.name}.png") for view in views.train)
    with pytest.raises(InvalidViewsError, match="shows any"):
        fitting_views(SCENE, replace(views, train=photographed))


def test_unreadable_photographs_and_cameras_alone_are_not_compared(tmp_path):
    views = Views(tuple(View(f"{n}", each) for n, each in enumerate(CAMERAS)), (), black(), "cameras")
    assert "no photograph" in fitting_views(SCENE, views)[1]
    broken = tuple(replace(view, photo=tmp_path / "missing.png") for view in views.train)
    assert "no photograph" in fitting_views(SCENE, replace(views, train=broken))[1]


def test_the_command_refuses_and_forces(tmp_path):
    write_photos(tmp_path / "images", OTHERS["inverted"])
    write_transforms(tmp_path)
    kissgs.save(SCENE, tmp_path / "a.ply")
    command = ["compress", tmp_path / "a.ply", "-p", "fast", "--evaluate", "--json", "--views", tmp_path]
    assert "differ much" in failure(*command)
    forced = json.loads(run(*command, "--force-views").stdout)
    assert "differ much" in forced["note"]
    plain = kissgs.compress(SCENE, settings=kissgs.Settings.from_preset("fast")).to_zip()
    assert (tmp_path / "a.zip").read_bytes() == plain
