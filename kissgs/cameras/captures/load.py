"""``load_views``: a capture of any kind, as cameras at the size of their photographs."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from kissgs.cameras.captures.colmap import PLACES, find_colmap, half_model, read_colmap
from kissgs.cameras.captures.photos import FoundPhoto, find_photos, where_looked
from kissgs.cameras.captures.posed_image import Capture, PosedImage
from kissgs.cameras.captures.transforms_json import read_split_transforms, read_transforms
from kissgs.cameras.pixels import PhotoHeader, read_photo_header
from kissgs.cameras.undistort import full_window
from kissgs.cameras.views import UndistortionSpec, View, Views
from kissgs.core.array_types import Float32
from kissgs.core.errors import InvalidViewsError
from kissgs.rendering.camera import Camera

RESOLUTION = 1600
"""Pixels of the longer side. For landscape pictures it is the protocol of 3DGS, without which published figures do not
compare; INRIA's code looks at the width alone, and so reduces portrait pictures less, or not at all."""

HOLD_OUT = 8
"""Every eighth view, from the first: the protocol of 3DGS and Mip-NeRF 360."""

MAX_STRETCH = 0.01
"""Relative difference in shape between a photograph and its camera. Scaled folders round their sides."""


def load_views(
    path: Path,
    *,
    scale: int | None = None,
    images: Path | None = None,
    resolution: int | None = None,
    hold_out: int = HOLD_OUT,
) -> Views:
    """Open a capture. Of photographs, only the first bytes are read.

    Read are a COLMAP model (in the folder, ``sparse/0``, ``sparse`` or ``colmap/sparse/0``), NeRF's
    ``transforms_train.json`` with its siblings, and ``transforms.json``; where a folder has several, the first of
    these. A path to a ``.json`` file, or to a file of a model, is read as just that.

    Every camera is brought to its photograph's real size, which counts more than what the file of cameras says. A
    longer side of more than ``resolution`` pixels is then reduced to it, by INRIA's formula, whose rounding may lose
    one pixel; INRIA's own code reduces only what is wider than that, and so leaves portrait pictures larger.
    Photographs of a distorting lens are undistorted when they are loaded.

    Where there is no folder of photographs at all, the views are cameras alone, distortion left out, and a note says
    so. Where some photographs are missing, nothing is skipped: figures of a part would pass for those of the whole.

    Args:
        path: of the capture's folder, or of its file of cameras.
        scale: take the photographs from the folder of this scale, such as 4 for ``images_4``. None takes the
            full-size folder if there is one, else that of scale 4, else the largest; without any ``images`` it is
            ``input``, where INRIA's ``convert.py`` has them.
        images: take them from this folder instead.
        resolution: the largest longer side of a picture, pixels; None stands for 1600.
        hold_out: every such view, of all sorted by name from the first on, is for testing; 0 for none. A capture that
            says itself which are to be held out is obeyed.

    Raises:
        InvalidViewsError: there is no capture; its files are damaged; photographs are missing or of another shape
            than their cameras; an argument is impossible.
        UnsupportedError: a camera is of a kind that is not read, such as a fisheye.
    """
    _check_arguments(scale, resolution, hold_out)
    try:
        capture = _read_capture(Path(path))
    except OSError as error:  # looking at a path may already fail: no permission, a name too long
        raise InvalidViewsError(f"cannot read {path}: {(error.strerror or str(error)).lower()}") from error
    names = [shot.photo for shot in capture.shots]
    photos = find_photos(names, capture.root, scale=scale, images=images)
    pictures: list[_Picture | None] = [None] * len(capture.shots)
    if photos is not None:
        pictures = [_Picture(photo, read_photo_header(photo.path)) for photo in photos]
    white = capture.white and (pictures[0] is None or pictures[0].header.transparent)
    background = np.full(3, float(white), dtype=np.float32)
    limit = RESOLUTION if resolution is None else resolution
    views = []
    for shot, picture in zip(capture.shots, pictures, strict=True):
        nominal, size = _sizes(shot, picture, scale or 1)
        views.append((_view(shot, picture, nominal, _reduced(size, limit), background), shot.split))
    train, test = _split(views, hold_out)
    if photos is not None:
        return Views(train, test, background, f"{capture.source}, photographs of {_folders(photos)}")
    looked = where_looked(names, capture.root)
    note = f"no photographs were found (looked in {looked}); name their folder with --images"
    return Views(train, test, background, f"{capture.source}, no photographs", note)


@dataclass(frozen=True, slots=True)
class _Picture:
    """A photograph, and what its first bytes tell."""

    photo: FoundPhoto
    header: PhotoHeader


def _check_arguments(scale: int | None, resolution: int | None, hold_out: int) -> None:
    for name, value, least in (("scale", scale, 1), ("resolution", resolution, 1), ("hold_out", hold_out, 0)):
        if value is not None and value < least:
            raise InvalidViewsError(f"{name} must be {least} or more, not {value}")
    if hold_out == 1:
        raise InvalidViewsError("hold_out 1 would leave no view to learn from; give 0 for none, or 2 or more")


def _read_capture(path: Path) -> Capture:
    if path.is_file():
        if path.name == "transforms_train.json":
            return read_split_transforms(path.parent)
        if path.suffix.lower() == ".json":
            return read_transforms(path)
        if path.stem in ("cameras", "images") and find_colmap(path.parent) == path.parent:
            return read_colmap(path.parent)
        raise InvalidViewsError(f"{path} is no file of cameras; name the capture's folder or a transforms.json")
    model = find_colmap(path)
    if model is not None:
        return read_colmap(model)
    if (path / "transforms_train.json").is_file():
        return read_split_transforms(path)
    if (path / "transforms.json").is_file():
        return read_transforms(path / "transforms.json")
    if not path.is_dir():
        raise InvalidViewsError(f"there is no folder {path}; name the folder of a capture")
    places = ", ".join(place for place in PLACES if "sparse" in place)
    raise InvalidViewsError(
        half_model(path)
        or f"{path} has no cameras: neither a COLMAP model (there or in {places}) nor a transforms.json"
    )


def _view(
    shot: PosedImage,
    picture: _Picture | None,
    nominal: tuple[int, int],
    size: tuple[int, int],
    background: Float32[np.ndarray, "3"],
) -> View:
    path = None if picture is None else picture.photo.path
    try:
        lens = shot.intrinsics.lens(nominal, size)
        pinhole = Camera(shot.viewmat, lens.K, *size)
        if path is None or not lens.distortion:
            return View(shot.name, pinhole, path, background)
        window = full_window(lens)
        camera = Camera(shot.viewmat, window.K(lens), window.width, window.height)
        return View(shot.name, camera, path, background, UndistortionSpec(lens, window))
    except InvalidViewsError as error:
        raise InvalidViewsError(f"{shot.where}: {error}") from error


def _sizes(shot: PosedImage, picture: _Picture | None, scale: int) -> tuple[tuple[int, int], tuple[int, int]]:
    """The camera's own size, to which its intrinsics belong, and that of its picture, before any reduction."""
    width, height = shot.intrinsics.width, shot.intrinsics.height
    if picture is None:
        if width is None or height is None:
            raise InvalidViewsError(f"{shot.where}: it has neither a size (w, h) nor a photograph to take it from")
        return (width, height), (max(1, round(width / scale)), max(1, round(height / scale)))
    photo, size = picture.photo, (picture.header.width, picture.header.height)
    nominal = (width or size[0] * photo.factor, height or size[1] * photo.factor)
    expected = nominal[1] * size[0] / nominal[0]
    if abs(size[1] - expected) > MAX_STRETCH * size[1] + 2:
        raise InvalidViewsError(
            f"{photo.path} is {size[0]}x{size[1]} pixels, but its camera ({shot.where}) is for "
            f"{nominal[0]}x{nominal[1]}, another shape; name the folder of the photographs that the cameras belong to "
            "(--images)"
        )
    return nominal, size


def _reduced(size: tuple[int, int], resolution: int) -> tuple[int, int]:
    longer = max(size)
    if longer <= resolution:
        return size
    factor = longer / resolution
    return max(1, int(size[0] / factor)), max(1, int(size[1] / factor))


def _folders(photos: Sequence[FoundPhoto]) -> str:
    """Where photographs are, in words."""
    folders = dict.fromkeys(photo.folder for photo in photos)
    names = [(folder.resolve() if folder.name in ("", "..") else folder).name for folder in folders]
    return " and ".join(names) if len(names) <= 2 else f"{len(names)} folders"


def _split(views: Sequence[tuple[View, str | None]], hold_out: int) -> tuple[tuple[View, ...], tuple[View, ...]]:
    views = sorted(views, key=lambda entry: entry[0].name)
    if any(split is not None for _, split in views):
        train = tuple(view for view, split in views if split == "train")
        return train, tuple(view for view, split in views if split == "test")
    everything = tuple(view for view, _ in views)
    if hold_out == 0 or len(everything) < 2:  # a single view is for learning
        return everything, ()
    return tuple(view for i, view in enumerate(everything) if i % hold_out), everything[::hold_out]
