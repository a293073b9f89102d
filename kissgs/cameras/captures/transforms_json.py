"""Cameras as JSON: those of kissgs and of 3DGS, and ``transforms.json`` of NeRF, instant-ngp and nerfstudio."""

from __future__ import annotations

import codecs
import json
import math
from collections.abc import Iterable, Sequence
from contextlib import suppress
from dataclasses import replace
from pathlib import Path, PurePosixPath
from typing import Annotated, Any, Literal, TypeVar

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, FiniteFloat, StrictInt, TypeAdapter, ValidationError

from kissgs.cameras.captures.photos import (
    MAX_SIDE,
    Capture,
    Intrinsics,
    PosedImage,
    composed,
    invalid,
    quoted,
    read_json,
)
from kissgs.cameras.photographs import Distortion
from kissgs.cameras.views import Similarity, View
from kissgs.core.array_types import Float64
from kissgs.core.errors import InvalidViewsError, UnsupportedError
from kissgs.io.files import atomic_file
from kissgs.rendering.camera import Camera

# The format of kissgs, one camera per file, is::
#
#     {"viewmat": [[…4…], …4…], "K": [[…3…], …3…], "width": 1280, "height": 960}
#
# ``viewmat`` is the transform from world to camera, row by row; the camera's axes are x right, y down, z forward. ``K``
# holds the focal lengths and the principal point in pixels; the centre of the first pixel is at (0.5, 0.5). Other keys
# are ignored.
#
# An entry of ``cameras.json`` has ``position`` and ``rotation``, the transform from camera to world (the columns of
# ``rotation``, which is stored row by row, are the camera's axes), ``fx`` and ``fy`` in pixels, ``width``, ``height``,
# ``img_name`` and ``id``; the principal point is the centre of the image. A file holds one entry or a list of entries.

_WholeSide = Annotated[StrictInt, Field(ge=1, le=MAX_SIDE)]
_Length = Annotated[FiniteFloat, Field(gt=0)]
_Row3 = Annotated[list[FiniteFloat], Field(min_length=3, max_length=3)]
_Row4 = Annotated[list[FiniteFloat], Field(min_length=4, max_length=4)]


class _KissgsCamera(BaseModel):
    model_config = ConfigDict(extra="ignore")

    viewmat: Annotated[list[_Row4], Field(min_length=4, max_length=4)]
    K: Annotated[list[_Row3], Field(min_length=3, max_length=3)]
    width: _WholeSide
    height: _WholeSide


class _TrainerCamera(BaseModel):
    model_config = ConfigDict(extra="ignore")

    img_name: str | None = None
    width: _WholeSide
    height: _WholeSide
    position: _Row3
    rotation: Annotated[list[_Row3], Field(min_length=3, max_length=3)]
    fx: _Length
    fy: _Length


def read_cameras(path: Path) -> tuple[View, ...]:
    """Read the cameras of a file, in its order; a camera without a name is named after the file."""
    try:
        document: object = json.loads(read_json(path))
    except (ValueError, RecursionError) as error:
        raise InvalidViewsError(f"{path} is not JSON: {str(error).lower()}") from error
    if not isinstance(document, list):
        return (_view(document, f"{path}", path.stem),)
    if not document:
        raise InvalidViewsError(f"{path} is an empty list; it must hold at least one camera")
    return tuple(
        _view(entry, f"{path}, camera {index}", f"{path.stem}_{index}") for index, entry in enumerate(document)
    )


def camera_as_dict(camera: Camera) -> dict[str, object]:
    """Return a camera in the JSON format of kissgs, with all digits; a camera that is read has the usual dilation."""
    return {"viewmat": camera.viewmat.tolist(), "K": camera.K.tolist(), "width": camera.width, "height": camera.height}


def write_camera(path: Path, camera: Camera, *, overwrite: bool = False) -> None:
    """Write a camera in the JSON format of kissgs, atomically."""
    entries = (f'  "{name}": {json.dumps(value)}' for name, value in camera_as_dict(camera).items())
    with atomic_file(path, overwrite=overwrite) as file:
        file.write(("{\n" + ",\n".join(entries) + "\n}\n").encode())


def _view(entry: object, where: str, name: str) -> View:
    if not isinstance(entry, dict) or not {"viewmat", "rotation"} & entry.keys():
        is_capture = isinstance(entry, dict) and "frames" in entry
        hint = "; a transforms.json is a capture: pass it to --views" if is_capture else ""
        raise InvalidViewsError(
            f"{where} is not a camera: it has neither viewmat, K, width and height nor position, rotation, fx, fy, "
            f"width and height{hint}"
        )
    try:
        if "viewmat" in entry:
            return View(name, _from_kissgs(_KissgsCamera.model_validate(entry)))
        found = _TrainerCamera.model_validate(entry)
        K = np.array([[found.fx, 0, 0.5 * found.width], [0, found.fy, 0.5 * found.height], [0, 0, 1]])
        viewmat = _to_camera(np.array(found.rotation), np.array(found.position))
        return View(found.img_name or name, Camera(viewmat, K, found.width, found.height))
    except ValidationError as error:
        raise invalid(where, error) from error
    except InvalidViewsError as error:
        raise InvalidViewsError(f"{where}: {error}") from error


def _from_kissgs(found: _KissgsCamera) -> Camera:
    viewmat, K = np.array(found.viewmat), np.array(found.K)
    if not np.allclose(viewmat[3], (0, 0, 0, 1)):
        raise InvalidViewsError("the last row of viewmat is not 0 0 0 1; write the world-to-camera matrix row by row")
    if not np.allclose(K[[0, 1, 2, 2, 2], [1, 0, 0, 1, 2]], (0, 0, 0, 0, 1)):
        raise InvalidViewsError("K is not of the form [[fx, 0, cx], [0, fy, cy], [0, 0, 1]]; skew is not supported")
    return Camera(viewmat, K, found.width, found.height)


def _to_camera(rotation: Float64[np.ndarray, "3 3"], position: Float64[np.ndarray, "3"]) -> Float64[np.ndarray, "4 4"]:
    """Return the transform from world to camera, given that from camera to world."""
    viewmat = np.eye(4)
    viewmat[:3, :3] = rotation.T
    with np.errstate(all="ignore"):  # Camera rejects values that overflow
        viewmat[:3, 3] = -rotation.T @ position
    return viewmat


# Selection of a view by number, by name, or from a camera file.


def is_camera_file(which: str) -> bool:
    """Whether ``which`` has the form FILE.json, FILE.json:N or FILE.json:NAME."""
    return _split(which) is not None


def view_of_file(which: str) -> View:
    """Return the camera of FILE.json, or the one that FILE.json:N or FILE.json:NAME selects."""
    name, selected = _split(which) or (which, "")
    views = read_cameras(Path(name))
    if selected:
        return pick_view(views, selected, name)
    if len(views) > 1:
        first = views[0].name
        raise InvalidViewsError(f"{name} has {len(views)} cameras; select one, as in {name}:0 or {name}:{first}")
    return views[0]


def pick_view(views: Sequence[View], which: str, source: str) -> View:
    """Return the view with this name, else the one with this index, else the one with this file name or stem."""
    found = [view for view in views if view.name == which]
    if not found and which.isascii() and which.isdigit() and len(which) < 10:
        if int(which) >= len(views):
            raise InvalidViewsError(f"there is no view {which} in {source}; numbers go from 0 to {len(views) - 1}")
        return views[int(which)]
    if not found:
        paths = [PurePosixPath(composed(view.name)) for view in views]
        names = [(str(path), path.name, path.stem) for path in paths]
        found = [view for view, known in zip(views, names, strict=True) if composed(which) in known]
    if len(found) == 1:
        return found[0]
    if found:
        raise InvalidViewsError(f"{len(found)} views in {source} have the name {quoted(which)}; give the number of one")
    first, last = views[0].name, views[-1].name
    raise InvalidViewsError(f"there is no view {quoted(which)} in {source}; the first is {first}, the last {last}")


def _split(which: str) -> tuple[str, str] | None:
    if which.lower().endswith(".json"):
        return which, ""
    at = which.lower().rfind(".json:")
    return None if at < 0 else (which[: at + 5], which[at + 6 :])


# Poses in a ``transforms.json`` go from camera to world, with OpenGL's axes (z backward, y up); they are converted to
# world to camera, with z forward and y down. World coordinates are those of the file: instant-ngp's ``scale`` and
# ``offset`` are not applied. Scenes may have others, which :func:`similarities` returns: those of the COLMAP model from
# which nerfstudio converted the poses by ``applied_transform``, or those in which nerfstudio trained.

MAX_SKEW = 0.01  # relative difference between the singular values of a rotation, to accept rounded numbers
DATAPARSER_TRANSFORMS = "dataparser_transforms.json"  # of nerfstudio's trainer: to the coordinates of the scene

PINHOLES = ("SIMPLE_PINHOLE", "PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV", "FULL_OPENCV", "PERSPECTIVE")
"""Supported values of ``camera_model``; all given distortion coefficients apply, whatever the value."""

_Side = Annotated[FiniteFloat, Field(ge=1, le=MAX_SIDE)]
_Angle = Annotated[FiniteFloat, Field(gt=0, lt=math.pi)]
_Matrix = Annotated[list[_Row4], Field(min_length=3, max_length=4)]
_Document = TypeVar("_Document", bound=BaseModel)


class _Intrinsics(BaseModel):
    """Intrinsics, either for all frames or of one frame."""

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


class _Frame(_Intrinsics):
    file_path: str
    transform_matrix: _Matrix


class _Transforms(_Intrinsics):
    frames: Annotated[list[_Frame], Field(min_length=1)]
    train_filenames: list[str] | None = None
    test_filenames: list[str] | None = None
    val_filenames: list[str] | None = None
    applied_transform: Any = None  # another program's invalid one is no reason to refuse the file


class _DataparserTransforms(BaseModel):
    transform: _Matrix
    scale: _Length = 1.0


def read_transforms(path: Path) -> Capture:
    """Read a ``transforms.json`` with the split that it defines, if any. nerfstudio's ``train_filenames`` are for
    training, and ``test_filenames`` (``val_filenames`` if that is empty) are held out. If there is only one of these
    lists, all other frames are in the other part. If there are both, frames in neither are left out, and frames in both
    are held out."""
    document = _read(path, _Transforms)
    images = _posed_images(path, document)
    splits = _splits(path, document)
    if splits is not None:
        images = [replace(image, split=splits[key]) for image in images if (key := composed(image.name)) in splits]
    white, applied = _is_synthetic(document), _applied(path, document)
    return Capture(tuple(images), path.parent, f"cameras of {path}", {"transforms.json": path}, white, applied)


def read_trained_cameras(path: Path) -> Capture:
    """Read the ``cameras.json`` of INRIA's trainer, which names photographs without endings and folders."""
    images = []
    for index, view in enumerate(read_cameras(path)):
        (fx, _, cx), (_, fy, cy), _ = view.camera.K.tolist()
        intrinsics = Intrinsics(view.camera.width, view.camera.height, fx, fy, cx, cy)
        images.append(PosedImage(view.name, view.name, f"{path}, camera {index}", view.camera.viewmat, intrinsics))
    return Capture(tuple(images), path.parent, f"cameras of {path}", {path.name: path})


def read_split_transforms(folder: Path) -> Capture:
    """Read ``transforms_train.json``, and ``transforms_test.json`` or else ``transforms_val.json`` as held out."""
    train_path = folder / "transforms_train.json"
    tests = [folder / f"transforms_{name}.json" for name in ("test", "val")]
    test_path = next((path for path in tests if path.is_file()), None)
    document = _read(train_path, _Transforms)
    train, white = _posed_images(train_path, document), _is_synthetic(document)
    if test_path is None:
        return Capture(tuple(train), folder, f"cameras of {train_path}", {train_path.name: train_path}, white)
    test = _posed_images(test_path, _read(test_path, _Transforms))
    images = [*(replace(image, split="train") for image in train), *(replace(image, split="test") for image in test)]
    files = {path.name: path for path in (train_path, test_path)}
    return Capture(tuple(images), folder, f"cameras of {train_path} and {test_path.name}", files, white)


def dataparser_files(own: Iterable[Path], near: Iterable[Path]) -> list[Path]:
    """Return each ``dataparser_transforms.json`` in the capture's own folders and in those near it or its scene, which
    may be of another program: there, unreadable ones are left out."""
    found = dict[Path, Path]()
    for n, folder in enumerate([*(own := list(own)), *near]):
        path = folder / DATAPARSER_TRANSFORMS
        with suppress(InvalidViewsError):
            if path.is_file() and (n < len(own) or similarities([path], None)):
                found.setdefault(path.resolve(), path)
    return list(found.values())


def similarities(paths: Iterable[Path], applied: Float64[np.ndarray, "4 4"] | None) -> tuple[Similarity, ...]:
    """Return the transforms from a capture's coordinates to others that a scene of nerfstudio may have; ``paths`` are
    those of its ``dataparser_transforms.json``."""
    found = []
    for path in paths:
        document = _read(path, _DataparserTransforms)
        matrix = _similarity(document.transform, f"{path}, transform")
        matrix[:3] *= document.scale
        if applied is not None:  # nerfstudio writes the product of both, its oldest versions do not
            found.append(Similarity(path.name, matrix @ np.linalg.inv(applied)))
        found.append(Similarity(path.name, matrix))
    if applied is not None:
        found.append(Similarity("the inverse of applied_transform", np.linalg.inv(applied)))
    return tuple(found)


def _applied(path: Path, document: _Transforms) -> Float64[np.ndarray, "4 4"] | None:
    """Return the ``applied_transform``; None if it is missing, invalid or the identity."""
    try:
        matrix = _similarity(TypeAdapter(_Matrix).validate_python(document.applied_transform), str(path))
    except (ValidationError, InvalidViewsError):
        return None
    return None if np.allclose(matrix, np.eye(4)) else matrix


def _similarity(rows: list[list[float]], where: str) -> Float64[np.ndarray, "4 4"]:
    matrix = np.eye(4)
    matrix[:3] = rows[:3]
    rotation = _rotation(matrix[:3, :3], where)
    matrix[:3, :3] = rotation * np.cbrt(np.linalg.det(matrix[:3, :3]))
    return matrix


def _read(path: Path, model: type[_Document]) -> _Document:
    data = read_json(path)
    if data.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)):
        raise InvalidViewsError(f"{path} is text in UTF-16; save it as UTF-8")
    try:
        return model.model_validate_json(data)
    except ValidationError as error:
        problem = error.errors(include_url=False, include_context=False, include_input=False)[0]
        if problem["type"] == "json_invalid":
            raise InvalidViewsError(f"{path} is not JSON: {problem['msg'].removeprefix('Invalid JSON: ')}") from error
        raise invalid(str(path), error) from error


def _is_synthetic(document: _Transforms) -> bool:
    """Whether the file is in the format of NeRF's synthetic scenes: one angle of view, no lengths in pixels."""
    return document.camera_angle_x is not None and document.fl_x is None and document.frames[0].fl_x is None


def _posed_images(path: Path, document: _Transforms) -> list[PosedImage]:
    images = []
    for index, frame in enumerate(document.frames):
        where, name = f"{path}, frame {index} ({quoted(frame.file_path)})", _normalized(frame.file_path)
        viewmat, intrinsics = _viewmat(frame, where), _intrinsics(document, frame, where)
        images.append(PosedImage(name, frame.file_path, where, viewmat, intrinsics))
    return images


def _intrinsics(document: _Transforms, frame: _Frame, where: str) -> Intrinsics:
    def value(name: str) -> float | None:
        own = getattr(frame, name)
        return getattr(document, name) if own is None else own

    model = frame.camera_model or document.camera_model
    fisheye = document.is_fisheye if frame.is_fisheye is None else frame.is_fisheye
    if fisheye or (model is not None and model.upper() not in PINHOLES):
        raise UnsupportedError(
            f"{where}: the camera model {quoted('is_fisheye' if fisheye else str(model))} is not supported, only "
            f"{', '.join(PINHOLES)}; undistort the photographs first, for example with 'colmap image_undistorter'"
        )
    if value("k4"):
        problem = "the distortion coefficient k4 is not supported"
        raise UnsupportedError(f"{where}: {problem}; undistort the photographs first")
    distortion = Distortion(**{name: value(name) or 0.0 for name in ("k1", "k2", "k3", "p1", "p2")})
    width, height = (None if side is None else round(side) for side in (value("w"), value("h")))
    names = ("fl_x", "fl_y", "cx", "cy", "camera_angle_x", "camera_angle_y")
    fx, fy, cx, cy, angle_x, angle_y = (value(name) for name in names)
    return Intrinsics(width, height, fx, fy, cx, cy, angle_x, angle_y, distortion)


def _viewmat(frame: _Frame, where: str) -> Float64[np.ndarray, "4 4"]:
    matrix = np.array(frame.transform_matrix)
    if len(matrix) == 4 and not np.allclose(matrix[3], (0, 0, 0, 1)):
        raise InvalidViewsError(f"{where}: the last row of transform_matrix is not 0 0 0 1; export it again")
    rotation = _rotation(matrix[:3, :3], f"{where}: transform_matrix") * (1, -1, -1)  # flip the camera's y and z axes
    return _to_camera(rotation, matrix[:3, 3])


def _rotation(matrix: Float64[np.ndarray, "3 3"], where: str) -> Float64[np.ndarray, "3 3"]:
    """Return the rotation nearest to ``matrix``, which may have a uniform scale and rounding errors."""
    largest = np.abs(matrix).max()
    left, lengths, right = np.linalg.svd(matrix / max(largest, np.finfo(np.float64).tiny))
    if largest == 0 or lengths[2] < (1 - MAX_SKEW) * lengths[0]:
        raise InvalidViewsError(f"{where} is not a rotation: its axes are skewed or differ in length; export it again")
    rotation = left @ right
    if not np.linalg.det(rotation) > 0:
        raise InvalidViewsError(f"{where} mirrors the world; export it with a right-handed world")
    return np.asarray(rotation)


def _splits(path: Path, document: _Transforms) -> dict[str, Literal["train", "test"]] | None:
    """Return the split of each frame by composed name; None if the file defines none."""
    train, held_out = document.train_filenames, document.test_filenames
    if not held_out and document.val_filenames is not None:
        held_out = document.val_filenames
    if train is None and held_out is None:
        return None
    all_names = _name_set(frame.file_path for frame in document.frames)
    for names, key in ((train, "train_filenames"), (held_out, "test_filenames or val_filenames")):
        unknown = next((name for name in names or () if not _name_set([name]) <= all_names), None)
        if unknown is not None:
            problem = f"{quoted(unknown)} in {key} is not the file_path of a frame"
            raise InvalidViewsError(f"{path}: {problem}; correct the list")
    test = _name_set(held_out) if held_out is not None else all_names - _name_set(train)
    training = (all_names if train is None else _name_set(train)) - test
    if not training:
        raise InvalidViewsError(f"{path}: its lists of file names leave no training frame; correct train_filenames")
    splits: dict[str, Literal["train", "test"]] = dict.fromkeys(training, "train")
    return {**splits, **dict.fromkeys(test, "test")}


def _name_set(names: Iterable[str] | None) -> set[str]:
    return {composed(_normalized(name)) for name in names or ()}


def _normalized(name: str) -> str:
    """Return a path without ``./`` and with forward slashes."""
    return str(PurePosixPath(name.replace("\\", "/")))
