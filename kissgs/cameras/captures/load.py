"""Captures: photographs with the cameras of a COLMAP model (``.bin`` or ``.txt``) or of ``transforms.json``."""

from __future__ import annotations

import ast
import io
import zipfile
from collections.abc import Sequence
from contextlib import suppress
from os import PathLike
from pathlib import Path, PurePosixPath
from typing import NamedTuple

import numpy as np
from PIL import Image

from kissgs.cameras.captures.colmap import MODEL_FOLDERS, find_colmap, missing_part, read_colmap
from kissgs.cameras.captures.photos import (
    IMAGES,
    Capture,
    FoundPhoto,
    PosedImage,
    find_photos,
    is_absolute,
    open_file,
    quoted,
    searched_folders,
    without_parents,
)
from kissgs.cameras.captures.transforms_json import (
    DATAPARSER_TRANSFORMS,
    dataparser_files,
    read_split_transforms,
    read_trained_cameras,
    read_transforms,
    similarities,
)
from kissgs.cameras.photographs import QUARTER_TURNS, full_window, orientation, read_photo, read_photo_header
from kissgs.cameras.views import View, Views, black
from kissgs.core.array_types import Float32
from kissgs.core.context import Progress, silent
from kissgs.core.errors import InvalidViewsError
from kissgs.formats import MAX_PACKED_NAME, PHOTOGRAPHS, is_packable
from kissgs.io.files import atomic_file
from kissgs.rendering.camera import Camera

DEFAULT_RESOLUTION = 1600
"""Default maximum of the longer side, pixels. For landscape photographs this is the protocol of 3DGS, on which
published results depend; INRIA's code limits only the width, so that portrait photographs stay larger."""

HOLD_OUT = 8  # every eighth view, starting with the first, is held out: the protocol of 3DGS and Mip-NeRF 360
JSONS = ("transforms.json", "transforms_train.json")
ARGUMENTS, TRAINED_CAMERAS = "cfg_args", "cameras.json"  # of INRIA's trainer, in the folder of a scene
MAX_ARGUMENTS_BYTES = 1 << 16  # of cfg_args that are read; INRIA's trainer writes 300
EVERY_EIGHTH = "cfg_args says eval=False, so the scene was trained on every eighth photograph, which is held out here"
MAX_ASPECT_ERROR = 0.01  # relative difference of aspect ratios of photograph and camera; scaled copies round sides


def load_views(
    path: Path,
    *,
    scale: int | None = None,
    images: Path | None = None,
    resolution: int | None = None,
    hold_out: int = HOLD_OUT,
    scene: Path | None = None,
    unpacked: bool = False,
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
    ``dataparser_transforms.json``, in the folder of its run that ``scene`` is from, in the capture's folder or beside
    the camera file, is read for those who compare the views with a scene (:attr:`Views.similarities`). A folder of
    INRIA's trainer stands for the capture, the folder of photographs and the background that its ``cfg_args`` names;
    where that capture is elsewhere, for the cameras of its ``cameras.json``.

    If there is no folder of photographs, views have cameras only, without distortion, and ``note`` says so. If only
    some photographs are missing, an error is raised, because results from fewer views could pass for those of all.

    Args:
        path: folder of the capture, or its camera file; or its folder of a scale, such as ``DATA/images_4``, which
            then has the photographs.
        scale: use the photographs in the folder of this scale, such as 4 for ``images_4``. Default: the full-size
            folder, else that of scale 4, else the largest; if there is no ``images`` of any scale, ``input``, where
            INRIA's ``convert.py`` keeps the originals.
        images: use the photographs in this folder instead.
        resolution: maximum of the longer side, pixels; None for 1600.
        hold_out: every ``hold_out``-th view in order of names, starting with the first, is held out; 0 for none. A
            split that the capture defines takes precedence.
        scene: file of the scene that the views are for.
        unpacked: ``path`` is the folder of an archive from elsewhere. The capture is its uppermost folder with cameras,
            and photographs are looked for in it only, wherever a camera file says they are.

    Raises:
        InvalidViewsError: there is no capture, its files are damaged, photographs are missing or of another aspect
            ratio than their cameras, or an argument is out of range.
        UnsupportedError: a camera has an unsupported model, such as a fisheye.
    """
    for name, value, least in (("scale", scale, 1), ("resolution", resolution, 1), ("hold_out", hold_out, 0)):
        if value is not None and value < least:
            raise InvalidViewsError(f"{name} must be {least} or more, not {value}")
    if hold_out == 1:
        raise InvalidViewsError("hold_out 1 would leave no training view; give 0 for no held-out views, or 2 or more")
    path = archive = Path(path)
    try:
        place = _Place(_uppermost_with_cameras(path)) if unpacked else _place(path, scale, images)
        path, scale, images = place[:3]
        capture = _read_capture(path)
        near = sorted(file.parent for file in archive.rglob(DATAPARSER_TRANSFORMS)) if unpacked else _run(scene)
        moves = similarities(dataparser_files(_own(path, capture), near), capture.applied)
    except OSError as error:  # even testing for a path fails without permission or if a name is too long
        raise InvalidViewsError(f"cannot read {path}: {(error.strerror or str(error)).lower()}") from error
    names = [posed.photo for posed in capture.images]
    photos = find_photos(names, capture.root, scale=scale, images=images, inside=unpacked)
    white = _is_white(capture, photos or ()) if place.white is None else place.white
    background = np.full(3, float(white), dtype=np.float32)
    limit = DEFAULT_RESOLUTION if resolution is None else resolution
    train, test = _split(_posed_views(capture, photos, scale or 1, limit, background), hold_out)
    source = capture.source
    if unpacked:  # where it is unpacked is nobody's concern
        source = source.replace(f"{archive}/", "").replace(f"{archive}", "the archive")
    notes = [place.note, EVERY_EIGHTH if place.trained_on_all and test else ""]
    if photos is None:
        searched = f"no photographs were found (searched {searched_folders(names, capture.root)})"
        notes.append("the archive has no photographs" if unpacked else f"{searched}; name their folder with --images")
    source = f"{source}, no photographs" if photos is None else f"{source}, photographs of {_folders(photos)}"
    note = "; ".join(filter(None, notes))
    points = None if photos is None else capture.points
    return Views(train, test, background, source, note, similarities=moves, points=points)


def _posed_views(
    capture: Capture, photos: Sequence[FoundPhoto] | None, scale: int, limit: int, background: Float32[np.ndarray, "3"]
) -> list[tuple[View, str | None]]:
    """Return the view of each image of a capture, and its split."""
    views = list[tuple[View, str | None]]()
    for n, posed in enumerate(capture.images):
        photo = None if photos is None else photos[n]
        nominal, size = _sizes(posed, photo, scale)
        file = None if photo is None else photo.path
        views.append((_view(posed, file, nominal, _reduced(size, limit), background), posed.split))
    return views


def as_views(views: Views | str | PathLike[str] | None, scene: Path | None = None) -> Views | None:
    """Return the views, which are loaded for the scene in a file if they are the path of a capture."""
    return views if views is None or isinstance(views, Views) else load_views(Path(views), scene=scene)


def _read_capture(path: Path) -> Capture:
    if path.is_file():
        if path.name == TRAINED_CAMERAS:
            return read_trained_cameras(path)
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


def _of_scale(path: Path) -> tuple[Path, int | None]:
    """Return the capture and the scale of a folder such as ``DATA/images_4``, which has no cameras; else ``path``."""
    prefix, _, scale = path.name.partition("_")
    if prefix == IMAGES and scale.isdecimal() and path.is_dir() and not _has_cameras(path):
        return path.parent, int(scale)
    return path, None


class _Place(NamedTuple):
    """Place of a capture, and INRIA's choices for it."""

    path: Path
    scale: int | None = None
    images: Path | None = None
    white: bool | None = None  # whether the background is; None: as the capture says
    trained_on_all: bool = False  # also on views that are held out here
    note: str = ""


def _place(path: Path, scale: int | None = None, images: Path | None = None) -> _Place:
    """Return the capture for which a path stands, with the scale or the folder of its photographs."""
    trained = _trained_on(path)
    if trained is not None:
        path, images = trained.path, trained.images if scale is None and images is None else images
    if scale is None and images is None:
        path, scale = _of_scale(path)
    return (trained or _Place(path))._replace(path=path, scale=scale, images=images)


def _is_white(capture: Capture, photos: Sequence[FoundPhoto]) -> bool:
    return capture.white and (not photos or read_photo_header(photos[0].path).transparent)


def _own(path: Path, capture: Capture) -> list[Path]:
    return [path if path.is_dir() else path.parent, capture.root]


def _run(scene: Path | None) -> list[Path]:
    """Return the folder of nerfstudio's run that a scene is from, in it or in its folder of checkpoints."""
    folders = [] if scene is None else list(scene.absolute().parents)[:2]
    return [folder for folder in folders if (folder / "config.yml").is_file()]


def _trained_on(folder: Path) -> _Place | None:
    """Return what ``cfg_args`` of INRIA's trainer names, or its cameras if that is not here; None of a folder that it
    has not written, or with a capture of its own. It is Python's text of a ``Namespace``, which is parsed and never
    evaluated."""
    file, cameras, given = folder / ARGUMENTS, folder / TRAINED_CAMERAS, dict[str | None, object]()
    if not file.is_file() or _has_cameras(folder):
        return None
    with suppress(SyntaxError, ValueError, RecursionError, MemoryError), open_file(file) as (opened, _):
        call = ast.parse(opened.read(MAX_ARGUMENTS_BYTES).decode("utf-8-sig"), mode="eval").body
        keywords = call.keywords if isinstance(call, ast.Call) else []
        given = {each.arg: each.value.value for each in keywords if isinstance(each.value, ast.Constant)}
    named, photographs = str(given.get("source_path") or ""), str(given.get("images"))
    capture = next((each for each in (Path(named), folder / named) if named and each.is_dir()), None)
    white, on_all = given.get("white_background") is True, given.get("eval") is False
    if capture is None:
        missing = f"{file} names no capture that is here: {quoted(named)}"
        if not cameras.is_file():
            raise InvalidViewsError(f"{missing}; name the capture's folder with --views")
        return _Place(cameras, white=white, trained_on_all=on_all, note=f"{missing}, so its {TRAINED_CAMERAS} is used")
    usual = photographs == IMAGES or not (capture / photographs).is_dir()
    return _Place(capture, images=None if usual else capture / photographs, white=white, trained_on_all=on_all)


def capture_of(path: Path, scene: Path | None) -> Path:
    """Return the capture of a scene: ``path`` if it has cameras, else the first folder in it that has and is named as
    the scene, or as one of the three folders above.

    Raises:
        InvalidViewsError: ``path`` is a folder of other folders, none of which is the scene's capture.
    """
    folders = list[Path]()  # none where the path is no folder that can be read, of which loading it tells
    with suppress(OSError):
        folders = [] if scene is None or is_capture(path) else list(path.iterdir())
    if scene is None or not any(map(is_capture, folders)):
        return path
    names = [name for name in (scene.stem, *(folder.name for folder in scene.absolute().parents[:3])) if name]
    found = next((path / name for name in names if is_capture(path / name)), None)
    if found is None:
        wanted = ", ".join(map(quoted, names))
        remedy = "name the capture of the scene"
        raise InvalidViewsError(f"{path} has no cameras, nor has a folder in it named {wanted}; {remedy}")
    return found


def is_capture(path: Path) -> bool:
    """Whether a folder has cameras, or names those that INRIA's trainer was given."""
    with suppress(OSError, ValueError):
        return _has_cameras(path) or (path / ARGUMENTS).is_file() or _of_scale(path)[1] is not None
    return False


def _has_cameras(folder: Path) -> bool:
    return bool(find_colmap(folder)) or any((folder / name).is_file() for name in JSONS)


def _uppermost_with_cameras(path: Path) -> Path:
    """Return the first of ``path`` and the folders in it, the uppermost first, that has cameras; else ``path``. Refuse
    cameras in another folder that is not inside this one: a model is inside, a second capture beside."""
    below = sorted((each for each in path.rglob("*") if each.is_dir()), key=lambda each: (len(each.parts), each))
    has_cameras = [each for each in (path, *below) if _has_cameras(each)]
    first = has_cameras[0] if has_cameras else path
    second = next((each for each in has_cameras if not each.is_relative_to(first)), None)
    if second is not None:
        names = " and ".join(quoted(str(each.relative_to(path))) for each in (first, second))
        raise InvalidViewsError(f"the archive has two captures, {names}; pack one of them")
    return first


def _view(
    posed: PosedImage,
    path: Path | None,
    nominal: tuple[int, int],
    size: tuple[int, int],
    background: Float32[np.ndarray, "3"],
) -> View:
    try:
        lens = posed.intrinsics.lens(nominal, size)
        pinhole = Camera(posed.viewmat, lens.K, *size)
        if path is None or not lens.distortion:
            return View(posed.name, pinhole, path, background)
        window = full_window(lens)
        camera = Camera(posed.viewmat, window.K, window.width, window.height)
        return View(posed.name, camera, path, background, window)
    except InvalidViewsError as error:
        raise InvalidViewsError(f"{posed.where}: {error}") from error


def _sizes(posed: PosedImage, photo: FoundPhoto | None, scale: int) -> tuple[tuple[int, int], tuple[int, int]]:
    """Return (width, height) to which the intrinsics belong, and (width, height) of the photograph before reduction."""
    width, height = posed.intrinsics.width, posed.intrinsics.height
    if photo is None:
        if width is None or height is None:
            raise InvalidViewsError(
                f"{posed.where}: it has neither a size (w, h) nor a photograph; add w and h or the photographs"
            )
        return (width, height), (max(1, round(width / scale)), max(1, round(height / scale)))
    header = read_photo_header(photo.path)
    size = header.width, header.height
    nominal = width or size[0] * photo.factor, height or size[1] * photo.factor
    if not _fits(size, nominal):
        if _fits(size[::-1], nominal) and orientation(photo.path) in QUARTER_TURNS:
            raise InvalidViewsError(
                f"{photo.path} has {size[0]}x{size[1]} pixels, which its EXIF orientation turns upright, and its "
                f"camera ({posed.where}) is for {nominal[0]}x{nominal[1]}; orientation is ignored here, so turn the "
                "pixels of all photographs ('mogrify -auto-orient'), or compute the cameras from them as they are"
            )
        raise InvalidViewsError(
            f"{photo.path} has {size[0]}x{size[1]} pixels, but its camera ({posed.where}) is for "
            f"{nominal[0]}x{nominal[1]}, another aspect ratio; name the folder of the cameras' "
            "photographs (--images of kissgs evaluate and render)"
        )
    return nominal, size


def _fits(size: tuple[int, int], nominal: tuple[int, int]) -> bool:
    """Whether a photograph of this (width, height) may be a scaled copy of one of the nominal size."""
    expected = nominal[1] * size[0] / nominal[0]
    return abs(size[1] - expected) <= MAX_ASPECT_ERROR * size[1] + 2


def _reduced(size: tuple[int, int], resolution: int) -> tuple[int, int]:
    factor = max(size) / resolution
    return size if factor <= 1 else (max(1, int(size[0] / factor)), max(1, int(size[1] / factor)))


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


# Packing for a service.


def pack_capture(path: Path, destination: Path, progress: Progress = silent, *, scene: Path | None = None) -> None:
    """Pack what :func:`load_views` uses of a capture for a scene into a zip, from which a service reads the same views:
    its camera files, and the photographs of its views, those that are used reduced without further loss. Equal captures
    make equal files."""
    load_views(path, scene=scene)  # refuses what a service would refuse
    path, scale, images, white, *_ = _place(path)
    if path.name == TRAINED_CAMERAS:
        raise InvalidViewsError(f"the cameras of {path} cannot be sent to a service without a capture; name its folder")
    capture = _read_capture(path)
    names = [posed.photo for posed in capture.images]
    photos = find_photos(names, capture.root, scale=scale, images=images) or ()
    if white not in (None, _is_white(capture, photos)):
        raise InvalidViewsError(
            f"the background that cfg_args names for {path} cannot be sent to a service; compress the scene here"
        )
    packed = {
        _packed_name(posed, photo, renamed=images is not None): (posed, photo)
        for posed, photo in zip(capture.images, photos, strict=False)
    }
    if len(packed) < len({photo.path for photo in photos}):
        raise InvalidViewsError(f"two photographs of {path} have the same name in different folders; rename one")
    if (refused := next((name for name in packed if not is_packable(name)), None)) is not None:
        longest = f"more than {MAX_PACKED_NAME} bytes"
        raise InvalidViewsError(
            f"the name {quoted(refused)} of a photograph is not printable or has {longest}; rename it"
        )
    cameras = dict(capture.files)
    for n, dataparser in enumerate(dataparser_files(_own(path, capture), _run(scene))):
        cameras[f"{n}/{DATAPARSER_TRANSFORMS}" if n else DATAPARSER_TRANSFORMS] = dataparser
    with atomic_file(destination) as file, zipfile.ZipFile(file, "w") as archive:
        for name, camera_file in sorted(cameras.items()):
            archive.writestr(_entry(name), _content(camera_file), zipfile.ZIP_DEFLATED)
        for done, (name, (posed, photo)) in enumerate(sorted(packed.items())):
            progress("pack", done / len(packed))
            archive.writestr(_entry(name), _packed_photo(posed, photo))
    progress("pack", 1.0)


def _packed_name(posed: PosedImage, photo: FoundPhoto, *, renamed: bool) -> str:
    """Return the name under which :func:`find_photos` finds a photograph inside the root of an unpacked capture, in a
    folder of the usual name if ``renamed``. If the camera file has none of the endings that a service unpacks, it gets
    that of the file, or any: content decides."""
    parts = without_parents(posed.photo).parts
    if is_absolute(posed.photo):
        parts = (IMAGES if photo.factor == 1 else f"{IMAGES}_{photo.factor}", *parts[1:])
    elif len(parts) > 1:
        parts = (IMAGES if renamed else photo.folder.name, *parts[1:])  # perhaps that of a scaled copy
    name, suffix = "/".join(parts), photo.path.suffix
    if PurePosixPath(name).suffix.lower() in PHOTOGRAPHS:
        return name
    return name + (suffix if suffix.lower() in PHOTOGRAPHS else ".png")


def _packed_photo(posed: PosedImage, photo: FoundPhoto) -> bytes:
    """Return the file of a photograph, or that of the reduced one. Only opaque ones are reduced, since transparent ones
    say what is behind the scene, and only if the camera file has the size to which the intrinsics belong."""
    header, sized = read_photo_header(photo.path), posed.intrinsics.width and posed.intrinsics.height
    reduced = _reduced((header.width, header.height), DEFAULT_RESOLUTION)
    if header.transparent or not sized or reduced == (header.width, header.height):
        return _content(photo.path)
    file = io.BytesIO()
    pixels = read_photo(photo.path, *reduced, black())
    Image.fromarray(pixels).save(file, "webp", lossless=True, quality=0, method=0)
    return file.getvalue()


def _content(path: Path) -> bytes:
    with open_file(path) as (file, _):
        return file.read()


def _entry(name: str) -> zipfile.ZipInfo:
    return zipfile.ZipInfo(name, date_time=(1980, 1, 1, 0, 0, 0))
