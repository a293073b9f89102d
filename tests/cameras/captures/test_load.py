"""Oracle: small captures written by hand, the README of fox, and independent code for the rules of INRIA and COLMAP."""

import zipfile
from argparse import Namespace
from pathlib import Path

import numpy as np
import pytest
from helpers.reference_cameras import PINHOLE, assert_camera, frames, poses, write_json, write_photo, write_text
from PIL import Image

import kissgs
from kissgs.cameras.captures.load import capture_of, is_capture, load_views, pack_capture
from kissgs.core.errors import InvalidViewsError

NAMES = [f"{letter}.jpg" for letter in "jihgfedcba"]
HELD_OUT = ["0001.jpg", "0012.jpg", "0027.jpg", "0042.jpg", "0073.jpg", "0089.jpg", "0110.jpg"]


def capture(folder, camera=PINHOLE, names=NAMES, photos="images", size=None):
    """Write a COLMAP model, and photographs if there is a ``size``."""
    images = poses(names)
    write_text(folder / "sparse" / "0", {1: camera}, images)
    for name in names if size else []:
        write_photo(folder / photos / name, *size)
    return images


def test_fox(shared_data):
    views = load_views(shared_data / "fox", scale=2)
    assert [view.name for view in views.test] == HELD_OUT
    assert len(views.train) == 43
    assert {(view.camera.width, view.camera.height) for view in views.train} == {(540, 960)}
    np.testing.assert_allclose(views.train[0].camera.K, [[714.1977, 0, 270], [0, 714.1977, 480], [0, 0, 1]], atol=1e-4)
    assert views.background.tolist() == [0, 0, 0]
    named = load_views(shared_data / "fox" / "images_2")
    assert [view.photo for view in named.test] == [view.photo for view in views.test]
    assert named.source == views.source
    quarter = load_views(shared_data / "fox").test[0]  # the default scale of a capture without full-size photographs
    with Image.open(shared_data / "fox" / "images_4" / "0001.jpg") as image:
        np.testing.assert_array_equal(quarter.load_photo(), np.asarray(image))


@pytest.mark.parametrize("photos", ["images", "images_4", "input"])
def test_source_names_the_folder_of_photographs(tmp_path, photos):
    """Subfolders of a camera rig are not named, and there is no note."""
    names = ["left/1.jpg", "left/2.jpg", "right/1.jpg"]
    factor = 4 if photos == "images_4" else 1
    capture(tmp_path, names=names, photos=photos, size=(120 // factor, 80 // factor))
    views = load_views(tmp_path)
    assert [view.photo for view in views.train] == [tmp_path / photos / name for name in names[1:]]
    assert (views.train[0].camera.width, views.train[0].camera.height) == (120 // factor, 80 // factor)
    assert views.source == f"COLMAP model {tmp_path}/sparse/0, photographs of {photos}"
    assert views.note == ""


def test_photographs_in_an_unusual_folder_cause_a_note(tmp_path):
    capture(tmp_path, photos="rgb", size=(120, 80))
    views = load_views(tmp_path)
    assert views.source == f"COLMAP model {tmp_path}/sparse/0, no photographs"
    searched = f"searched {tmp_path} for 'images', 'input'"
    assert views.note == f"no photographs were found ({searched}); name their folder with --images"
    with pytest.raises(InvalidViewsError, match=r"^view b.jpg has no photograph, only a camera; add"):
        views.train[0].load_photo()
    small = load_views(tmp_path, scale=4).train[0].camera
    assert (small.width, small.height) == (30, 20)
    views = load_views(tmp_path, images=tmp_path / "rgb")
    assert (views.note, views.source.split(", ")[-1]) == ("", "photographs of rgb")


def test_source_names_all_folders(tmp_path, monkeypatch):
    parts = ["train", "test", "val"]
    documents = [{"w": 12, "h": 8, "fl_x": 10, "frames": frames(poses(["a.png"]), f"{part}/")} for part in parts]
    for part, document in zip(parts, documents, strict=True):
        write_photo(tmp_path / part / "a.png", 12, 8)
        write_json(tmp_path / f"transforms_{part}.json", document)
    assert load_views(tmp_path).source.endswith("photographs of train and test")
    document = documents[0] | {"frames": [frame for document in documents for frame in document["frames"]]}
    path = write_json(tmp_path / "transforms.json", document)
    assert load_views(path).source.endswith("photographs of 3 folders")
    write_photo(tmp_path / "a.png", 12, 8)
    write_json(path, document | {"frames": frames(poses(["a.png"]), "")})
    monkeypatch.chdir(tmp_path)
    assert load_views(type(tmp_path)("transforms.json")).source.endswith(f"photographs of {tmp_path.name}")


@pytest.mark.parametrize(("hold_out", "test"), [(8, "ai"), (3, "adgj"), (2, "acegi"), (0, ""), (100, "a")])
def test_hold_out_selects_by_sorted_name(tmp_path, hold_out, test):
    capture(tmp_path)
    views = load_views(tmp_path, hold_out=hold_out)
    assert [view.name[0] for view in views.test] == list(test)
    assert [view.name[0] for view in views.train] == sorted(set("abcdefghij") - set(test))


def test_a_single_view_is_for_training(tmp_path):
    capture(tmp_path, names=["a.jpg"])
    views = load_views(tmp_path)
    assert (len(views.train), len(views.test)) == (1, 0)


@pytest.mark.parametrize(
    ("size", "resolution", "expected"),
    [
        ((120, 80), None, (120, 80)),
        ((60, 40), None, (60, 40)),
        ((61, 40), None, (61, 40)),
        ((1800, 1200), None, (1600, 1066)),
        ((240, 160), 50, (50, 33)),
        ((240, 160), 240, (240, 160)),
        ((240, 160), 1, (1, 1)),
    ],
)
def test_cameras_have_the_size_of_their_photographs(tmp_path, size, resolution, expected):
    pose = capture(tmp_path, names=["a.jpg"], size=size)[0]
    view = load_views(tmp_path, resolution=resolution).train[0]
    across, down = expected[0] / 120, expected[1] / 80
    K = [[110 * across, 0, 61 * across], [0, 115 * down, 39.5 * down], [0, 0, 1]]
    assert_camera(view.camera, pose, K, *expected)
    assert view.load_photo().shape == (*expected[::-1], 3)


@pytest.mark.parametrize("width", [1601, 1610, 1999, 5187])
def test_reduced_sizes_equal_inrias(tmp_path, width):
    """``int(w / (w / 1600))`` is 1599 for some widths, and published results use these sizes."""
    capture(tmp_path, ("PINHOLE", width, 1000, (900.0, 900.0, width / 2, 500.0)))
    scale = width / 1600
    camera = load_views(tmp_path).train[0].camera
    assert (camera.width, camera.height) == (int(width / scale), int(1000 / scale))
    capture(tmp_path, ("PINHOLE", 1000, width, (900.0, 900.0, 500.0, width / 2)))
    camera = load_views(tmp_path).train[0].camera
    assert (camera.width, camera.height) == (int(1000 / scale), int(width / scale))


def test_a_distorting_lens_is_undistorted(tmp_path):
    """Lines that the lens bends are straight after undistortion, at the positions that the camera gives."""
    size, focal, k1 = (240, 160), 200.0, 0.3
    capture(tmp_path, ("SIMPLE_RADIAL", *size, (focal, 120.0, 80.0, k1)), names=["a.png"])
    v, u = np.mgrid[:160, :240] + 0.5
    x, y = (u - 120) / focal, (v - 80) / focal
    undistorted = np.stack([x, y])
    for _ in range(100):
        undistorted = np.stack([x, y]) / (1 + k1 * (undistorted**2).sum(axis=0))
    grey = 128 + 100 * np.sin(12 * undistorted[0])  # vertical stripes
    photo = np.repeat(grey[:, :, None], 3, axis=2).round().astype(np.uint8)
    (tmp_path / "images").mkdir()
    Image.fromarray(photo).save(tmp_path / "images" / "a.png")
    view = load_views(tmp_path).train[0]
    image, camera = view.load_photo(), view.camera
    assert image.shape == (camera.height, camera.width, 3)
    assert 200 < camera.width < 240
    columns = (np.arange(camera.width) + 0.5 - camera.K[0, 2]) / camera.K[0, 0]
    assert camera.K[0, 0] == focal
    assert np.abs(image[2:-2, 2:-2, 0] - (128 + 100 * np.sin(12 * columns))[2:-2]).max() < 1.6
    half = load_views(tmp_path, resolution=120).train[0]
    assert half.load_photo().shape == (half.camera.height, half.camera.width, 3)
    assert half.camera.width == pytest.approx(camera.width / 2, abs=1.5)


def test_colmap_precedes_transforms(tmp_path):
    capture(tmp_path, names=["colmap.jpg"])
    document = {"w": 120, "h": 80, "fl_x": 100, "frames": frames(poses(["json.jpg"]), "")}
    for name in ("transforms.json", "transforms_train.json"):
        path = write_json(tmp_path / name, document)
        assert [view.name for view in load_views(path).train] == ["json.jpg"]
    assert [view.name for view in load_views(tmp_path).train] == ["colmap.jpg"]
    assert [view.name for view in load_views(tmp_path / "sparse" / "0" / "images.txt").train] == ["colmap.jpg"]


def test_loading_reads_no_pixels(tmp_path):
    capture(tmp_path, names=["a.jpg"], size=(120, 80))
    photo = tmp_path / "images" / "a.jpg"
    photo.write_bytes(photo.read_bytes()[:-100])
    view = load_views(tmp_path).train[0]
    with pytest.raises(InvalidViewsError, match=r"a.jpg is damaged, truncated"):
        view.load_photo()


def message(path, **options):
    with pytest.raises(InvalidViewsError) as caught:
        load_views(path, **options)
    return str(caught.value)


def test_photographs_of_another_aspect_ratio(tmp_path):
    capture(tmp_path, names=["a.jpg"], size=(120, 86))
    assert message(tmp_path) == (
        f"{tmp_path}/images/a.jpg has 120x86 pixels, but its camera ({tmp_path}/sparse/0/images.txt, image 'a.jpg') is "
        "for 120x80, another aspect ratio; name the folder of the cameras' photographs (--images of "
        "kissgs evaluate and render)"
    )


@pytest.mark.parametrize(
    ("orientation", "size", "named"), [(6, (80, 120), True), (1, (80, 120), False), (6, (90, 90), False)]
)
def test_exif_orientation_is_named_where_it_is_the_reason(tmp_path, orientation, size, named):
    """The camera is for 120x80: for what a viewer shows of the photograph, which is stored lying on its side."""
    capture(tmp_path, names=["a.jpg"], size=(120, 80))
    exif = Image.Exif()
    exif[0x0112] = orientation
    Image.new("RGB", size).save(tmp_path / "images" / "a.jpg", exif=exif)
    assert ("EXIF" in message(tmp_path)) == named
    assert "images/a.jpg" in message(tmp_path)


def test_no_capture(tmp_path):
    folders = "in it or in sparse/0, sparse, colmap/sparse/0"
    assert message(tmp_path) == f"{tmp_path} has no cameras: neither a COLMAP model ({folders}) nor a transforms.json"
    assert message(tmp_path / "x") == f"there is no folder {tmp_path}/x; name the folder of a capture"
    (tmp_path / "scene.ply").touch()
    assert message(tmp_path / "scene.ply") == (
        f"{tmp_path}/scene.ply is not a camera file; name the capture's folder or a transforms.json"
    )
    (tmp_path / "images.bin").touch()
    assert message(tmp_path) == f"{tmp_path} has images.bin but no cameras.bin; a COLMAP model needs both"
    assert message(tmp_path / ("x" * 300)).endswith(": file name too long")


@pytest.mark.parametrize(
    ("options", "sentence"),
    [
        ({"scale": 0}, "scale must be 1 or more, not 0"),
        ({"resolution": 0}, "resolution must be 1 or more, not 0"),
        ({"hold_out": -1}, "hold_out must be 0 or more, not -1"),
        ({"hold_out": 1}, "hold_out 1 would leave no training view; give 0 for no held-out views, or 2 or more"),
    ],
)
def test_arguments_out_of_range(tmp_path, options, sentence):
    assert message(tmp_path, **options) == sentence


def trained(folder, **arguments):
    """Write the ``cfg_args`` of INRIA's trainer as it does, with values that are no literals."""
    folder.mkdir(parents=True, exist_ok=True)
    usual = {"sh_degree": 3, "model_path": Path("out"), "images": "images", "resolution": -1, "eval": True}
    (folder / "cfg_args").write_text(str(Namespace(**{**usual, **arguments})))


@pytest.mark.parametrize("white", [True, False])
def test_a_folder_of_inrias_trainer_stands_for_what_it_was_given(tmp_path, white):
    capture(tmp_path / "data", size=(120, 80))
    capture(tmp_path / "data", photos="images_2", size=(60, 40))
    trained(tmp_path / "model", source_path=str(tmp_path / "data"), images="images_2", white_background=white)
    views = load_views(tmp_path / "model")
    assert views.source == f"COLMAP model {tmp_path}/data/sparse/0, photographs of images_2"
    assert views.background.tolist() == [float(white)] * 3
    assert load_views(tmp_path / "model", scale=1).source.endswith("photographs of images")
    trained(tmp_path / "model", source_path=str(tmp_path / "data"))
    assert load_views(tmp_path / "model").source.endswith("photographs of images")


def test_a_synthetic_scene_has_the_background_that_it_was_trained_on(tmp_path):
    document = {"camera_angle_x": 0.7, "frames": frames(poses(["a.png"]), "")}
    write_json(tmp_path / "data/transforms_train.json", document)
    Image.new("RGBA", (20, 20)).save(tmp_path / "data/a.png")
    assert load_views(tmp_path / "data").background.tolist() == [1, 1, 1]
    trained(tmp_path / "model", source_path=str(tmp_path / "data"), white_background=False)
    assert load_views(tmp_path / "model").background.tolist() == [0, 0, 0]


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        ("Namespace(source_path='/no/such/data')", "names no capture that is here: '/no/such/data'; name the"),
        ("Namespace(source_path=open('ran', 'w'))", "names no capture"),
        ("__import__('os').mkdir('ran')", "names no capture"),
        ("Namespace(", "names no capture"),
        ("(" * 5000, "names no capture"),
        ("\0", "names no capture"),
    ],
)
def test_arguments_of_inrias_trainer_are_not_evaluated(tmp_path, monkeypatch, text, sentence):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "cfg_args").write_text(text)
    assert sentence in message(tmp_path)
    assert [path.name for path in tmp_path.iterdir()] == ["cfg_args"]


def test_a_folder_of_inrias_trainer_is_packed_as_it_is_loaded(tmp_path):
    capture(tmp_path / "data", size=(120, 80))
    capture(tmp_path / "data", photos="sharp", size=(60, 40))
    (tmp_path / "data/sparse/0/points3D.bin").write_bytes(bytes(8))
    write_json(tmp_path / "data/dataparser_transforms.json", {"transform": np.eye(4)[:3].tolist(), "scale": 2})
    run = tmp_path / "run"
    run.mkdir()
    write_json(run / "dataparser_transforms.json", {"transform": np.eye(4)[:3].tolist(), "scale": 3})
    (run / "config.yml").touch()
    trained(tmp_path / "model", source_path="../data", images="sharp", eval=False)
    pack_capture(tmp_path / "model", tmp_path / "packed.zip", scene=run / "splat.ply")
    with zipfile.ZipFile(tmp_path / "packed.zip") as archive:
        archive.extractall(tmp_path / "unpacked")
    there, here = load_views(tmp_path / "unpacked", unpacked=True), load_views(tmp_path / "model", scene=run / "s.ply")
    assert "eval=False" in here.note
    for found, wanted in zip(there.all, here.all, strict=True):
        np.testing.assert_array_equal(found.camera.viewmat, wanted.camera.viewmat)
        np.testing.assert_array_equal(found.load_photo(), wanted.load_photo())
    assert [each.matrix[0, 0] for each in there.similarities] == [each.matrix[0, 0] for each in here.similarities]
    assert there.points.read_bytes() == bytes(8)
    trained(tmp_path / "model", source_path=str(tmp_path / "data"), white_background=True)
    with pytest.raises(InvalidViewsError, match=r"background .* cannot be sent to a service; compress the scene here"):
        pack_capture(tmp_path / "model", tmp_path / "packed.zip")


def test_a_downloaded_model_has_the_cameras_it_was_trained_with(tmp_path):
    """Without photographs, or with those in a folder that is named; the capture wins where it is here."""
    folder, data = tmp_path / "model", tmp_path / "data"
    capture(data, size=(120, 80))
    trained(folder, source_path="/no\n/data", white_background=True, eval=False)
    missing = f"{folder}/cfg_args names no capture that is here: '/no\\n/data'"
    assert message(folder) == f"{missing}; name the capture's folder with --views"
    here, entries = load_views(data), []
    for view in reversed(here.all):  # as camera_to_JSON of 3DGS, at twice the size; names lose their endings
        (fx, fy), pose = view.camera.K[[0, 1], [0, 1]], np.linalg.inv(view.camera.viewmat)
        entry = {"img_name": Path(view.name).stem, "width": 240, "height": 160, "rotation": pose[:3, :3].tolist()}
        entries.append({**entry, "position": pose[:3, 3].tolist(), "fx": 2 * fx, "fy": 2 * fy})
    write_json(folder / "cameras.json", entries)
    views = load_views(folder)
    assert views.note.startswith(f"{missing}, so its cameras.json is used; cfg_args says eval=False")
    assert views.note.endswith("name their folder with --images")
    assert (views.background.tolist(), views.has_photographs, is_capture(folder)) == ([1] * 3, False, True)
    with_photographs = load_views(folder, images=data / "images")
    for found in (views, with_photographs, load_views(folder / "cameras.json")):
        assert [view.name for view in found.test] == [Path(view.name).stem for view in here.test]
        for one, other in zip(found.all, here.all, strict=True):
            np.testing.assert_allclose(one.camera.viewmat, other.camera.viewmat, atol=1e-12)
    for one, other in zip(with_photographs.all, here.all, strict=True):
        np.testing.assert_allclose(np.diag(one.camera.K), np.diag(other.camera.K))  # centred, as that trainer has it
        np.testing.assert_array_equal(one.load_photo(), other.load_photo())
    with pytest.raises(InvalidViewsError, match="cannot be sent to a service without a capture; name its folder"):
        pack_capture(folder, tmp_path / "packed.zip")
    trained(folder, source_path=str(data))
    assert load_views(folder).source == here.source
    write_json(folder / "cameras.json", [{**entries[0], "fx": -1}])
    assert message(folder / "cameras.json") == f"{folder}/cameras.json, camera 0, fx: input should be greater than 0"


def test_a_scene_says_that_its_cameras_are_not_used(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    scene, model = kissgs.sample_scene(300, sh_degree=0), Path("my model")
    file = model / "point_cloud/iteration_7/point_cloud.ply"
    file.parent.mkdir(parents=True)
    kissgs.save(scene, file)
    entries = []
    for view in kissgs.virtual_views(scene, count=9, width=64, height=64).all:
        (fx, fy), pose = view.camera.K[[0, 1], [0, 1]], np.linalg.inv(view.camera.viewmat)
        entry = {"img_name": view.name, "width": 64, "height": 64, "rotation": pose[:3, :3].tolist()}
        entries.append({**entry, "position": pose[:3, 3].tolist(), "fx": fx, "fy": fy})
    write_json(model / "cameras.json", entries)
    assert kissgs.compress(file).report.note == "", "no capture without cfg_args"
    trained(model, source_path="/nowhere")
    fast = kissgs.Settings.from_preset("fast")
    for source, settings, views, said in ((file, None, None, 1), (file, fast, None, 0), (model, None, model, 0)):
        note = kissgs.compress(source, settings=settings, views=views).report.note
        assert note.count("its cameras were not used: with --views 'my model' it takes fewer bytes") == said


def test_archives_from_elsewhere_name_no_capture_of_this_machine(tmp_path):
    capture(tmp_path / "data", size=(120, 80))
    trained(tmp_path / "model", source_path=str(tmp_path / "data"))
    assert "has no cameras" in message(tmp_path / "model", unpacked=True)


def test_the_capture_of_each_scene(tmp_path):
    for name in ("garden", "bonsai"):
        capture(tmp_path / "data" / name)
    (tmp_path / "data" / "notes").mkdir()
    scene = tmp_path / "bonsai/garden/notes/7/runs.ply"
    found = capture_of(tmp_path / "data", scene)
    assert found == tmp_path / "data/garden"
    assert capture_of(found, tmp_path / "sparse.ply") == found, "it has cameras itself"
    assert capture_of(tmp_path / "data/notes", scene) == tmp_path / "data/notes"
    with pytest.raises(InvalidViewsError, match=r"no cameras, nor .* named 'runs', '7', 'notes', 'x'; name"):
        capture_of(tmp_path / "data", tmp_path / "bonsai/x/notes/7/runs.ply")
