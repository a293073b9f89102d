"""Parsers of COLMAP's ``cameras`` and ``images`` files, binary and text, into records."""

from __future__ import annotations

import codecs
import io
import struct
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from kissgs.cameras.captures.files import open_file, quoted
from kissgs.core.errors import InvalidViewsError, UnsupportedError

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
    """Return all cameras of a ``cameras.bin`` by number.

    Raises:
        InvalidViewsError: the file cannot be read, is truncated, or continues after its last camera.
        UnsupportedError: a camera has an unknown model number.
    """
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
    """Yield all images of an ``images.bin``, in order; their points are skipped.

    Raises:
        InvalidViewsError: the file cannot be read, is truncated, or continues after its last image.
    """
    with open_file(path) as (file, size):
        reader = _Reader(path, file, size)
        for _ in range(reader.count("images", _MIN_IMAGE_BYTES)):
            _, *pose, camera = reader.unpack(_IMAGE)
            name = reader.string()
            reader.skip(reader.unpack(_COUNT)[0] * _POINT_BYTES)
            yield ImageRecord(name, camera, tuple(pose[:4]), tuple(pose[4:]))
        reader.finish("image")


def read_text_cameras(path: Path) -> dict[int, CameraRecord]:
    """Return all cameras of a ``cameras.txt`` by number.

    Raises:
        InvalidViewsError: the file cannot be read, or a line does not describe a camera.
    """
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
    """Yield all images of an ``images.txt``, in order.

    Raises:
        InvalidViewsError: the file cannot be read, a line does not describe an image, or its line of points is missing.
    """
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
