"""Oracle: cameras made with SciPy, written in each variant of the format; for fox, its COLMAP model."""

import json
import math

import numpy as np
import pytest
from helpers.examples import examples
from helpers.reference_cameras import assert_camera, frames, poses, write_json, write_photo
from hypothesis import given
from hypothesis import strategies as st

from kissgs.cameras.captures import photos as captures
from kissgs.cameras.captures.load import load_views
from kissgs.cameras.captures.transforms_json import read_transforms
from kissgs.cameras.photographs import Distortion
from kissgs.core.errors import InvalidViewsError, KissgsError, UnsupportedError

NAMES = ["a.jpg", "b.jpg", "c.jpg"]
POSES = poses(NAMES)
NERFSTUDIO = {"w": 120, "h": 80, "fl_x": 110.0, "fl_y": 115.0, "cx": 61.0, "cy": 39.5, "camera_model": "OPENCV"}
K = np.array([[110, 0, 61], [0, 115, 39.5], [0, 0, 1.0]])


def document(**changes):
    return {**NERFSTUDIO, "frames": frames(POSES), **changes}


def first_frame(**changes):
    """Return a document with a changed first frame."""
    entries = frames(POSES)
    entries[0].update(changes)
    return {**NERFSTUDIO, "frames": entries}


def test_nerfstudio(tmp_path):
    extras = {
        "applied_transform": np.eye(4)[:3].tolist(),
        "ply_file_path": "sparse_pc.ply",
        "orientation_override": "x",
    }
    write_json(tmp_path / "transforms.json", document(**extras))
    for view, pose in zip(load_views(tmp_path, hold_out=0).train, POSES, strict=True):
        assert_camera(view.camera, pose, K, 120, 80)
        assert view.photo is None


def test_fox_agrees_with_its_colmap_model(shared_data):
    model, file = (load_views(shared_data / "fox" / path) for path in ("sparse/0", "transforms.json"))
    assert len(model.train) == 43
    for part in ("train", "test"):
        for one, other in zip(getattr(model, part), getattr(file, part), strict=True):
            assert f"images/{one.name}" == other.name
            assert one.photo.samefile(other.photo)
            np.testing.assert_allclose(one.camera.viewmat, other.camera.viewmat, atol=1e-9)
            np.testing.assert_allclose(one.camera.K, other.camera.K, rtol=1e-9)


def test_frames_override_the_document(tmp_path):
    own = {"w": 60, "h": 40, "fl_x": 50.0, "fl_y": 51.0, "cx": 30.0, "cy": 20.0, "k1": 0.5}
    write_json(
        tmp_path / "transforms.json", first_frame(**own) | {"k1": 0.1, "k2": 0.2, "k3": 0.3, "p1": 0.4, "p2": 0.5}
    )
    first, second, _ = read_transforms(tmp_path / "transforms.json").images
    assert first.intrinsics.lens((60, 40), (60, 40)).K.tolist() == [[50, 0, 30], [0, 51, 20], [0, 0, 1]]
    assert (first.intrinsics.width, first.intrinsics.height) == (60, 40)
    assert first.intrinsics.distortion == Distortion(k1=0.5, k2=0.2, k3=0.3, p1=0.4, p2=0.5)
    assert second.intrinsics.distortion.k1 == 0.1


@pytest.mark.parametrize("photos", ["images", "images_2"])
def test_instant_ngp_has_the_size_of_the_photographs(tmp_path, photos):
    """The focal length is in pixels of the full size, even if there is only a scaled folder."""
    factor = 2 if photos == "images_2" else 1
    for name in NAMES:
        write_photo(tmp_path / photos / name, 120 // factor, 80 // factor)
    write_json(tmp_path / "transforms.json", {"fl_x": 110.0, "aabb_scale": 4, "scale": 0.3, "frames": frames(POSES)})
    expected = np.array([[110, 0, 60], [0, 110, 40], [0, 0, factor]]) / factor
    for view, pose in zip(load_views(tmp_path, hold_out=0).train, POSES, strict=True):
        assert_camera(view.camera, pose, expected, 120 // factor, 80 // factor)


@pytest.mark.parametrize("own_y", [False, True])
def test_angles_of_view(tmp_path, own_y):
    angles = {"camera_angle_x": 2 * math.atan(60 / 90), **({"camera_angle_y": 2 * math.atan(40 / 70)} if own_y else {})}
    write_json(tmp_path / "transforms.json", {"w": 120.0, "h": 80.0, **angles, "frames": frames(POSES)})
    expected = np.array([[90, 0, 60], [0, 70 if own_y else 90, 40], [0, 0, 1.0]])
    assert_camera(load_views(tmp_path, hold_out=0).train[0].camera, POSES[0], expected, 120, 80)


def synthetic(folder, parts, mode="RGBA"):
    for part in parts:
        entries = [{**frame, "rotation": 0.01} for frame in frames(POSES, f"./{part}/")]
        for entry in entries:
            entry["file_path"] = entry["file_path"].removesuffix(".jpg")
            write_photo(folder / f"{entry['file_path']}.png", 100, 100, mode)
        write_json(folder / f"transforms_{part}.json", {"camera_angle_x": 0.9, "frames": entries})


def test_nerf_synthetic(tmp_path):
    synthetic(tmp_path, ["train", "val", "test"])
    for path in (tmp_path, tmp_path / "transforms_train.json"):
        views = load_views(path)
        assert [view.name for view in views.train] == ["train/a", "train/b", "train/c"]
        assert [view.name for view in views.test] == ["test/a", "test/b", "test/c"]
        assert views.background.tolist() == [1, 1, 1]
    focal = 50 / math.tan(0.45)
    assert_camera(views.train[0].camera, POSES[0], [[focal, 0, 50], [0, focal, 50], [0, 0, 1]], 100, 100)
    assert views.train[0].photo == tmp_path / "train" / "a.png"


def test_nerf_synthetic_without_a_test_part(tmp_path):
    synthetic(tmp_path, ["train"])
    assert [view.name for view in load_views(tmp_path).test] == ["train/a"]
    synthetic(tmp_path, ["val"])
    assert [view.name for view in load_views(tmp_path).test] == ["val/a", "val/b", "val/c"]


def test_background_is_white_only_behind_transparency(tmp_path):
    synthetic(tmp_path, ["train"], mode="RGB")
    assert load_views(tmp_path).background.tolist() == [0, 0, 0]


@pytest.mark.parametrize(
    ("lists", "train", "test"),
    [
        ({"train_filenames": ["images/b.jpg"], "test_filenames": ["./images/a.jpg"]}, "b", "a"),
        ({"train_filenames": ["images/a.jpg", "images/b.jpg"]}, "ab", "c"),
        ({"test_filenames": ["images/b.jpg"], "val_filenames": ["images/a.jpg"]}, "ac", "b"),
        ({"train_filenames": ["images/c.jpg"], "val_filenames": ["images/a.jpg"]}, "c", "a"),
        ({"train_filenames": [f"images/{name}" for name in NAMES], "test_filenames": []}, "abc", ""),
        ({"train_filenames": ["images/a.jpg", "images/b.jpg"], "test_filenames": ["./images/b.jpg"]}, "a", "b"),
        ({"test_filenames": [], "val_filenames": ["images/a.jpg"]}, "bc", "a"),
        ({"train_filenames": ["images/b.jpg"], "test_filenames": [], "val_filenames": ["images/a.jpg"]}, "b", "a"),
        ({"train_filenames": ["images/a.jpg"], "val_filenames": []}, "a", ""),
    ],
)
def test_own_split(tmp_path, lists, train, test):
    write_json(tmp_path / "transforms.json", document(**lists))
    views = load_views(tmp_path)
    assert [view.name for view in views.train] == [f"images/{letter}.jpg" for letter in train]
    assert [view.name for view in views.test] == [f"images/{letter}.jpg" for letter in test]


def test_unicode_forms_of_names_in_lists(tmp_path):
    entries = frames(POSES)
    entries[0]["file_path"] = "images/u\u0308.jpg"
    write_json(tmp_path / "transforms.json", {**NERFSTUDIO, "frames": entries, "test_filenames": ["images/ü.jpg"]})
    assert [view.name for view in load_views(tmp_path).test] == ["images/u\u0308.jpg"]


@pytest.mark.parametrize(("scale", "noise"), [(3.0, 0.0), (0.01, 0.0), (1.0, 1e-3)])
def test_rotations_scaled_or_rounded(tmp_path, scale, noise):
    entry = frames(POSES)[0]
    matrix = np.array(entry["transform_matrix"])
    matrix[:3, :3] = matrix[:3, :3] * scale + np.random.default_rng(0).uniform(-noise, noise, (3, 3))
    write_json(tmp_path / "transforms.json", {**NERFSTUDIO, "frames": [entry | {"transform_matrix": matrix.tolist()}]})
    camera = load_views(tmp_path).train[0].camera
    np.testing.assert_allclose(camera.viewmat[:3, :3] @ camera.viewmat[:3, :3].T, np.eye(3), atol=1e-12)
    np.testing.assert_allclose(camera.viewmat, POSES[0].viewmat, atol=10 * noise + 1e-9)
    np.testing.assert_allclose(camera.position, matrix[:3, 3], atol=1e-9)


def test_matrices_of_three_rows_and_a_byte_order_mark(tmp_path):
    text = json.dumps(first_frame(transform_matrix=frames(POSES)[0]["transform_matrix"][:3]))
    (tmp_path / "transforms.json").write_bytes(b"\xef\xbb\xbf" + text.encode())
    assert_camera(load_views(tmp_path, hold_out=0).train[0].camera, POSES[0], K, 120, 80)


SKEWED = [[1, 0, 0.1, 0], [0, 1, 0, 0], [0, 0, 1, 0]]
STRETCHED = [[1, 0, 0, 0], [0, 1.1, 0, 0], [0, 0, 1, 0]]
MIRRORED = [[-1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0]]
NO_ROTATION = (
    ", frame 0 ('images/a.jpg'): transform_matrix is not a rotation: its axes are skewed or differ in length; "
)
FISHEYE = (
    ", frame 0 ('images/a.jpg'): the camera model {} is not supported, only SIMPLE_PINHOLE, PINHOLE, SIMPLE_RADIAL, "
    "RADIAL, OPENCV, FULL_OPENCV, PERSPECTIVE; undistort the photographs first, for example with 'colmap "
    "image_undistorter'"
)
INVALID = [
    (document(frames=[]), ", frames: list should have at least 1 item after validation, not 0"),
    ({"w": 3}, ", frames: field required"),
    ([], ": input should be an object"),
    (first_frame(file_path=None), ", frames[0].file_path: input should be a valid string"),
    (first_frame(transform_matrix=[[1, 2, 3]] * 4), ", frames[0].transform_matrix[0]: list should have at least 4"),
    (first_frame(transform_matrix=[[1, 2, 3, float("nan")]] * 4), ", frames[0].transform_matrix[0][3]: input should"),
    (document(w=0), ", w: input should be greater than or equal to 1"),
    (document(fl_x=-5), ", fl_x: input should be greater than 0"),
    (first_frame(transform_matrix=SKEWED), NO_ROTATION + "export it again"),
    (first_frame(transform_matrix=STRETCHED), NO_ROTATION + "export it again"),
    (first_frame(transform_matrix=[[0] * 4] * 3), NO_ROTATION + "export it again"),
    (first_frame(transform_matrix=MIRRORED), ", frame 0 ('images/a.jpg'): transform_matrix mirrors the world; export"),
    (first_frame(transform_matrix=[*np.eye(4)[:3].tolist(), [0, 0, 1, 1]]), ", frame 0 ('images/a.jpg'): the last"),
    ({"frames": frames(POSES), "fl_x": 3}, ", frame 0 ('images/a.jpg'): it has neither a size (w, h) nor a"),
    ({"frames": frames(POSES), "w": 3, "h": 3}, ", frame 0 ('images/a.jpg'): the camera has no focal length; give"),
    (document(train_filenames=["images/z.jpg"]), ": 'images/z.jpg' in train_filenames is not the file_path of a"),
    (document(test_filenames=["images/z.jpg"]), ": 'images/z.jpg' in test_filenames or val_filenames is not the"),
    (document(train_filenames=["images/a.jpg"], test_filenames=["./images/a.jpg"]), ": its lists of file names leave"),
    (document(train_filenames=[]), ": its lists of file names leave no training frame; correct train_filenames"),
    (first_frame(camera_model="OPENCV_FISHEYE"), FISHEYE.format("'OPENCV_FISHEYE'")),
    (document(is_fisheye=True), FISHEYE.format("'is_fisheye'")),
    (document(k4=0.1), ", frame 0 ('images/a.jpg'): the distortion coefficient k4 is not supported; undistort the"),
]


@pytest.mark.parametrize(("content", "sentence"), INVALID)
def test_invalid_documents(tmp_path, content, sentence):
    path = write_json(tmp_path / "transforms.json", content)
    with pytest.raises((InvalidViewsError, UnsupportedError)) as caught:
        load_views(path)
    assert str(caught.value).startswith(f"{path}{sentence}")


@pytest.mark.parametrize("encoding", ["utf-16-le", "utf-16-be"])
def test_utf_16_is_named(tmp_path, encoding):
    path = tmp_path / "transforms.json"
    path.write_bytes("\ufeff{}".encode(encoding))
    with pytest.raises(InvalidViewsError, match=r"UTF-16"):
        load_views(path)


def test_files_that_are_not_json(tmp_path, monkeypatch):
    path = tmp_path / "transforms.json"
    for text in ("", "{", "[" * 100_000, '{"w": 1e', "\udc80"):
        path.write_bytes(text.encode("utf-8", "surrogateescape"))
        with pytest.raises(InvalidViewsError, match=r"transforms\.json is not JSON: "):
            load_views(path)
    monkeypatch.setattr(captures, "MAX_JSON_BYTES", 10)
    path.write_text("{          }")
    with pytest.raises(InvalidViewsError, match=r"has 12 bytes; at most 10 are read; is it a camera file\?$"):
        load_views(path)


EXTREMES = st.sampled_from([0, -1, 1e-320, 1e308, -1e308, 10**400, 1e999, True, "1", "../a", "\0", "a" * 5000, [], {}])
VALUES = st.none() | st.integers() | st.floats() | st.text(max_size=4) | EXTREMES
TOP = [*sorted(NERFSTUDIO), "k1", "k4", "p2", "camera_angle_x", "is_fisheye", "train_filenames", "val_filenames"]


def check(path):
    """Load the capture; fail on exceptions other than a KissgsError of one line."""
    try:
        views, sentence = load_views(path), ""
    except KissgsError as error:
        views, sentence = None, str(error)
    assert "\n" not in sentence
    assert views is None or views.train


def changes(keys):
    return st.dictionaries(st.sampled_from(keys), VALUES | st.lists(VALUES, max_size=3), max_size=2)


@examples(400)
@given(top=changes(TOP), frame=changes([*TOP, "file_path", "transform_matrix"]), row=changes(["0", "1", "2", "3"]))
def test_mutated_documents(tmp_path, top, frame, row):
    """Any document gives views or a KissgsError."""
    changed = first_frame(**frame) | {"k1": 0.1} | top
    matrix = frames(POSES)[0]["transform_matrix"]
    for column, value in row.items():
        matrix[0][int(column)] = value
    if row:
        changed["frames"][0]["transform_matrix"] = matrix
    path = write_json(tmp_path / "transforms.json", changed)
    check(path)


@examples(200)
@given(start=st.integers(0, 3000), length=st.integers(0, 40), new=st.binary(max_size=8))
def test_mutated_bytes(tmp_path, start, length, new):
    data = json.dumps(document()).encode()
    path = tmp_path / "transforms.json"
    path.write_bytes(data[:start] + new + data[start + length :])
    check(path)
