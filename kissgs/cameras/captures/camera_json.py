"""Cameras as JSON: the format of kissgs, one camera per file, and the ``cameras.json`` of 3DGS and its derivatives.

The format of kissgs is::

    {"viewmat": [[…4…], …4…], "K": [[…3…], …3…], "width": 1280, "height": 960}

``viewmat`` is the transform from world to camera, row by row; the camera's axes are x right, y down, z forward. ``K``
holds the focal lengths and the principal point in pixels; the centre of the first pixel is at (0.5, 0.5). Other keys
are ignored.

An entry of ``cameras.json`` has ``position`` and ``rotation``, the transform from camera to world (the columns of
``rotation``, which is stored row by row, are the camera's axes), ``fx`` and ``fy`` in pixels, ``width``, ``height``,
``img_name`` and ``id``; the principal point is the centre of the image. A file holds one entry or a list of entries.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path, PurePosixPath
from typing import Annotated

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, FiniteFloat, StrictInt, ValidationError

from kissgs.cameras.captures.posed_image import MAX_SIDE, composed, invalid, quoted, read_json
from kissgs.cameras.views import View
from kissgs.core.array_types import Float64
from kissgs.core.errors import InvalidViewsError
from kissgs.io.files import atomic_file
from kissgs.rendering.camera import Camera

_Side = Annotated[StrictInt, Field(ge=1, le=MAX_SIDE)]
_Focal = Annotated[FiniteFloat, Field(gt=0)]
_Row3 = Annotated[list[FiniteFloat], Field(min_length=3, max_length=3)]
_Row4 = Annotated[list[FiniteFloat], Field(min_length=4, max_length=4)]


class _KissgsCamera(BaseModel):
    model_config = ConfigDict(extra="ignore")

    viewmat: Annotated[list[_Row4], Field(min_length=4, max_length=4)]
    K: Annotated[list[_Row3], Field(min_length=3, max_length=3)]
    width: _Side
    height: _Side


class _TrainerCamera(BaseModel):
    model_config = ConfigDict(extra="ignore")

    img_name: str | None = None
    width: _Side
    height: _Side
    position: _Row3
    rotation: Annotated[list[_Row3], Field(min_length=3, max_length=3)]
    fx: _Focal
    fy: _Focal


def read_cameras(path: Path) -> tuple[View, ...]:
    """Read the cameras of a file, in its order; a camera without a name is named after the file."""
    document = _parse(path)
    if not isinstance(document, list):
        return (_view(document, f"{path}", path.stem),)
    if not document:
        raise InvalidViewsError(f"{path} is an empty list; it must hold at least one camera")
    return tuple(
        _view(entry, f"{path}, camera {index}", f"{path.stem}_{index}") for index, entry in enumerate(document)
    )


def camera_as_dict(camera: Camera) -> dict[str, object]:
    """Return a camera in the JSON format of kissgs, with all digits; a camera that is read has the usual dilation."""
    return {
        "viewmat": camera.viewmat.tolist(),
        "K": camera.K.tolist(),
        "width": camera.width,
        "height": camera.height,
    }


def write_camera(path: Path, camera: Camera, *, overwrite: bool = False) -> None:
    """Write a camera in the JSON format of kissgs, atomically."""
    entries = (f'  "{name}": {json.dumps(value)}' for name, value in camera_as_dict(camera).items())
    with atomic_file(path, overwrite=overwrite) as file:
        file.write(("{\n" + ",\n".join(entries) + "\n}\n").encode())


def _parse(path: Path) -> object:
    try:
        return json.loads(read_json(path))
    except (ValueError, RecursionError) as error:
        raise InvalidViewsError(f"{path} is not JSON: {str(error).lower()}") from error


def _view(entry: object, where: str, name: str) -> View:
    if not isinstance(entry, dict) or not {"viewmat", "rotation"} & entry.keys():
        hint = "; a transforms.json is a capture: pass it to --views" if _is_transforms(entry) else ""
        raise InvalidViewsError(
            f"{where} is not a camera: it has neither viewmat, K, width and height nor position, rotation, fx, fy, "
            f"width and height{hint}"
        )
    try:
        if "viewmat" in entry:
            return View(name, _from_kissgs(_KissgsCamera.model_validate(entry)))
        found = _TrainerCamera.model_validate(entry)
        return View(found.img_name or name, _from_trainer(found))
    except ValidationError as error:
        raise invalid(where, error) from error
    except InvalidViewsError as error:
        raise InvalidViewsError(f"{where}: {error}") from error


def _is_transforms(entry: object) -> bool:
    return isinstance(entry, dict) and "frames" in entry


def _from_kissgs(found: _KissgsCamera) -> Camera:
    viewmat, K = np.array(found.viewmat), np.array(found.K)
    if not np.allclose(viewmat[3], (0, 0, 0, 1)):
        raise InvalidViewsError("the last row of viewmat is not 0 0 0 1; write the world-to-camera matrix row by row")
    if not np.allclose(K[[0, 1, 2, 2, 2], [1, 0, 0, 1, 2]], (0, 0, 0, 0, 1)):
        raise InvalidViewsError("K is not of the form [[fx, 0, cx], [0, fy, cy], [0, 0, 1]]; skew is not supported")
    return Camera(viewmat, K, found.width, found.height)


def _from_trainer(found: _TrainerCamera) -> Camera:
    to_world = np.array(found.rotation)
    viewmat = np.eye(4)
    viewmat[:3, :3] = to_world.T
    with np.errstate(all="ignore"):  # Camera rejects values that overflow
        viewmat[:3, 3] = -to_world.T @ np.array(found.position)
    return Camera(viewmat, _intrinsics(found), found.width, found.height)


def _intrinsics(found: _TrainerCamera) -> Float64[np.ndarray, "3 3"]:
    return np.array([[found.fx, 0, 0.5 * found.width], [0, found.fy, 0.5 * found.height], [0, 0, 1]])


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
    """Return the view with this name, else the one with this index, else the one with this file name or stem.

    For example, ``a.png`` and ``a`` select ``images/a.png`` if no other view matches.
    """
    found = [view for view in views if view.name == which]
    if not found and which.isascii() and which.isdigit() and len(which) < 10:
        if int(which) >= len(views):
            raise InvalidViewsError(f"there is no view {which} in {source}; numbers go from 0 to {len(views) - 1}")
        return views[int(which)]
    if not found:
        found = [view for view in views if composed(which) in _names(view)]
    if len(found) == 1:
        return found[0]
    if found:
        raise InvalidViewsError(f"{len(found)} views in {source} have the name {quoted(which)}; give the number of one")
    first, last = views[0].name, views[-1].name
    raise InvalidViewsError(f"there is no view {quoted(which)} in {source}; the first is {first}, the last {last}")


def _names(view: View) -> tuple[str, str, str]:
    path = PurePosixPath(composed(view.name))
    return str(path), path.name, path.stem


def _split(which: str) -> tuple[str, str] | None:
    if which.lower().endswith(".json"):
        return which, ""
    at = which.lower().rfind(".json:")
    return None if at < 0 else (which[: at + 5], which[at + 6 :])
