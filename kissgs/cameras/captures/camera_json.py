"""Cameras as JSON: our own, one to a file, and the ``cameras.json`` that trainers of the 3DGS family write.

Ours is::

    {"viewmat": [[…4…], …4…], "K": [[…3…], …3…], "width": 1280, "height": 960}

``viewmat``, by rows, takes the world to the camera, which has x to the right, y down and z forward; ``K`` holds the
focal lengths and the principal point in pixels, the centre of the first pixel being at (0.5, 0.5). Other keys are
ignored.

An entry of ``cameras.json`` has ``position`` and ``rotation``, which take the same camera to the world (the
columns of ``rotation``, written by rows, are the camera's axes), ``fx`` and ``fy`` in pixels, ``width``, ``height``,
``img_name`` and ``id``; the principal point is the middle of the picture. A file holds a list of these, or one.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, FiniteFloat, StrictInt, ValidationError

from kissgs.cameras.captures.files import open_file
from kissgs.cameras.captures.posed_image import MAX_SIDE
from kissgs.cameras.views import View
from kissgs.core.array_types import Float64
from kissgs.core.errors import InvalidViewsError
from kissgs.io.atomic import atomic_file
from kissgs.rendering.camera import Camera

MAX_JSON_BYTES = 1 << 28
"""Ten thousand cameras take some 5 MB."""

_Side = Annotated[StrictInt, Field(ge=1, le=MAX_SIDE)]
_Focal = Annotated[FiniteFloat, Field(gt=0)]
_Row3 = Annotated[list[FiniteFloat], Field(min_length=3, max_length=3)]
_Row4 = Annotated[list[FiniteFloat], Field(min_length=4, max_length=4)]


class _Ours(BaseModel):
    model_config = ConfigDict(extra="ignore")

    viewmat: Annotated[list[_Row4], Field(min_length=4, max_length=4)]
    K: Annotated[list[_Row3], Field(min_length=3, max_length=3)]
    width: _Side
    height: _Side


class _Trainers(BaseModel):
    model_config = ConfigDict(extra="ignore")

    img_name: str | None = None
    width: _Side
    height: _Side
    position: _Row3
    rotation: Annotated[list[_Row3], Field(min_length=3, max_length=3)]
    fx: _Focal
    fy: _Focal


def read_cameras(path: Path) -> tuple[View, ...]:
    """The cameras of a file in their order; without a name in the file, a camera is called after the file.

    Raises:
        InvalidViewsError: it cannot be read, is no JSON, or is not such a file.
    """
    document = _parse(path)
    if not isinstance(document, list):
        return (_view(document, f"{path}", path.stem),)
    if not document:
        raise InvalidViewsError(f"{path} is an empty list; it should hold a camera or several")
    return tuple(
        _view(entry, f"{path}, camera {index}", f"{path.stem}_{index}") for index, entry in enumerate(document)
    )


def camera_as_dict(camera: Camera) -> dict[str, object]:
    """In our own form; all digits, so that reading it gives the same camera."""
    return {
        "viewmat": camera.viewmat.tolist(),
        "K": camera.K.tolist(),
        "width": camera.width,
        "height": camera.height,
    }


def write_camera(path: Path, camera: Camera, *, overwrite: bool = False) -> None:
    """Write a camera in our own form, whole or not at all.

    Raises:
        OutputError: the file exists and ``overwrite`` is false, or the disk refuses.
    """
    entries = (f'  "{name}": {json.dumps(value)}' for name, value in camera_as_dict(camera).items())
    with atomic_file(path, overwrite=overwrite) as file:
        file.write(("{\n" + ",\n".join(entries) + "\n}\n").encode())


def _parse(path: Path) -> object:
    with open_file(path) as (file, size):
        if size > MAX_JSON_BYTES:
            raise InvalidViewsError(f"{path} has {size:,} bytes; cameras take fewer than {MAX_JSON_BYTES:,}")
        data = file.read()
    try:
        return json.loads(data.removeprefix(b"\xef\xbb\xbf"))
    except (ValueError, RecursionError) as error:
        raise InvalidViewsError(f"{path} is not JSON: {str(error).lower()}") from error


def _view(entry: object, where: str, name: str) -> View:
    if not isinstance(entry, dict) or not {"viewmat", "rotation"} & entry.keys():
        hint = "; a transforms.json is a capture: give it to --views" if _is_transforms(entry) else ""
        raise InvalidViewsError(
            f"{where} is no camera: it has neither viewmat, K, width and height nor position, rotation, fx, fy, width "
            f"and height{hint}"
        )
    try:
        if "viewmat" in entry:
            return View(name, _from_ours(_Ours.model_validate(entry)))
        found = _Trainers.model_validate(entry)
        return View(found.img_name or name, _from_trainers(found))
    except ValidationError as error:
        problem = error.errors(include_url=False, include_context=False, include_input=False)[0]
        place = "".join(f"[{step}]" if isinstance(step, int) else f".{step}" for step in problem["loc"]).lstrip(".")
        raise InvalidViewsError(f"{where}, {place}: {problem['msg'][0].lower()}{problem['msg'][1:]}") from error
    except InvalidViewsError as error:
        raise InvalidViewsError(f"{where}: {error}") from error


def _is_transforms(entry: object) -> bool:
    return isinstance(entry, dict) and "frames" in entry


def _from_ours(found: _Ours) -> Camera:
    viewmat, K = np.array(found.viewmat), np.array(found.K)
    if not np.allclose(viewmat[3], (0, 0, 0, 1)):
        raise InvalidViewsError("the last row of viewmat is not 0 0 0 1; write the matrix by rows, world to camera")
    if not np.allclose(K[[0, 1, 2, 2, 2], [1, 0, 0, 1, 2]], (0, 0, 0, 0, 1)):
        raise InvalidViewsError("K is not [[fx, 0, cx], [0, fy, cy], [0, 0, 1]]; it may have no skew")
    return Camera(viewmat, K, found.width, found.height)


def _from_trainers(found: _Trainers) -> Camera:
    to_world = np.array(found.rotation)
    viewmat = np.eye(4)
    viewmat[:3, :3] = to_world.T
    with np.errstate(all="ignore"):  # what overflows, Camera refuses
        viewmat[:3, 3] = -to_world.T @ np.array(found.position)
    return Camera(viewmat, _centred(found), found.width, found.height)


def _centred(found: _Trainers) -> Float64[np.ndarray, "3 3"]:
    return np.array([[found.fx, 0, 0.5 * found.width], [0, found.fy, 0.5 * found.height], [0, 0, 1]])
