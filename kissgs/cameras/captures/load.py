"""Captures: photographs with the cameras of a COLMAP model (``.bin`` or ``.txt``) or of ``transforms.json``."""

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
    FoundPhoto,
    Intrinsics,
    PosedImage,
    find_photos,
    is_absolute,
    open_file,
    quoted,
    searched_folders,
)
from kissgs.cameras.captures.transforms_json import read_split_transforms, read_transforms, similarities
from kissgs.cameras.photographs import (
    QUARTER_TURNS,
    Distortion,
    PhotoHeader,
    full_window,
    orientation,
    read_photo_header,
)
from kissgs.cameras.views import UndistortionSpec, View, Views
from kissgs.core.array_types import Float32, Float64
from kissgs.core.errors import InvalidViewsError, UnsupportedError
from kissgs.rendering.camera import Camera

# Parsers of COLMAP's ``cameras`` and ``images`` files, binary and text, into records.

MAX_NAME_BYTES = 4096
"""Maximum bytes of an image's name; no file system has longer paths."""

MAX_LINE_BYTES = 1 << 26
"""Maximum bytes of a line in a text file; the longest lines hold the points of an image, about 40 MB per million."""

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
    file: io.BufferedReader
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


# COLMAP models: ``cameras`` and ``images``, as ``.bin`` or ``.txt``. Points, rigs and frames are not read.
#
# Source: https://colmap.github.io/format.html. The conventions are those of ``Camera``: world to camera, x right, y
# down, z forward, the centre of the first pixel at (0.5, 0.5). World coordinates are those of the model, which INRIA's
# trainer keeps too.

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


# ``load_views``: the views of a COLMAP or ``transforms.json`` capture, with cameras at the size of the photographs.

DEFAULT_RESOLUTION = 1600
"""Default maximum of the longer side, pixels. For landscape photographs this is the protocol of 3DGS, on which
published results depend; INRIA's code limits only the width, so that portrait photographs stay larger."""

HOLD_OUT = 8
"""Every eighth view, starting with the first, is held out: the protocol of 3DGS and Mip-NeRF 360."""

MAX_ASPECT_ERROR = 0.01
"""Maximum relative difference between the aspect ratios of a photograph and its camera; scaled copies round sides."""


def load_views(
    path: Path,
    *,
    scale: int | None = None,
    images: Path | None = None,
    resolution: int | None = None,
    hold_out: int = HOLD_OUT,
) -> Views:
    """Load the views of a capture; of its photographs, only the headers are read.

    Captures are searched in this order: a COLMAP model (in the folder, ``sparse/0``, ``sparse``, ``colmap/sparse/0`` or
    ``0``), NeRF's ``transforms_train.json`` with its test or validation file, ``transforms.json``. The path of a
    ``.json`` file or of a file of a COLMAP model selects that file.

    Cameras are scaled to the actual size of their photographs, whatever the camera file says. A longer side above
    ``resolution`` is reduced to it by INRIA's formula, whose rounding may lose a pixel; INRIA's code limits only the
    width, so that portrait photographs stay larger. Photographs of a distorting lens are undistorted when their pixels
    are loaded.

    Cameras are in the coordinates of the camera file. nerfstudio trains scenes in others: its
    ``dataparser_transforms.json``, in the capture's folder or beside the camera file, is read for those who compare the
    views with a scene (:attr:`Views.similarities`).

    If there is no folder of photographs, views have cameras only, without distortion, and ``note`` says so. If only
    some photographs are missing, an error is raised, because results from fewer views could pass for those of all.

    Args:
        path: folder of the capture, or its camera file.
        scale: use the photographs in the folder of this scale, such as 4 for ``images_4``. Default: the full-size
            folder, else that of scale 4, else the largest; if there is no ``images`` of any scale, ``input``, where
            INRIA's ``convert.py`` keeps the originals.
        images: use the photographs in this folder instead.
        resolution: maximum of the longer side, pixels; None for 1600.
        hold_out: every ``hold_out``-th view in order of names, starting with the first, is held out; 0 for none. A
            split that the capture defines takes precedence.

    Raises:
        InvalidViewsError: there is no capture, its files are damaged, photographs are missing or of another aspect
            ratio than their cameras, or an argument is out of range.
        UnsupportedError: a camera has an unsupported model, such as a fisheye.
    """
    _check_arguments(scale, resolution, hold_out)
    path = Path(path)
    try:
        capture = _read_capture(path)
        moves = similarities((path if path.is_dir() else path.parent, capture.root), capture.applied)
    except OSError as error:  # even testing for a path fails without permission or if a name is too long
        raise InvalidViewsError(f"cannot read {path}: {(error.strerror or str(error)).lower()}") from error
    names = [posed.photo for posed in capture.images]
    photos = find_photos(names, capture.root, scale=scale, images=images)
    opened: list[_Photo | None] = [None] * len(capture.images)
    if photos is not None:
        opened = [_Photo(photo, read_photo_header(photo.path)) for photo in photos]
    white = capture.white and (opened[0] is None or opened[0].header.transparent)
    background = np.full(3, float(white), dtype=np.float32)
    limit = DEFAULT_RESOLUTION if resolution is None else resolution
    views = []
    for posed, photo in zip(capture.images, opened, strict=True):
        nominal, size = _sizes(posed, photo, scale or 1)
        views.append((_view(posed, photo, nominal, _reduced(size, limit), background), posed.split))
    train, test = _split(views, hold_out)
    if photos is not None:
        source = f"{capture.source}, photographs of {_folders(photos)}"
        return Views(train, test, background, source, similarities=moves)
    searched = searched_folders(names, capture.root)
    note = f"no photographs were found (searched {searched}); name their folder with --images"
    return Views(train, test, background, f"{capture.source}, no photographs", note, moves)


@dataclass(frozen=True, slots=True)
class _Photo:
    """A photograph's file and header."""

    found: FoundPhoto
    header: PhotoHeader


def _check_arguments(scale: int | None, resolution: int | None, hold_out: int) -> None:
    for name, value, least in (("scale", scale, 1), ("resolution", resolution, 1), ("hold_out", hold_out, 0)):
        if value is not None and value < least:
            raise InvalidViewsError(f"{name} must be {least} or more, not {value}")
    if hold_out == 1:
        raise InvalidViewsError("hold_out 1 would leave no training view; give 0 for no held-out views, or 2 or more")


def _read_capture(path: Path) -> Capture:
    if path.is_file():
        if path.name == "transforms_train.json":
            return read_split_transforms(path.parent)
        if path.suffix.lower() == ".json":
            return read_transforms(path)
        if path.stem in ("cameras", "images") and find_colmap(path.parent) == path.parent:
            return read_colmap(path.parent)
        raise InvalidViewsError(f"{path} is not a camera file; name the capture's folder or a transforms.json")
    model = find_colmap(path)
    if model is not None:
        return read_colmap(model)
    if (path / "transforms_train.json").is_file():
        return read_split_transforms(path)
    if (path / "transforms.json").is_file():
        return read_transforms(path / "transforms.json")
    if not path.is_dir():
        raise InvalidViewsError(f"there is no folder {path}; name the folder of a capture")
    folders = ", ".join(folder for folder in MODEL_FOLDERS if "sparse" in folder)
    raise InvalidViewsError(
        missing_part(path)
        or f"{path} has no cameras: neither a COLMAP model (in it or in {folders}) nor a transforms.json"
    )


def _view(
    posed: PosedImage,
    photo: _Photo | None,
    nominal: tuple[int, int],
    size: tuple[int, int],
    background: Float32[np.ndarray, "3"],
) -> View:
    path = None if photo is None else photo.found.path
    try:
        lens = posed.intrinsics.lens(nominal, size)
        pinhole = Camera(posed.viewmat, lens.K, *size)
        if path is None or not lens.distortion:
            return View(posed.name, pinhole, path, background)
        window = full_window(lens)
        camera = Camera(posed.viewmat, window.K(lens), window.width, window.height)
        return View(posed.name, camera, path, background, UndistortionSpec(lens, window))
    except InvalidViewsError as error:
        raise InvalidViewsError(f"{posed.where}: {error}") from error


def _sizes(posed: PosedImage, photo: _Photo | None, scale: int) -> tuple[tuple[int, int], tuple[int, int]]:
    """Return (width, height) to which the intrinsics belong, and (width, height) of the photograph before reduction."""
    width, height = posed.intrinsics.width, posed.intrinsics.height
    if photo is None:
        if width is None or height is None:
            raise InvalidViewsError(
                f"{posed.where}: it has neither a size (w, h) nor a photograph; add w and h or the photographs"
            )
        return (width, height), (max(1, round(width / scale)), max(1, round(height / scale)))
    size = (photo.header.width, photo.header.height)
    nominal = (width or size[0] * photo.found.factor, height or size[1] * photo.found.factor)
    if not _fits(size, nominal):
        if _fits(size[::-1], nominal) and orientation(photo.found.path) in QUARTER_TURNS:
            raise InvalidViewsError(
                f"{photo.found.path} has {size[0]}x{size[1]} pixels, which its EXIF orientation turns upright, and its "
                f"camera ({posed.where}) is for {nominal[0]}x{nominal[1]}; orientation is ignored here, so turn the "
                "pixels of all photographs ('mogrify -auto-orient'), or compute the cameras from them as they are"
            )
        raise InvalidViewsError(
            f"{photo.found.path} has {size[0]}x{size[1]} pixels, but its camera ({posed.where}) is for "
            f"{nominal[0]}x{nominal[1]}, another aspect ratio; name the folder of the cameras' "
            "photographs (--images of kissgs evaluate and render)"
        )
    return nominal, size


def _fits(size: tuple[int, int], nominal: tuple[int, int]) -> bool:
    """Whether a photograph of this (width, height) may be a scaled copy of one of the nominal size."""
    expected = nominal[1] * size[0] / nominal[0]
    return abs(size[1] - expected) <= MAX_ASPECT_ERROR * size[1] + 2


def _reduced(size: tuple[int, int], resolution: int) -> tuple[int, int]:
    longer = max(size)
    if longer <= resolution:
        return size
    factor = longer / resolution
    return max(1, int(size[0] / factor)), max(1, int(size[1] / factor))


def _folders(photos: Sequence[FoundPhoto]) -> str:
    """Return the names of the folders of the photographs, or their number if there are more than two."""
    folders = dict.fromkeys(photo.folder for photo in photos)
    names = [(folder.resolve() if folder.name in ("", "..") else folder).name for folder in folders]
    return " and ".join(names) if len(names) <= 2 else f"{len(names)} folders"


def _split(views: Sequence[tuple[View, str | None]], hold_out: int) -> tuple[tuple[View, ...], tuple[View, ...]]:
    views = sorted(views, key=lambda entry: entry[0].name)
    if any(split is not None for _, split in views):
        train = tuple(view for view, split in views if split == "train")
        return train, tuple(view for view, split in views if split == "test")
    everything = tuple(view for view, _ in views)
    if hold_out == 0 or len(everything) < 2:  # a single view is for training
        return everything, ()
    return tuple(view for i, view in enumerate(everything) if i % hold_out), everything[::hold_out]
