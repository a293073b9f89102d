"""``Capture``: the content of a camera file, and the search for its photographs."""

from __future__ import annotations

import codecs
import contextlib
import io
import math
import os
import re
import unicodedata
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import Literal

import numpy as np
from pydantic import ValidationError

from kissgs.cameras.photographs import NO_DISTORTION, Distortion, Lens
from kissgs.core.array_types import Float64
from kissgs.core.errors import InvalidViewsError
from kissgs.formats import PHOTOGRAPHS
from kissgs.io.files import open_scene_file, reason_of

MAX_JSON_BYTES = 1 << 28  # maximum bytes of a JSON file; ten thousand cameras take about 10 MB


@contextlib.contextmanager
def open_file(path: Path) -> Iterator[tuple[io.BufferedIOBase, int]]:
    """Open a regular file for reading; yield it and its size in bytes."""
    with open_scene_file(path, "", InvalidViewsError) as opened:
        yield opened.file, opened.size


def read_json(path: Path) -> bytes:
    """Return the bytes of a JSON file without a byte order mark, at most :data:`MAX_JSON_BYTES`."""
    with open_file(path) as (file, size):
        if size > MAX_JSON_BYTES:
            most = f"at most {MAX_JSON_BYTES:,} are read"
            raise InvalidViewsError(f"{path} has {size:,} bytes; {most}; is it a camera file?")
        return file.read().removeprefix(codecs.BOM_UTF8)


def invalid(where: str, error: ValidationError) -> InvalidViewsError:
    """Return the first problem of a document as an error of one sentence."""
    problem = error.errors(include_url=False, include_context=False, include_input=False)[0]
    field = "".join(f"[{step}]" if isinstance(step, int) else f".{step}" for step in problem["loc"]).lstrip(".")
    message = f"{problem['msg'][0].lower()}{problem['msg'][1:]}"
    return InvalidViewsError(f"{where}, {field}: {message}" if field else f"{where}: {message}")


def quoted(text: str) -> str:
    """Return ``text`` in quotes, with unprintable characters escaped, of at most 80 characters."""
    return repr(text if len(text) <= 80 else text[:79] + "…")


def composed(name: str) -> str:
    """Return a name in the composed Unicode form (NFC), to compare it: archives of macOS have decomposed names."""
    return unicodedata.normalize("NFC", name)


MAX_SIDE = 1_000_000  # maximum side of a photograph, pixels; the largest stitched panoramas have a few hundred thousand


@dataclass(frozen=True, slots=True)
class Intrinsics:
    """Intrinsics from a camera file; lengths in pixels of a photograph of ``width`` x ``height``, angles in radians.
    Defaults: the size of the photograph; the angle of view or the other focal length; the centre of the image."""

    width: int | None = None
    height: int | None = None
    fx: float | None = None
    fy: float | None = None
    cx: float | None = None
    cy: float | None = None
    angle_x: float | None = None
    angle_y: float | None = None
    distortion: Distortion = NO_DISTORTION

    def lens(self, nominal: tuple[int, int], size: tuple[int, int]) -> Lens:
        """Return the lens for a photograph of another size, with all defaults filled in."""
        across, down = size[0] / nominal[0], size[1] / nominal[1]
        fx, fy = _focal(self.fx, self.angle_x, nominal[0]), _focal(self.fy, self.angle_y, nominal[1])
        fx = fy if fx is None else fx
        fy = fx if fy is None else fy
        if fx is None or fy is None:
            raise InvalidViewsError("the camera has no focal length; give fl_x or camera_angle_x")
        cx = nominal[0] / 2 if self.cx is None else self.cx
        cy = nominal[1] / 2 if self.cy is None else self.cy
        return Lens(fx * across, fy * down, cx * across, cy * down, size[0], size[1], self.distortion)


@dataclass(frozen=True, slots=True, eq=False)
class PosedImage:
    """A photograph with its pose and intrinsics."""

    name: str  # unique in most captures
    photo: str  # according to the camera file; absolute, or relative to the capture's root
    where: str  # camera file and entry, for error messages
    viewmat: Float64[np.ndarray, "4 4"]  # rigid transform from world to camera, with the axes of Camera
    intrinsics: Intrinsics
    split: Literal["train", "test"] | None = None  # None if the capture does not define it


@dataclass(frozen=True, slots=True, eq=False)
class Capture:
    """All posed images of a capture, in the order of its camera file."""

    images: tuple[PosedImage, ...]  # one or more
    root: Path  # folder that paths of photographs are relative to
    source: str  # description of the files that were read, for messages
    files: dict[str, Path]  # these files by their names relative to ``root``, under which any capture may have them
    white: bool = False  # whether transparent pixels are composited over white
    applied: Float64[np.ndarray, "4 4"] | None = None  # rotation and translation from a former model to the poses
    points: Path | None = None  # points of its COLMAP model


def _focal(length: float | None, angle: float | None, side: int) -> float | None:
    if length is not None or angle is None:
        return length
    return 0.5 * side / math.tan(0.5 * angle)


# Search for the photographs of a capture in full-size and scaled folders, whatever their extension and case.
#
# A camera file names photographs as they were when it was made. Captures are often distributed with scaled copies only,
# in folders such as ``images_4`` next to the former ``images``, or only with ``input``, from which INRIA's
# ``convert.py`` makes ``images``.

MAX_FACTOR = 64  # maximum scale of a folder; a larger number after the underscore, such as a year, is part of the name
IMAGES, INPUT = "images", "input"  # usual folder of photographs, and that of originals, which replaces it if missing
MAX_LISTED_FOLDERS = 4  # maximum number of folders named in a message


@dataclass(frozen=True, slots=True)
class FoundPhoto:
    """File of a photograph."""

    path: Path
    factor: int  # original size divided by this photograph's size, according to the folder's name
    folder: Path  # folder of photographs that contains the file, perhaps in a subfolder


@dataclass(frozen=True, slots=True)
class _SearchFolder:
    folder: Path
    factor: int  # original size divided by the size of its photographs
    names: tuple[str, ...]  # names to try, in order, relative to the folder
    has_photos: bool  # whether the folder exists and is certainly for photographs, unlike the capture's own folder


def find_photos(
    names: Sequence[str], root: Path, *, scale: int | None = None, images: Path | None = None, inside: bool = False
) -> tuple[FoundPhoto, ...] | None:
    """Find the file of each photograph, in order; None if there is no folder of photographs. The default is the
    full-size folder, else that of scale 4, at which the protocol of 3DGS trains outdoor scenes, else the largest;
    ``input`` if there is no ``images`` of any scale. If no file has the exact name, one with another Unicode form,
    extension or case is accepted; a folder may have another Unicode form, too. An absolute path that does not exist is
    searched for in the capture's folder. With ``inside``, no file outside ``root`` is looked at."""
    if images is not None and scale is not None:
        raise InvalidViewsError("--images and --scale exclude each other; give only one of them")
    listing = _FolderListing()
    if images is None:
        searched = [
            [_search_folder(folder, tried, root, scale, listing) for folder, tried in _candidates(name, root, inside)]
            for name in names
        ]
    else:
        named = (listing.spelled(images), listing.spelled(root / images))
        folder = next((folder for folder in named if _is_folder(folder)), None)
        if folder is None:
            raise InvalidViewsError(f"there is neither a folder {images} nor {root / images}; check --images")
        searched = [[_within(folder, name)] for name in names]
    found = [listing.find_first(folders) for folders in searched]
    missing = [i for i, photo in enumerate(found) if photo is None]
    if len(missing) == len(names) and not any(entry.has_photos for folders in searched for entry in folders):
        return None
    if missing:
        folders = searched[missing[0]]
        folder = next((entry.folder for entry in folders if entry.has_photos), folders[0].folder)
        elsewhere = ", or name the folder that has all of them (--images of kissgs evaluate and render)"
        raise InvalidViewsError(
            f"{len(missing)} of {len(names)} photographs {'is' if len(missing) == 1 else 'are'} missing; the first is "
            f"{quoted(names[missing[0]])}, searched in {folder}; add what is missing{'' if inside else elsewhere}"
        )
    return tuple(photo for photo in found if photo is not None)


def searched_folders(names: Sequence[str], root: Path) -> str:
    """Describe the folders in which :func:`find_photos` searches for these names, without scaled ones."""
    folders = dict.fromkeys(folder for name in names for folder, _ in _candidates(name, root, inside=False))
    searched = []
    for folder in folders:
        if folder != root:
            searched.append(quoted(str(folder.relative_to(root) if folder.is_relative_to(root) else folder)))
        if folder == root / IMAGES:
            searched.append(quoted(INPUT))
    listed = ", ".join(searched[:MAX_LISTED_FOLDERS]) + (", …" if len(searched) > MAX_LISTED_FOLDERS else "")
    return f"{root} for {listed}" if searched else str(root)


def is_absolute(name: str) -> bool:
    """Whether a photograph's name is an absolute path, of POSIX or of Windows."""
    return re.match(r"[A-Za-z]:[/\\]|[/\\]", name) is not None


def without_parents(name: str) -> PurePosixPath:
    """Return a path without its parts "..", with forward slashes."""
    parts = [part for part in PurePosixPath(name.replace("\\", "/")).parts if part != ".."]
    return PurePosixPath(*parts)


class _FolderListing:
    """Files of folders; each folder is read once."""

    def __init__(self) -> None:
        self._listings: dict[Path, tuple[dict[str, str], dict[str, list[str]]]] = {}
        self._variants: dict[Path, dict[int, Path]] = {}
        self._folders: dict[Path, Path] = {}

    def find_first(self, folders: Iterable[_SearchFolder]) -> FoundPhoto | None:
        """Return the first photograph found, by folder and then by name; None if there is none."""
        for entry in folders:
            for name in entry.names:
                path = PurePosixPath(name)
                folder = self.spelled(entry.folder / path.parent)
                file = self._match(folder, path.name)
                if file is not None:
                    return FoundPhoto(folder / file, entry.factor, entry.folder)
        return None

    def spelled(self, folder: Path) -> Path:
        """Return the existing folder of this path, perhaps with names in another Unicode form; else the path itself."""
        if str(folder).isascii() or folder.parent == folder or _is_folder(folder):
            return folder
        if folder not in self._folders:
            parent, wanted = self.spelled(folder.parent), composed(folder.name)
            try:
                found = sorted(path for path in parent.iterdir() if composed(path.name) == wanted and path.is_dir())
            except (OSError, ValueError):  # there is none, or it cannot be read
                found = []
            self._folders[folder] = found[0] if found else folder
        return self._folders[folder]

    def variants(self, folder: Path) -> dict[int, Path]:
        """Return the existing ones of ``folder`` and its scaled copies, by scale. If there is no ``images`` of any
        scale, ``input`` takes its place with scale 1."""
        if folder not in self._variants:
            whole = self.spelled(folder)
            found = {1: whole} if _is_folder(whole) else {}
            for factor in range(2, MAX_FACTOR + 1):
                scaled = self.spelled(folder.parent / f"{folder.name}_{factor}")
                if _is_folder(scaled):
                    found[factor] = scaled
            if not found and folder.name == IMAGES and _is_folder(folder.parent / INPUT):
                found[1] = folder.parent / INPUT
            self._variants[folder] = found
        return self._variants[folder]

    def _match(self, folder: Path, name: str) -> str | None:
        """Return the file of ``folder`` with this name, else the most similar one with its stem, else None."""
        if folder not in self._listings:
            self._listings[folder] = _list(folder)
        files, stems = self._listings[folder]
        name = name if name in files else composed(name)
        if name in files:
            return files[name]

        def dissimilarity(file: str) -> tuple[bool, bool, str]:
            return _stem(composed(file)) != _stem(name), composed(file).lower() != name.lower(), file

        return min(stems.get(_stem(name).lower(), ()), key=dissimilarity, default=None)


def _list(folder: Path) -> tuple[dict[str, str], dict[str, list[str]]]:
    """Return the files of ``folder`` by exact and composed name, and its image files by composed stem in lower case."""
    try:
        with os.scandir(folder) as entries:
            names = sorted(entry.name for entry in entries if entry.is_file())
    except (FileNotFoundError, NotADirectoryError, ValueError):  # ValueError: a name with a NUL character
        names = []
    except OSError as error:
        raise InvalidViewsError(f"cannot read {folder}: {reason_of(error)}") from error
    stems: dict[str, list[str]] = {}
    for file in names:
        if Path(file).suffix.lower() in PHOTOGRAPHS:
            stems.setdefault(_stem(composed(file)).lower(), []).append(file)
    return {**{composed(file): file for file in names}, **{file: file for file in names}}, stems


def _stem(name: str) -> str:
    # A name without extension may have a dot, as in frame.0001, so only image extensions count.
    path = PurePosixPath(name)
    return path.stem if path.suffix.lower() in PHOTOGRAPHS else path.name


def _search_folder(
    folder: Path, names: tuple[str, ...], root: Path, scale: int | None, listing: _FolderListing
) -> _SearchFolder:
    """Return ``folder`` or its scaled copy, as a folder to search."""
    if folder == root or folder.name == "..":  # the names have no folder of their own, so there are no scaled ones
        return _SearchFolder(folder, 1, names, has_photos=False)
    variants = listing.variants(folder)
    if not variants:
        return _SearchFolder(folder, 1, names, has_photos=False)
    factor = next((usual for usual in (1, 4) if usual in variants), min(variants)) if scale is None else scale
    if factor not in variants:
        wanted = folder.name if factor == 1 else f"{folder.name}_{factor}"
        existing = ", ".join(variants[known].name for known in sorted(variants))
        place = f"in {folder.parent}, only {existing}"
        raise InvalidViewsError(f"there is no folder {wanted} {place}; choose another --scale")
    # A folder named input may hold something else than photographs, unless the camera file names it.
    has_photos = folder.name == INPUT or variants[factor].name != INPUT
    return _SearchFolder(variants[factor], factor, names, has_photos)


def _candidates(name: str, root: Path, inside: bool) -> list[tuple[Path, tuple[str, ...]]]:
    """Return the folders of photographs that ``name`` may refer to, in order, each with the names to try in it."""
    path = without_parents(name) if inside else PurePosixPath(name.replace("\\", "/"))
    if is_absolute(name):  # the capture may have been moved
        names = (path.name,)
        moved = [(root / path.parent.name, names), (root / IMAGES, _suffixes(path.parts[1:]))]
        return moved if inside else [(Path(path.parent), names), *moved]
    parts = path.parts
    ups = next((i for i, part in enumerate(parts) if part != ".."), len(parts))
    folder = root.joinpath(*parts[:ups])
    if len(parts) - ups > 1:
        return [(folder / parts[ups], ("/".join(parts[ups + 1 :]),))]
    return [(folder, ("/".join(parts[ups:]),))]


def _suffixes(parts: Sequence[str]) -> tuple[str, ...]:
    """Return all suffixes of a path, the longest first."""
    return tuple("/".join(parts[i:]) for i in range(len(parts)))


def _within(folder: Path, name: str) -> _SearchFolder:
    parts = [part for part in PurePosixPath(name.replace("\\", "/")).parts if part not in ("..", "/", "//")]
    suffix = re.search(r"_([0-9]{1,2})$", folder.name)
    factor = int(suffix[1]) if suffix and 2 <= int(suffix[1]) <= MAX_FACTOR else 1
    return _SearchFolder(folder, factor, _suffixes(parts) or ("",), has_photos=True)


def _is_folder(path: Path) -> bool:
    try:
        return path.is_dir()
    except (OSError, ValueError):  # too long, or invalid in any file system
        return False
