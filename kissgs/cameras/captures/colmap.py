"""COLMAP models: ``cameras`` and ``images``, as ``.bin`` or ``.txt``. Points, rigs and frames are not needed.

The format: https://colmap.github.io/format.html. Its poses are ours: world to camera, x right, y down, z forward, the
centre of the first pixel at (0.5, 0.5). The world is the model's own, in which INRIA's trainer leaves its scenes.
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

PLACES = ("", "sparse/0", "sparse", "colmap/sparse/0", "0")
"""Where a capture's folder has its model, in the order in which they are looked at."""

_PARAMETERS = {
    "SIMPLE_PINHOLE": ("f", "cx", "cy"),
    "PINHOLE": ("fx", "fy", "cx", "cy"),
    "SIMPLE_RADIAL": ("f", "cx", "cy", "k1"),
    "RADIAL": ("f", "cx", "cy", "k1", "k2"),
    "OPENCV": ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2"),
    "FULL_OPENCV": ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6"),
}

_MODEL_FOLDERS = re.compile(r"[0-9]+|sparse|colmap")


def find_colmap(path: Path) -> Path | None:
    """The folder of the model of the capture at ``path``, or None."""
    folders = [path / place for place in PLACES]
    return next((folder for folder in folders if _is_model(folder, "bin") or _is_model(folder, "txt")), None)


def half_model(path: Path) -> str | None:
    """Where :func:`find_colmap` finds none: what its model lacks, as a sentence, or None if it has no part of one."""
    for place in PLACES:
        for suffix in ("bin", "txt"):
            for has, lacks in (("cameras", "images"), ("images", "cameras")):
                if (path / place / f"{has}.{suffix}").is_file():
                    return f"{path / place} has {has}.{suffix} but no {lacks}.{suffix}; a COLMAP model needs both"
    return None


def read_colmap(folder: Path) -> Capture:
    """Read the model in ``folder``: ``cameras`` and ``images``, as ``.bin`` or else as ``.txt``.

    Its photographs are expected in ``images`` beside it, or above if the folder is a ``sparse/0`` or the like, unless
    it names them by absolute paths.

    Raises:
        InvalidViewsError: the files are missing, damaged, cut short, or contradict each other.
        UnsupportedError: an image's camera is a fisheye, or of another model that is not in the list above.
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
    shots = []
    for record in records:
        where = f"{images_path}, image {quoted(record.name)}"
        if record.camera not in cameras:
            raise InvalidViewsError(f"{where}: there is no camera {record.camera} in {cameras_path.name}")
        if record.camera not in intrinsics:  # cameras that no image uses may be of any model
            camera = cameras[record.camera]
            intrinsics[record.camera] = _intrinsics(camera, f"{cameras_path}, camera {record.camera}")
        viewmat = _viewmat(record, where)
        photo = record.name if is_absolute(record.name) else f"images/{record.name}"
        shots.append(PosedImage(record.name, photo, where, viewmat, intrinsics[record.camera]))
    if not shots:
        raise InvalidViewsError(f"{images_path} has no images; reconstruct the capture again")
    return Capture(tuple(shots), _root(folder), f"COLMAP model {folder}")


def _is_model(folder: Path, suffix: str) -> bool:
    return all((folder / f"{name}.{suffix}").is_file() for name in ("cameras", "images"))


def _root(folder: Path) -> Path:
    """The capture's folder: the first from ``folder`` upwards with photographs, or else where model folders begin."""
    place = folder.resolve()
    while not _has_photos(place) and _MODEL_FOLDERS.fullmatch(place.name):
        place = place.parent
    return place


def _has_photos(folder: Path) -> bool:
    return any(found.is_dir() for found in [*folder.glob("images*"), folder / INPUT])


def _intrinsics(camera: CameraRecord, where: str) -> Intrinsics:
    names = _PARAMETERS.get(camera.model)
    if names is None:
        raise UnsupportedError(
            f"{where} is of model {quoted(camera.model)}, which no pinhole can replace here; run "
            f"'colmap image_undistorter' first (read are {', '.join(_PARAMETERS)})"
        )
    if len(camera.parameters) != len(names):
        raise InvalidViewsError(f"{where}: {camera.model} has {len(names)} parameters, not {len(camera.parameters)}")
    if not np.isfinite(camera.parameters).all():
        raise InvalidViewsError(f"{where}: the parameters are not finite numbers; calibrate again")
    if not (1 <= camera.width <= MAX_SIDE and 1 <= camera.height <= MAX_SIDE):
        raise InvalidViewsError(f"{where}: {camera.width}x{camera.height} pixels is no size of a photograph")
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
        raise InvalidViewsError(f"{where}: its pose is not a rotation and a translation of finite numbers")
    quat = quat / largest  # squares of the smallest and the largest numbers would be 0 and infinite
    w, x, y, z = quat / np.linalg.norm(quat)
    viewmat = np.eye(4)
    viewmat[:3, :3] = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    viewmat[:3, 3] = record.translation
    return viewmat
