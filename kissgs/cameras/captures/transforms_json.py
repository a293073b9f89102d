"""``transforms.json`` of NeRF's synthetic scenes, of instant-ngp and of nerfstudio.

Their cameras look along -z with y up (OpenGL's axes) and are given from the camera to the world; ours look along z with
y down and are given from the world to the camera. The world is the file's own, unchanged: for instant-ngp without its
``scale`` and ``offset``, for nerfstudio after the ``applied_transform`` that its preparation of a COLMAP model already
made. Gaussians that were trained on that COLMAP model itself stand in another world; give the model instead.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterable
from pathlib import Path, PurePosixPath
from typing import Annotated, Literal

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, FiniteFloat, ValidationError

from kissgs.cameras.captures.files import open_file, quoted
from kissgs.cameras.captures.posed_image import MAX_SIDE, Capture, Intrinsics, PosedImage
from kissgs.cameras.undistort import Distortion
from kissgs.core.array_types import Float64
from kissgs.core.errors import InvalidViewsError, UnsupportedError

MAX_JSON_BYTES = 1 << 28
"""Ten thousand frames take some 10 MB."""

MAX_SKEW = 0.01
"""Relative deviation of a rotation's axes from one common length, and of their angles from 90 degrees."""

PINHOLES = ("SIMPLE_PINHOLE", "PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV", "FULL_OPENCV", "PERSPECTIVE")
"""Values of ``camera_model`` that are read; the coefficients count whichever it is."""

_Side = Annotated[FiniteFloat, Field(ge=1, le=MAX_SIDE)]
_Length = Annotated[FiniteFloat, Field(gt=0)]
_Angle = Annotated[FiniteFloat, Field(gt=0, lt=math.pi)]
_Row = Annotated[list[FiniteFloat], Field(min_length=4, max_length=4)]


class _Lens(BaseModel):
    """What may stand at the top, for all frames, and in a frame."""

    model_config = ConfigDict(extra="ignore", protected_namespaces=())

    w: _Side | None = None
    h: _Side | None = None
    fl_x: _Length | None = None
    fl_y: _Length | None = None
    cx: FiniteFloat | None = None
    cy: FiniteFloat | None = None
    camera_angle_x: _Angle | None = None
    camera_angle_y: _Angle | None = None
    k1: FiniteFloat | None = None
    k2: FiniteFloat | None = None
    k3: FiniteFloat | None = None
    k4: FiniteFloat | None = None
    p1: FiniteFloat | None = None
    p2: FiniteFloat | None = None
    camera_model: str | None = None
    is_fisheye: bool | None = None


class _Frame(_Lens):
    file_path: str
    transform_matrix: Annotated[list[_Row], Field(min_length=3, max_length=4)]


class _Transforms(_Lens):
    frames: Annotated[list[_Frame], Field(min_length=1)]
    train_filenames: list[str] | None = None
    test_filenames: list[str] | None = None
    val_filenames: list[str] | None = None


def read_transforms(path: Path) -> Capture:
    """Read one file of cameras, with the split that it has itself, if any.

    nerfstudio's ``train_filenames`` are for training, its ``test_filenames`` held out, or ``val_filenames`` where that
    is empty; a file with only one of these lists has all other frames in the other part. Frames in no list are left
    out, those in both are held out.

    Raises:
        InvalidViewsError: the file is no readable JSON, or lacks or contradicts something.
        UnsupportedError: a camera is a fisheye, or has a coefficient k4.
    """
    document = _read(path)
    shots = _shots(path, document)
    parts = _parts(path, document)
    if parts is not None:
        shots = [_with_split(shot, parts[shot.name]) for shot in shots if shot.name in parts]
    return Capture(tuple(shots), path.parent, f"cameras of {path}", _is_synthetic(document))


def read_split_transforms(folder: Path) -> Capture:
    """Read ``transforms_train.json``, and ``transforms_test.json`` or else ``transforms_val.json`` to be held out.

    Raises:
        InvalidViewsError: as :func:`read_transforms`.
        UnsupportedError: likewise.
    """
    train_path = folder / "transforms_train.json"
    tests = [folder / f"transforms_{name}.json" for name in ("test", "val")]
    test_path = next((path for path in tests if path.is_file()), None)
    document = _read(train_path)
    train, white = _shots(train_path, document), _is_synthetic(document)
    if test_path is None:
        return Capture(tuple(train), folder, f"cameras of {train_path}", white)
    test = _shots(test_path, _read(test_path))
    shots = [*(_with_split(shot, "train") for shot in train), *(_with_split(shot, "test") for shot in test)]
    return Capture(tuple(shots), folder, f"cameras of {train_path} and {test_path.name}", white)


def _read(path: Path) -> _Transforms:
    with open_file(path) as (file, size):
        if size > MAX_JSON_BYTES:
            raise InvalidViewsError(f"{path} has {size:,} bytes; cameras take fewer than {MAX_JSON_BYTES:,}")
        data = file.read()
    try:
        return _Transforms.model_validate_json(data.removeprefix(b"\xef\xbb\xbf"))
    except ValidationError as error:
        problem = error.errors(include_url=False, include_context=False, include_input=False)[0]
        if problem["type"] == "json_invalid":
            raise InvalidViewsError(f"{path} is not JSON: {problem['msg'].removeprefix('Invalid JSON: ')}") from error
        place = "".join(f"[{step}]" if isinstance(step, int) else f".{step}" for step in problem["loc"]).lstrip(".")
        raise InvalidViewsError(
            f"{path}{', ' if place else ''}{place}: {problem['msg'][0].lower()}{problem['msg'][1:]}"
        ) from error


def _is_synthetic(document: _Transforms) -> bool:
    """Whether it is of the dialect that NeRF's synthetic scenes brought: one angle of view, nothing in pixels."""
    return document.camera_angle_x is not None and document.fl_x is None and document.frames[0].fl_x is None


def _shots(path: Path, document: _Transforms) -> list[PosedImage]:
    shots = []
    for index, frame in enumerate(document.frames):
        where = f"{path}, frame {index} ({quoted(frame.file_path)})"
        name = _normalised(frame.file_path)
        shots.append(
            PosedImage(name, frame.file_path, where, _viewmat(frame, where), _intrinsics(document, frame, where))
        )
    return shots


def _intrinsics(document: _Transforms, frame: _Frame, where: str) -> Intrinsics:
    def value(name: str) -> float | None:
        own = getattr(frame, name)
        return getattr(document, name) if own is None else own

    model = frame.camera_model or document.camera_model
    fisheye = document.is_fisheye if frame.is_fisheye is None else frame.is_fisheye
    if fisheye or (model is not None and model.upper() not in PINHOLES):
        raise UnsupportedError(
            f"{where}: camera model {quoted('is_fisheye' if fisheye else str(model))} is not read; undistort the "
            f"photographs first, for example with 'colmap image_undistorter' (read are {', '.join(PINHOLES)})"
        )
    if value("k4"):
        raise UnsupportedError(f"{where}: the distortion coefficient k4 is not read; undistort the photographs first")
    coefficients = {name: value(name) or 0.0 for name in ("k1", "k2", "k3", "p1", "p2")}
    width, height = value("w"), value("h")
    return Intrinsics(
        width=None if width is None else round(width),
        height=None if height is None else round(height),
        fx=value("fl_x"),
        fy=value("fl_y"),
        cx=value("cx"),
        cy=value("cy"),
        angle_x=value("camera_angle_x"),
        angle_y=value("camera_angle_y"),
        distortion=Distortion(**coefficients),
    )


def _viewmat(frame: _Frame, where: str) -> Float64[np.ndarray, "4 4"]:
    matrix = np.array(frame.transform_matrix)
    if len(matrix) == 4 and not np.allclose(matrix[3], (0, 0, 0, 1)):
        raise InvalidViewsError(f"{where}: the last row of transform_matrix is not 0 0 0 1")
    rotation = _rotation(matrix[:3, :3], where) * (1, -1, -1)  # the camera's y and z axes turned round
    viewmat = np.eye(4)
    viewmat[:3, :3] = rotation.T
    with np.errstate(all="ignore"):  # what overflows, Camera refuses
        viewmat[:3, 3] = -rotation.T @ matrix[:3, 3]
    return viewmat


def _rotation(matrix: Float64[np.ndarray, "3 3"], where: str) -> Float64[np.ndarray, "3 3"]:
    """The rotation nearest to ``matrix``, which may be scaled as a whole and rounded in its last digits."""
    largest = np.abs(matrix).max()
    left, lengths, right = np.linalg.svd(matrix / max(largest, np.finfo(np.float64).tiny))
    if largest == 0 or lengths[2] < (1 - MAX_SKEW) * lengths[0]:
        raise InvalidViewsError(
            f"{where}: transform_matrix is no rotation: its axes are skewed or of different lengths; export it again"
        )
    rotation = left @ right
    if not np.linalg.det(rotation) > 0:
        raise InvalidViewsError(f"{where}: transform_matrix mirrors the world; export it with a right-handed world")
    return np.asarray(rotation)


def _parts(path: Path, document: _Transforms) -> dict[str, Literal["train", "test"]] | None:
    """Part of each frame, by its name; None if the file does not say."""
    train, held_out = document.train_filenames, document.test_filenames
    if not held_out and document.val_filenames is not None:
        held_out = document.val_filenames
    if train is None and held_out is None:
        return None
    everything = {_normalised(frame.file_path) for frame in document.frames}
    for names, key in ((train, "train_filenames"), (held_out, "test_filenames or val_filenames")):
        unknown = next((name for name in names or () if _normalised(name) not in everything), None)
        if unknown is not None:
            raise InvalidViewsError(f"{path}: {quoted(unknown)} of {key} is the file_path of no frame")
    tested = _set(held_out) if held_out is not None else everything - _set(train)
    trained = (everything if train is None else _set(train)) - tested
    if not trained:
        raise InvalidViewsError(f"{path}: its lists of file names leave no frame to learn from; mend train_filenames")
    parts: dict[str, Literal["train", "test"]] = dict.fromkeys(trained, "train")
    return {**parts, **dict.fromkeys(tested, "test")}


def _set(names: Iterable[str] | None) -> set[str]:
    return {_normalised(name) for name in names or ()}


def _with_split(shot: PosedImage, split: Literal["train", "test"]) -> PosedImage:
    return dataclasses.replace(shot, split=split)


def _normalised(name: str) -> str:
    """Without ``./`` and with forward slashes."""
    return str(PurePosixPath(name.replace("\\", "/")))
