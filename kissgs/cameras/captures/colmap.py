"""COLMAP models: ``cameras`` and ``images``, as ``.bin`` or ``.txt``; how gsplat normalises them."""

from __future__ import annotations

import codecs
import io
import re
import struct
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from kissgs.cameras.captures.photos import (
    INPUT,
    MAX_SIDE,
    Capture,
    Intrinsics,
    PosedImage,
    is_absolute,
    open_file,
    quoted,
)
from kissgs.cameras.photographs import Distortion
from kissgs.cameras.views import Similarity, rotation_matrices
from kissgs.core.array_types import Float32, Float64
from kissgs.core.errors import InvalidViewsError, UnsupportedError

MAX_NAME_BYTES = 4096  # maximum bytes of an image's name; no file system has longer paths
POINTS = ("points3D.bin", "points3D.txt")  # of which the first is read
MAX_LINE_BYTES = 1 << 26  # of a text file; the points of an image take about 40 MB per million

# Model number: name and number of parameters in a binary file.
_MODELS = {
    0: ("SIMPLE_PINHOLE", 3),
    1: ("PINHOLE", 4),
    2: ("SIMPLE_RADIAL", 4),
    3: ("RADIAL", 5),
    4: ("OPENCV", 8),
    5: ("OPENCV_FISHEYE", 8),
    6: ("FULL_OPENCV", 12),
    7: ("FOV", 5),
    8: ("SIMPLE_RADIAL_FISHEYE", 4),
    9: ("RADIAL_FISHEYE", 5),
    10: ("THIN_PRISM_FISHEYE", 12),
    11: ("RAD_TAN_THIN_PRISM_FISHEYE", 16),
}

_COUNT = struct.Struct("<Q")
_CAMERA = struct.Struct("<IiQQ")
_IMAGE = struct.Struct("<I7dI")
_POINT3D = struct.Struct("<Q3d3xdQ")  # without its track
_TRACK_BYTES = 8
_POINT_BYTES = 24
_MIN_CAMERA_BYTES = _CAMERA.size + 3 * 8
_MIN_IMAGE_BYTES = _IMAGE.size + 1 + _COUNT.size


@dataclass(frozen=True, slots=True)
class CameraRecord:
    """A camera: name of the model, width and height in pixels, parameters of the model in COLMAP's order."""

    model: str
    width: int
    height: int
    parameters: tuple[float, ...]


@dataclass(frozen=True, slots=True)
class ImageRecord:
    """An image: name, camera number, and world-to-camera pose as quaternion (w, x, y, z) and translation (x, y, z)."""

    name: str
    camera: int
    quat: tuple[float, ...]
    translation: tuple[float, ...]


def read_binary_cameras(path: Path) -> dict[int, CameraRecord]:
    """Return all cameras of a ``cameras.bin`` by number."""
    cameras: dict[int, CameraRecord] = {}
    with open_file(path) as (file, size):
        reader = _Reader(path, file, size)
        for _ in range(reader.count("cameras", _MIN_CAMERA_BYTES)):
            number, model, width, height = reader.unpack(_CAMERA)
            if model not in _MODELS:  # the length of its record is unknown
                raise UnsupportedError(
                    f"{path}: camera {number} has the unknown model number {model}; run 'colmap image_undistorter' "
                    "first"
                )
            name, length = _MODELS[model]
            if number in cameras:
                raise InvalidViewsError(f"{path} has two cameras with number {number}; it is damaged, export it again")
            cameras[number] = CameraRecord(name, width, height, reader.unpack(struct.Struct(f"<{length}d")))
        reader.finish("camera")
    return cameras


def read_binary_images(path: Path) -> Iterator[ImageRecord]:
    """Yield all images of an ``images.bin``, in order; their points are skipped."""
    with open_file(path) as (file, size):
        reader = _Reader(path, file, size)
        for _ in range(reader.count("images", _MIN_IMAGE_BYTES)):
            _, *pose, camera = reader.unpack(_IMAGE)
            name = reader.string()
            reader.skip(reader.unpack(_COUNT)[0] * _POINT_BYTES)
            yield ImageRecord(name, camera, tuple(pose[:4]), tuple(pose[4:]))
        reader.finish("image")


def read_text_cameras(path: Path) -> dict[int, CameraRecord]:
    """Return all cameras of a ``cameras.txt`` by number."""
    cameras: dict[int, CameraRecord] = {}
    for number, line in _lines(path):
        if _is_comment(line):
            continue
        try:
            identity, model, width, height, *parameters = line.split()
            record = CameraRecord(model, int(width), int(height), tuple(map(float, parameters)))
            key = int(identity)
        except ValueError as error:
            raise InvalidViewsError(
                f"{path}, line {number}: not a camera (CAMERA_ID MODEL WIDTH HEIGHT PARAMETERS…)"
            ) from error
        if key in cameras:
            raise InvalidViewsError(f"{path}, line {number}: a second camera with number {key}; export the model again")
        cameras[key] = record
    return cameras


def read_text_images(path: Path) -> Iterator[ImageRecord]:
    """Yield all images of an ``images.txt``, in order."""
    lines = _lines(path)
    for number, line in lines:
        if _is_comment(line):
            continue
        try:
            _, *pose, camera, name = line.split(maxsplit=9)
            values = tuple(map(float, pose))
            record = ImageRecord(name, int(camera), values[:4], values[4:])
            if len(values) != 7:
                raise ValueError("a number is missing")
        except ValueError as error:
            raise InvalidViewsError(
                f"{path}, line {number}: not an image (IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME)"
            ) from error
        _check_points(path, *next(lines, (number + 1, "")))
        yield record


def _check_points(path: Path, number: int, line: str) -> None:
    """Check that a line holds points: if a tool leaves out empty lines, every second image would be skipped."""
    words = line.split()
    try:
        list(map(float, words[:3]))
        if len(words) % 3:
            raise ValueError("not triples")
    except ValueError as error:
        raise InvalidViewsError(
            f"{path}, line {number}: expected the points of the image above (X Y POINT3D_ID, any number of times), "
            "or an empty line"
        ) from error


def _lines(path: Path) -> Iterator[tuple[int, str]]:
    """Yield line numbers, from 1, and stripped lines, without a byte order mark."""
    with open_file(path) as (file, _):
        number = 0
        while line := file.readline(MAX_LINE_BYTES + 1):
            number += 1
            if len(line) > MAX_LINE_BYTES:
                raise InvalidViewsError(
                    f"{path}, line {number}: longer than the limit of {MAX_LINE_BYTES} bytes; the file is damaged"
                )
            if number == 1:
                line = line.removeprefix(codecs.BOM_UTF8)
            yield number, _decode(line, f"{path}, line {number}").strip()


def _is_comment(line: str) -> bool:
    return not line or line.startswith("#")


def _decode(text: bytes, where: str) -> str:
    try:
        return text.decode("utf-8")
    except UnicodeDecodeError as error:
        raise InvalidViewsError(f"{where}: not UTF-8 text; rename the photographs or save the file as UTF-8") from error


@dataclass(slots=True)
class _Reader:
    """Reader of values from a little-endian file; ``left`` is the number of bytes not yet read."""

    path: Path
    file: io.BufferedIOBase
    left: int

    def unpack(self, form: struct.Struct) -> tuple:
        data = self.file.read(form.size)
        self.left -= form.size
        if len(data) < form.size:
            raise self._truncated()
        return form.unpack(data)

    def count(self, what: str, least: int) -> int:
        """Read a number of records and check it against the remaining bytes; a record has at least ``least`` bytes."""
        value = int(self.unpack(_COUNT)[0])
        if value * least > self.left:
            raise InvalidViewsError(
                f"{self.path} declares {value:,} {what}, but has room for {self.left // least:,} at most; it is "
                "truncated, or not from COLMAP: export it again"
            )
        return value

    def string(self) -> str:
        """Read a zero-terminated string."""
        data = bytearray()
        while (byte := self.file.read(1)) != b"\0":
            data += byte
            if not byte or len(data) > MAX_NAME_BYTES:
                raise InvalidViewsError(
                    f"{self.path}: the name {quoted(data[:80].decode('utf-8', 'replace'))} has no end; the file is "
                    "damaged or truncated, copy or export it again"
                )
        self.left -= len(data) + 1
        return _decode(bytes(data), f"{self.path}, name {quoted(data.decode('utf-8', 'replace'))}")

    def skip(self, length: int) -> None:
        if length > self.left:
            raise self._truncated()
        self.file.seek(length, io.SEEK_CUR)
        self.left -= length

    def finish(self, what: str) -> None:
        if self.left:
            raise InvalidViewsError(
                f"{self.path} continues for {self.left:,} bytes after its last {what}; it is damaged, export it again"
            )

    def _truncated(self) -> InvalidViewsError:
        return InvalidViewsError(f"{self.path} is truncated; copy or export it again")


# COLMAP models: ``cameras`` and ``images``, as ``.bin`` or ``.txt``. Rigs and frames are not read, points only for
# gsplat's normalisation.
#
# Source: https://colmap.github.io/format.html. The conventions are those of ``Camera``: world to camera, x right, y
# down, z forward, the centre of the first pixel at (0.5, 0.5). World coordinates are those of the model, which INRIA's
# trainer keeps too.

MODEL_FOLDERS = ("", "sparse/0", "sparse", "colmap/sparse/0", "0")  # of a capture, in the order of the search

_PARAMETERS = {
    "SIMPLE_PINHOLE": ("f", "cx", "cy"),
    "PINHOLE": ("fx", "fy", "cx", "cy"),
    "SIMPLE_RADIAL": ("f", "cx", "cy", "k1"),
    "RADIAL": ("f", "cx", "cy", "k1", "k2"),
    "OPENCV": ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2"),
    "FULL_OPENCV": ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6"),
}

_MODEL_FOLDER_NAMES = re.compile(r"[0-9]+|sparse|colmap")


def find_colmap(path: Path) -> Path | None:
    """Return the folder of the COLMAP model of the capture at ``path``; None if it has none."""
    folders = [path / folder for folder in MODEL_FOLDERS]
    return next((folder for folder in folders if _is_model(folder, "bin") or _is_model(folder, "txt")), None)


def missing_part(path: Path) -> str | None:
    """Return a sentence that says which file an incomplete COLMAP model lacks; None if no part of a model exists."""
    for folder in MODEL_FOLDERS:
        for suffix in ("bin", "txt"):
            for has, lacks in (("cameras", "images"), ("images", "cameras")):
                if (path / folder / f"{has}.{suffix}").is_file():
                    return f"{path / folder} has {has}.{suffix} but no {lacks}.{suffix}; a COLMAP model needs both"
    return None


def read_colmap(folder: Path) -> Capture:
    """Read the model in ``folder``; its photographs are in ``images`` beside it unless it has absolute paths."""
    binary = _is_model(folder, "bin")
    images_path = folder / ("images.bin" if binary else "images.txt")
    cameras_path = folder / ("cameras.bin" if binary else "cameras.txt")
    records: Iterable[ImageRecord]
    if binary:
        cameras, records = read_binary_cameras(cameras_path), read_binary_images(images_path)
    else:
        cameras, records = read_text_cameras(cameras_path), read_text_images(images_path)
    intrinsics: dict[int, Intrinsics] = {}
    posed_images = []
    for record in records:
        where = f"{images_path}, image {quoted(record.name)}"
        if record.camera not in cameras:
            raise InvalidViewsError(
                f"{where}: there is no camera {record.camera} in {cameras_path.name}; export the model again"
            )
        if record.camera not in intrinsics:  # cameras that no image uses may be of any model
            camera = cameras[record.camera]
            intrinsics[record.camera] = _intrinsics(camera, f"{cameras_path}, camera {record.camera}")
        viewmat = _viewmat(record, where)
        photo = record.name if is_absolute(record.name) else f"images/{record.name}"
        posed_images.append(PosedImage(record.name, photo, where, viewmat, intrinsics[record.camera]))
    if not posed_images:
        raise InvalidViewsError(f"{images_path} has no images; reconstruct the capture again")
    root = _root(folder)
    within = folder.resolve().relative_to(root)  # the files themselves may be links to others
    points = next((path for name in POINTS if (path := folder / name).is_file()), None)
    files = {str(within / path.name): path for path in (cameras_path, images_path, points) if path is not None}
    return Capture(tuple(posed_images), root, f"COLMAP model {folder}", files, points=points)


def _is_model(folder: Path, suffix: str) -> bool:
    return all((folder / f"{name}.{suffix}").is_file() for name in ("cameras", "images"))


def _root(folder: Path) -> Path:
    """Return the capture's folder: the first from ``folder`` upwards with photographs or without a model's name."""
    root = folder.resolve()
    while _MODEL_FOLDER_NAMES.fullmatch(root.name):
        if any(found.is_dir() for found in [*root.glob("images*"), root / INPUT]):
            break
        root = root.parent
    return root


def _intrinsics(camera: CameraRecord, where: str) -> Intrinsics:
    names = _PARAMETERS.get(camera.model)
    if names is None:
        raise UnsupportedError(
            f"{where}: the camera model {quoted(camera.model)} is not supported, only {', '.join(_PARAMETERS)}; run "
            "'colmap image_undistorter' first"
        )
    if len(camera.parameters) != len(names):
        raise InvalidViewsError(f"{where}: {camera.model} has {len(names)} parameters, not {len(camera.parameters)}")
    if not np.isfinite(camera.parameters).all():
        raise InvalidViewsError(f"{where}: the parameters are not finite numbers; calibrate again")
    if not (1 <= camera.width <= MAX_SIDE and 1 <= camera.height <= MAX_SIDE):
        raise InvalidViewsError(f"{where}: {camera.width}x{camera.height} pixels is not a valid image size")
    values = dict(zip(names, camera.parameters, strict=True))
    focal = values.pop("f", None)
    fx, fy, cx, cy = values.pop("fx", focal), values.pop("fy", focal), values.pop("cx"), values.pop("cy")
    return Intrinsics(camera.width, camera.height, fx, fy, cx, cy, distortion=Distortion(**values))


def _viewmat(record: ImageRecord, where: str) -> Float64[np.ndarray, "4 4"]:
    quat = np.array(record.quat)
    largest = np.abs(quat).max()
    if not (np.isfinite(quat).all() and np.isfinite(record.translation).all() and largest > 0):
        raise InvalidViewsError(
            f"{where}: its pose has a zero quaternion or non-finite numbers; reconstruct the capture again"
        )
    quat = quat / largest  # else squares could underflow to 0 or overflow
    viewmat = np.eye(4)
    viewmat[:3, :3] = rotation_matrices(quat / np.linalg.norm(quat))
    viewmat[:3, 3] = record.translation
    return viewmat


def read_points(path: Path) -> Float32[np.ndarray, "P 3"]:
    """Return the positions of all points of a ``points3D.bin`` or ``points3D.txt``."""
    if path.suffix == ".txt":
        return _read_text_points(path)
    with open_file(path) as (file, size):
        reader, found = _Reader(path, file, size), list[float]()
        for _ in range(reader.count("points", _POINT3D.size)):
            _, *position, _, images = reader.unpack(_POINT3D)
            found += position
            reader.skip(images * _TRACK_BYTES)
        reader.finish("point")
    return np.array(found, dtype=np.float32).reshape(-1, 3)


def _read_text_points(path: Path) -> Float32[np.ndarray, "P 3"]:
    found = list[float]()
    for number, line in _lines(path):
        if _is_comment(line):
            continue
        try:
            _, x, y, z = line.split(maxsplit=4)[:4]
            found += float(x), float(y), float(z)
        except ValueError as error:
            raise InvalidViewsError(f"{path}, line {number}: not a point (POINT3D_ID X Y Z …)") from error
    return np.array(found, dtype=np.float32).reshape(-1, 3)


# gsplat's trainer normalises the world (``examples/datasets/normalize.py``, unless ``normalize_world_space`` is false):
# up is the mean of the cameras' up axes; the origin and the unit are medians over the cameras; then the axes are the
# principal ones of the points, of which the largest is x. The signs of principal axes differ by linear algebra library,
# and newer versions turn the world upside down by another rule than older ones, so all four proper choices are given.


def gsplat_similarities(path: Path, viewmats: Sequence[Float64[np.ndarray, "4 4"]]) -> tuple[Similarity, ...]:
    """Return the transforms by which gsplat may have normalised a COLMAP model with these points and world-to-camera
    transforms of all images; none where they determine no such transform."""
    points = read_points(path)
    with np.errstate(all="ignore"):  # of cameras in one place and points in one, which the check finds
        first = _normalised_cameras(np.linalg.inv(np.array(viewmats)))
        moved = points @ first[:3, :3].T + first[:3, 3]
    if len(points) < 2 or not np.isfinite(moved).all():
        return ()
    axes = np.linalg.eigh(np.cov(moved, rowvar=False))[1][:, ::-1].T  # rows, the largest first
    axes[0] *= np.sign(np.linalg.det(axes))
    second = np.eye(4)
    second[:3, :3], second[:3, 3] = axes, -axes @ np.median(moved, axis=0)
    source, signs = "gsplat's normalisation of the COLMAP model", ((1, 1, 1), (1, -1, -1), (-1, 1, -1), (-1, -1, 1))
    return tuple(Similarity(source, np.diag([*each, 1.0]) @ second @ first) for each in signs)


def _normalised_cameras(poses: Float64[np.ndarray, "C 4 4"]) -> Float64[np.ndarray, "4 4"]:
    """Return the transform by the cameras alone: up becomes -y, the cameras look at the origin, and the median distance
    of their centres from it is 1. NaN or infinite where they determine none."""
    down = poses[:, :3, 1].mean(axis=0)
    down /= np.linalg.norm(down)
    x, y, z = np.cross(down, (0, 1, 0))
    skew = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    turn = np.eye(3) + skew + skew @ skew / (1 + down[1])
    centres, forward = poses[:, :3, 3] @ turn.T, poses[:, :3, 2] @ turn.T
    nearest = centres - (forward * centres).sum(axis=1, keepdims=True) * forward  # to the origin, on each axis of view
    shift = -np.median(nearest, axis=0)
    transform = np.eye(4)
    transform[:3, :3], transform[:3, 3] = turn, shift
    transform[:3] /= np.median(np.linalg.norm(centres + shift, axis=1))
    return transform
