"""COLMAP models: ``cameras`` and ``images``, as ``.bin`` or ``.txt``. Points, rigs and frames are not read.

Source: https://colmap.github.io/format.html. The conventions are those of ``Camera``: world to camera, x right, y down,
z forward, the centre of the first pixel at (0.5, 0.5). World coordinates are those of the model, which INRIA's trainer
keeps too.
"""

from __future__ import annotations

import re
from collections.abc import Iterable
from pathlib import Path

import numpy as np

from kissgs.cameras.captures.colmap_records import (
    CameraRecord,
    ImageRecord,
    read_binary_cameras,
    read_binary_images,
    read_text_cameras,
    read_text_images,
)
from kissgs.cameras.captures.files import quoted
from kissgs.cameras.captures.photos import INPUT, is_absolute
from kissgs.cameras.captures.posed_image import MAX_SIDE, Capture, Intrinsics, PosedImage
from kissgs.cameras.undistort import Distortion
from kissgs.core.array_types import Float64
from kissgs.core.errors import InvalidViewsError, UnsupportedError

MODEL_FOLDERS = ("", "sparse/0", "sparse", "colmap/sparse/0", "0")
"""Folders of a capture that may hold the model, in the order in which they are searched."""

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
    """Read the model in ``folder``: ``cameras`` and ``images``, as ``.bin`` or else as ``.txt``.

    Photographs are expected in ``images`` next to the model, or next to the topmost of folders such as ``sparse/0``,
    unless the model names them by absolute paths.

    Raises:
        InvalidViewsError: the files are missing, damaged, truncated, or contradict each other.
        UnsupportedError: the camera of an image is a fisheye or of another unsupported model.
    """
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
    return Capture(tuple(posed_images), _root(folder), f"COLMAP model {folder}")


def _is_model(folder: Path, suffix: str) -> bool:
    return all((folder / f"{name}.{suffix}").is_file() for name in ("cameras", "images"))


def _root(folder: Path) -> Path:
    """Return the capture's folder: the first from ``folder`` upwards with photographs or without a model's name."""
    root = folder.resolve()
    while not _has_photos(root) and _MODEL_FOLDER_NAMES.fullmatch(root.name):
        root = root.parent
    return root


def _has_photos(folder: Path) -> bool:
    return any(found.is_dir() for found in [*folder.glob("images*"), folder / INPUT])


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
    return Intrinsics(
        width=camera.width,
        height=camera.height,
        fx=values.pop("fx", focal),
        fy=values.pop("fy", focal),
        cx=values.pop("cx"),
        cy=values.pop("cy"),
        distortion=Distortion(**values),
    )


def _viewmat(record: ImageRecord, where: str) -> Float64[np.ndarray, "4 4"]:
    quat = np.array(record.quat)
    largest = np.abs(quat).max()
    if not (np.isfinite(quat).all() and np.isfinite(record.translation).all() and largest > 0):
        raise InvalidViewsError(
            f"{where}: its pose has a zero quaternion or non-finite numbers; reconstruct the capture again"
        )
    quat = quat / largest  # else squares could underflow to 0 or overflow
    w, x, y, z = quat / np.linalg.norm(quat)
    viewmat = np.eye(4)
    viewmat[:3, :3] = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    viewmat[:3, 3] = record.translation
    return viewmat
