"""Oracle: cameras made with SciPy and files packed by hand; for fox, COLMAP's observations of points."""

import struct

import numpy as np
import pytest
from helpers.reference_cameras import MODELS, PINHOLE, assert_camera, poses, write_binary, write_text

from kissgs.cameras.captures.colmap import find_colmap, read_colmap
from kissgs.cameras.captures.load import load_views
from kissgs.cameras.photographs import Distortion

NAMES = ["b.jpg", "with a space.jpg", "sub/folder/a.png"]
K = np.array([[110, 0, 61], [0, 115, 39.5], [0, 0, 1.0]])
WRITERS = pytest.mark.parametrize("write", [write_binary, write_text])


@WRITERS
def test_cameras_and_names(tmp_path, write):
    images = poses(NAMES)
    write(tmp_path, {1: PINHOLE}, images)
    capture = read_colmap(tmp_path)
    assert [posed.name for posed in capture.images] == NAMES
    for view, pose in zip(load_views(tmp_path, hold_out=0).train, sorted(images, key=lambda p: p.name), strict=True):
        assert view.name == pose.name
        assert_camera(view.camera, pose, K, 120, 80)


@WRITERS
@pytest.mark.parametrize("model", sorted(set(MODELS) - {"OPENCV_FISHEYE"}))
def test_every_model(tmp_path, write, model):
    names = MODELS[model][1].split()
    values = {name: 0.01 * i for i, name in enumerate(names, start=1)}
    write(tmp_path, {1: PINHOLE, 7: (model, 120, 80, tuple(values.values()))}, [poses(["a"])[0], pose_of(7)])
    intrinsics = read_colmap(tmp_path).images[1].intrinsics
    fx, fy = values.pop("fx", values.get("f")), values.pop("fy", values.get("f"))
    values.pop("f", None)
    assert (intrinsics.fx, intrinsics.fy, intrinsics.cx, intrinsics.cy) == (fx, fy, values.pop("cx"), values.pop("cy"))
    assert intrinsics.distortion == Distortion(**values)
    assert (intrinsics.width, intrinsics.height) == (120, 80)


def pose_of(camera):
    pose = poses(["of camera"])[0]
    pose.camera = camera
    return pose


def test_quaternions_need_not_be_of_unit_length(tmp_path):
    images = poses(["a.jpg"])
    write_text(tmp_path, {1: PINHOLE}, images)
    path = tmp_path / "images.txt"
    x, y, z, w = images[0].rotation.as_quat() * 1e-200
    rest = " ".join(map(str, images[0].translation))
    path.write_text(f"1 {w} {x} {y} {z} {rest} 1 a.jpg")  # and no line of points after the last image
    assert_camera(load_views(tmp_path).train[0].camera, images[0], K, 120, 80)


def test_links_to_files_elsewhere(tmp_path):
    write_text(tmp_path / "elsewhere", {1: PINHOLE}, poses(NAMES))
    model = tmp_path / "statue" / "sparse" / "0"
    model.mkdir(parents=True)
    for name in ("cameras.txt", "images.txt"):
        (model / name).symlink_to(tmp_path / "elsewhere" / name)
    capture = read_colmap(model)
    assert (capture.root, set(capture.files)) == (tmp_path / "statue", {"sparse/0/cameras.txt", "sparse/0/images.txt"})


def test_text_with_a_byte_order_mark(tmp_path):
    """Some editors add one: before a comment, or before a record."""
    images = poses(NAMES)
    write_text(tmp_path, {1: PINHOLE}, images)
    for path, comments in ((tmp_path / "cameras.txt", 0), (tmp_path / "images.txt", 2)):
        path.write_bytes(b"\xef\xbb\xbf" + b"".join(path.read_bytes().splitlines(keepends=True)[comments:]))
    assert [posed.name for posed in read_colmap(tmp_path).images] == NAMES


@pytest.mark.parametrize("folder", ["", "sparse/0", "sparse", "colmap/sparse/0", "0"])
def test_model_folders(tmp_path, folder):
    write_text(tmp_path / folder, {1: PINHOLE}, poses(NAMES))
    assert find_colmap(tmp_path) == tmp_path / folder


def test_binary_precedes_text_and_the_folder_itself_precedes_sparse(tmp_path):
    write_text(tmp_path, {1: PINHOLE}, poses(["text"]))
    write_binary(tmp_path, {1: PINHOLE}, poses(["binary"]))
    write_binary(tmp_path / "sparse" / "0", {1: PINHOLE}, poses(["sparse"]))
    (tmp_path / "rigs.bin").write_bytes(b"not read")
    (tmp_path / "frames.bin").write_bytes(b"not read")
    assert [posed.name for posed in read_colmap(find_colmap(tmp_path)).images] == ["binary"]


@pytest.mark.parametrize("start", ["", "sparse/0"])
@pytest.mark.parametrize("photos", ["images_4", "input"])
def test_root_is_where_the_photographs_are(tmp_path, start, photos):
    capture = tmp_path / "360"  # also a name that a model's folder may have
    write_binary(capture / "sparse" / "0", {1: PINHOLE}, poses(NAMES))
    (capture / photos).mkdir()
    (tmp_path / "images").mkdir()
    assert read_colmap(find_colmap(capture / start)).root == capture.resolve()


@WRITERS
def test_fisheyes_are_rejected_only_if_an_image_uses_them(tmp_path, write):
    cameras = {1: PINHOLE, 2: ("OPENCV_FISHEYE", 120, 80, (100.0, 100.0, 60.0, 40.0, 0.1, 0.0, 0.0, 0.0))}
    write(tmp_path, cameras, poses(NAMES))
    assert len(read_colmap(tmp_path).images) == 3
    write(tmp_path, cameras, [pose_of(2)])
    name = "cameras.bin" if write is write_binary else "cameras.txt"
    with pytest.raises(Exception, match="FISHEYE") as caught:
        read_colmap(tmp_path)
    assert caught.value.code == "unsupported"
    assert str(caught.value) == (
        f"{tmp_path / name}, camera 2: the camera model 'OPENCV_FISHEYE' is not supported, only SIMPLE_PINHOLE, "
        "PINHOLE, SIMPLE_RADIAL, RADIAL, OPENCV, FULL_OPENCV; run 'colmap image_undistorter' first"
    )


def test_fox_cameras_project_points_to_colmaps_observations(shared_data):
    """The mean reprojection error in pixels of ``images_2`` is about COLMAP's, which is 0.586 per point."""
    model = shared_data / "fox" / "sparse" / "0"
    points, seen = read_points(model / "points3D.bin"), read_observations(model / "images.bin")
    errors = []
    for posed in read_colmap(model).images:
        ids, observed = seen[posed.name]
        world = np.array([points[i] for i in ids])
        local = world @ posed.viewmat[:3, :3].T + posed.viewmat[:3, 3]
        projected = local @ posed.intrinsics.lens((1080, 1920), (540, 960)).K.T
        assert (projected[:, 2] > 0).all()
        errors.append(projected[:, :2] / projected[:, 2:] - observed / 2)
    assert len(errors) == 50
    assert max(np.linalg.norm(error, axis=1).mean() for error in errors) < 1
    assert np.linalg.norm(np.concatenate(errors), axis=1).mean() < 0.7
    assert np.abs(np.concatenate(errors).mean(axis=0)).max() < 0.001  # a shift by half a pixel would exceed this


def read_points(path):
    data, at, points = path.read_bytes(), 8, {}
    for _ in range(struct.unpack_from("<Q", data)[0]):
        number, *position = struct.unpack_from("<Q3d", data, at)
        points[number] = position
        at += 8 + 24 + 3 + 8
        at += 8 + 8 * struct.unpack_from("<Q", data, at)[0]
    return points


def read_observations(path):
    data, at, seen = path.read_bytes(), 8, {}
    for _ in range(struct.unpack_from("<Q", data)[0]):
        at += 4 + 56 + 4
        end = data.index(b"\0", at)
        name, count = data[at:end].decode(), struct.unpack_from("<Q", data, end + 1)[0]
        at = end + 9 + 24 * count
        table = np.frombuffer(data, dtype="<f8,<f8,<i8", count=count, offset=end + 9)
        table = table[table["f2"] >= 0]
        seen[name] = table["f2"], np.stack([table["f0"], table["f1"]], axis=1)
    return seen
