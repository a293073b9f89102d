"""Writers of captures, without code of kissgs: cameras from SciPy's rotations, files from struct and formatting."""

import json
import struct
from dataclasses import dataclass

import numpy as np
from PIL import Image
from scipy.spatial.transform import Rotation

MODELS = {
    "SIMPLE_PINHOLE": (0, "f cx cy"),
    "PINHOLE": (1, "fx fy cx cy"),
    "SIMPLE_RADIAL": (2, "f cx cy k1"),
    "RADIAL": (3, "f cx cy k1 k2"),
    "OPENCV": (4, "fx fy cx cy k1 k2 p1 p2"),
    "OPENCV_FISHEYE": (5, "fx fy cx cy k1 k2 k3 k4"),
    "FULL_OPENCV": (6, "fx fy cx cy k1 k2 p1 p2 k3 k4 k5 k6"),
}
PINHOLE = ("PINHOLE", 120, 80, (110.0, 115.0, 61.0, 39.5))


@dataclass
class Pose:
    """World-to-camera pose."""

    name: str
    rotation: Rotation
    translation: np.ndarray
    camera: int = 1
    points: int = 0

    @property
    def viewmat(self):
        matrix = np.eye(4)
        matrix[:3, :3] = self.rotation.as_matrix()
        matrix[:3, 3] = self.translation
        return matrix


def poses(names, seed=0):
    random = np.random.default_rng(seed)
    return [
        Pose(name, Rotation.random(rng=random), random.normal(size=3), points=int(random.integers(0, 4)))
        for name in names
    ]


def write_binary(folder, cameras, images):
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "cameras.bin").write_bytes(camera_bytes(cameras))
    (folder / "images.bin").write_bytes(image_bytes(images))


def camera_bytes(cameras):
    data = struct.pack("<Q", len(cameras))
    for number, (model, width, height, parameters) in cameras.items():
        data += struct.pack("<IiQQ", number, MODELS[model][0], width, height)
        data += struct.pack(f"<{len(parameters)}d", *parameters)
    return data


def image_bytes(images):
    data = struct.pack("<Q", len(images))
    for number, pose in enumerate(images, start=1):
        x, y, z, w = pose.rotation.as_quat()
        data += struct.pack("<I7dI", number, w, x, y, z, *pose.translation, pose.camera)
        data += pose.name.encode() + b"\0" + struct.pack("<Q", pose.points)
        data += struct.pack("<ddq", 1.5, 2.5, -1) * pose.points
    return data


def point_bytes(points):
    data = struct.pack("<Q", len(points))
    for number, point in enumerate(points, start=1):
        data += struct.pack("<Q3d3BdQ", number, *point, 9, 8, 7, 0.5, number % 3) + bytes(8) * (number % 3)
    return data


def write_text(folder, cameras, images):
    folder.mkdir(parents=True, exist_ok=True)
    lines = ["# Camera list with one line of data per camera:", ""]
    for number, (model, width, height, parameters) in cameras.items():
        lines.append(f"{number} {model} {width} {height} {' '.join(map(repr, parameters))}")
    (folder / "cameras.txt").write_text("\n".join([*lines, ""]))
    lines = ["# Image list with two lines of data per image:", "#   POINTS2D[] as (X, Y, POINT3D_ID)"]
    for number, pose in enumerate(images, start=1):
        x, y, z, w = pose.rotation.as_quat()
        numbers = [float(value) for value in (w, x, y, z, *pose.translation)]
        lines.append(f"{number} {' '.join(map(repr, numbers))} {pose.camera} {pose.name}")
        lines.append(" ".join(["1.5 2.5 -1"] * pose.points))
    (folder / "images.txt").write_text("\n".join([*lines, ""]))


def opengl_matrix(pose):
    """Return the camera-to-world matrix of a camera that looks along -z, y up."""
    return (np.linalg.inv(pose.viewmat) @ np.diag([1.0, -1.0, -1.0, 1.0])).tolist()


def frames(images, prefix="images/"):
    return [{"file_path": prefix + pose.name, "transform_matrix": opengl_matrix(pose)} for pose in images]


def write_json(path, document):
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(document))
    return path


def write_photo(path, width, height, mode="RGB", value=None):
    """Write a colour ramp, which shows whether an image was resized or flipped."""
    path.parent.mkdir(parents=True, exist_ok=True)
    y, x = np.mgrid[:height, :width]
    channels = len(mode)
    ramp = np.stack([x * 255 // max(1, width - 1), y * 255 // max(1, height - 1), x * 0 + 90, x * 0 + 255], axis=-1)
    pixels = ramp[:, :, :channels].astype(np.uint8)
    if value is not None:
        pixels[:] = value
    Image.fromarray(pixels).save(path)
    return path


def assert_camera(camera, pose, K, width, height):
    np.testing.assert_allclose(camera.viewmat, pose.viewmat, atol=1e-12)
    np.testing.assert_allclose(camera.K, K, rtol=1e-12)
    assert (camera.width, camera.height) == (width, height)
