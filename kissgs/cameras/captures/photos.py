"""Where the photographs of a capture are: full-size or scaled folders, other extensions, other capitals.

A file of cameras names photographs as they were when it was made. Captures are often passed on with only scaled
copies of them, in folders such as ``images_4`` beside where ``images`` was; or with ``input`` alone, from which INRIA's
``convert.py`` makes ``images``.
"""

from __future__ import annotations

import os
import re
from collections.abc import Collection, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path, PurePosixPath

from kissgs.cameras.captures.files import quoted
from kissgs.cameras.pixels import EXTENSIONS
from kissgs.core.errors import InvalidViewsError

MAX_FACTOR = 64
"""Of scaled folders; a larger number after the underscore, such as a year, is part of the name."""

IMAGES, INPUT = "images", "input"
"""The usual folder of photographs, and that of the originals where it is missing."""

MOST_FOLDERS = 4
"""To list for people."""


@dataclass(frozen=True, slots=True)
class FoundPhoto:
    """A photograph.

    Attributes:
        path: of its file.
        factor: how many times smaller than the original it is, as the folder's name says.
        folder: of the photographs, in which or below which it is.
    """

    path: Path
    factor: int
    folder: Path


@dataclass(frozen=True, slots=True)
class _Place:
    """Where a photograph is looked for.

    ``names`` are tried in ``folder``, whose files are ``factor`` times smaller than the originals. ``promising`` means
    that the folder is there and surely for photographs, rather than being the capture's own.
    """

    folder: Path
    factor: int
    names: tuple[str, ...]
    promising: bool


def find_photos(
    names: Sequence[str], root: Path, *, scale: int | None = None, images: Path | None = None
) -> tuple[FoundPhoto, ...] | None:
    """Find all photographs, or learn that the capture comes without.

    Without ``scale`` the full-size folder is taken if there is one, else that of scale 4, at which the protocol of 3DGS
    trains outdoor scenes, else the largest; ``input`` if there is no ``images`` of any scale. A file may have another
    extension, or other capitals, than its name says, where that name itself does not exist. An absolute name that leads
    nowhere here is looked up in the capture's folder: first in a folder that is called as the file's own was, then in
    ``images``.

    Args:
        names: of photographs with forward slashes, relative to ``root`` or absolute; an extension may lack.
        root: the capture's folder.
        scale: take the folder whose name ends with this, such as ``images_4``; 1 is the full-size one.
        images: take this folder instead of those that ``names`` begin with; its names are looked up with and without
            their own folders. Relative to the working directory, or else to ``root``.

    Returns:
        One for each name, in order; None if there is no folder of photographs at all.

    Raises:
        InvalidViewsError: the folder that was asked for does not exist, or some photographs are missing.
    """
    if images is not None and scale is not None:
        raise InvalidViewsError("a folder of photographs and a scale exclude each other; give --images or --scale")
    disk = _Disk()
    if images is None:
        places = [_places(name, root, scale, disk) for name in names]
    else:
        folder = _named_folder(images, root)
        places = [[_within(folder, name)] for name in names]
    found = [disk.find_first(tried) for tried in places]
    missing = [i for i, photo in enumerate(found) if photo is None]
    if len(missing) == len(names) and not any(place.promising for tried in places for place in tried):
        return None
    if missing:
        tried = places[missing[0]]
        folder = next((place.folder for place in tried if place.promising), tried[0].folder)
        raise InvalidViewsError(
            f"{len(missing)} of {len(names)} photographs are missing, the first is {quoted(names[missing[0]])}, "
            f"looked for in {folder}; add them, or name the folder that has them all (--images)"
        )
    return tuple(photo for photo in found if photo is not None)


def where_looked(names: Sequence[str], root: Path) -> str:
    """For people: the folders in which :func:`find_photos` looks for these names. Of scaled ones it is silent."""
    folders = dict.fromkeys(folder for name in names for folder, _ in _candidates(name, root))
    sought = []
    for folder in folders:
        if folder != root:
            sought.append(quoted(str(folder.relative_to(root) if folder.is_relative_to(root) else folder)))
        if folder == root / IMAGES:
            sought.append(quoted(INPUT))
    listed = ", ".join(sought[:MOST_FOLDERS]) + (", …" if len(sought) > MOST_FOLDERS else "")
    return f"{root} for {listed}" if sought else str(root)


def is_absolute(name: str) -> bool:
    """Whether a photograph's name is an absolute path, of this machine or of another."""
    return re.match(r"[A-Za-z]:[/\\]|[/\\]", name) is not None


def _usual(factors: Collection[int]) -> int:
    return next((factor for factor in (1, 4) if factor in factors), min(factors))


class _Disk:
    """What folders hold, each looked at once."""

    def __init__(self) -> None:
        self._listings: dict[Path, tuple[set[str], dict[str, list[str]]]] = {}
        self._variants: dict[Path, dict[int, Path]] = {}

    def find_first(self, places: Iterable[_Place]) -> FoundPhoto | None:
        """The photograph of the first of the places, and there of the first of the names, that is there."""
        for place in places:
            for name in place.names:
                path = PurePosixPath(name)
                file = self._match(place.folder / path.parent, path.name)
                if file is not None:
                    return FoundPhoto(place.folder / path.parent / file, place.factor, place.folder)
        return None

    def variants(self, folder: Path) -> dict[int, Path]:
        """``folder`` and its scaled copies, as far as they are there, by how many times smaller they are.

        In place of ``images``, of which there is none, ``input``.
        """
        if folder not in self._variants:
            found = {1: folder} if _is_folder(folder) else {}
            for factor in range(2, MAX_FACTOR + 1):
                scaled = folder.parent / f"{folder.name}_{factor}"
                if _is_folder(scaled):
                    found[factor] = scaled
            if not found and folder.name == IMAGES and _is_folder(folder.parent / INPUT):
                found[1] = folder.parent / INPUT
            self._variants[folder] = found
        return self._variants[folder]

    def _match(self, folder: Path, name: str) -> str | None:
        """The file in ``folder`` that ``name`` means: itself, or one of the same stem."""
        if folder not in self._listings:
            self._listings[folder] = _list(folder)
        files, stems = self._listings[folder]
        if name in files:
            return name

        def unlikeness(file: str) -> tuple[bool, bool, str]:
            return _stem(file) != _stem(name), file.lower() != name.lower(), file

        return min(stems.get(_stem(name).lower(), ()), key=unlikeness, default=None)


def _list(folder: Path) -> tuple[set[str], dict[str, list[str]]]:
    """All files of ``folder``; and those that may be photographs by stem in lower case."""
    try:
        with os.scandir(folder) as entries:
            files = {entry.name for entry in entries if entry.is_file()}
    except (FileNotFoundError, NotADirectoryError, ValueError):  # ValueError: a name with a NUL character
        files = set()
    except OSError as error:
        raise InvalidViewsError(f"cannot read {folder}: {(error.strerror or str(error)).lower()}") from error
    stems: dict[str, list[str]] = {}
    for file in files:
        if Path(file).suffix.lower() in EXTENSIONS:
            stems.setdefault(_stem(file).lower(), []).append(file)
    return files, stems


def _stem(name: str) -> str:
    # Names without extension may have a dot, as in frame.0001: only an image's extension is one.
    path = PurePosixPath(name)
    return path.stem if path.suffix.lower() in EXTENSIONS else path.name


def _places(name: str, root: Path, scale: int | None, disk: _Disk) -> list[_Place]:
    """Where to look for ``name``, in order; one place at least."""
    return [_place(folder, names, root, scale, disk) for folder, names in _candidates(name, root)]


def _place(folder: Path, names: tuple[str, ...], root: Path, scale: int | None, disk: _Disk) -> _Place:
    """In ``folder``, or its scaled copy."""
    if folder == root or folder.name == "..":  # the names have no folder of their own, so there are no scaled ones
        return _Place(folder, 1, names, promising=False)
    variants = disk.variants(folder)
    if not variants:
        return _Place(folder, 1, names, promising=False)
    factor = _usual(variants) if scale is None else scale
    if factor not in variants:
        wanted = folder.name if factor == 1 else f"{folder.name}_{factor}"
        there = ", ".join(variants[known].name for known in sorted(variants))
        raise InvalidViewsError(f"there is no folder {wanted} in {folder.parent}, only {there}; choose another --scale")
    # What is called input may be anything.
    return _Place(variants[factor], factor, names, promising=folder.name == INPUT or variants[factor].name != INPUT)


def _candidates(name: str, root: Path) -> list[tuple[Path, tuple[str, ...]]]:
    """The folders of photographs that ``name`` may mean, in order, with its names within each."""
    path = PurePosixPath(name.replace("\\", "/"))
    if is_absolute(name):  # on another machine it was elsewhere
        names = (path.name,)
        return [(Path(path.parent), names), (root / path.parent.name, names), (root / IMAGES, _endings(path.parts[1:]))]
    parts = path.parts
    ups = next((i for i, part in enumerate(parts) if part != ".."), len(parts))
    folder = root.joinpath(*parts[:ups])
    if len(parts) - ups > 1:
        return [(folder / parts[ups], ("/".join(parts[ups + 1 :]),))]
    return [(folder, ("/".join(parts[ups:]),))]


def _endings(parts: Sequence[str]) -> tuple[str, ...]:
    """Of a path, the longest first."""
    return tuple("/".join(parts[i:]) for i in range(len(parts)))


def _named_folder(images: Path, root: Path) -> Path:
    for folder in (images, root / images):
        if _is_folder(folder):
            return folder
    raise InvalidViewsError(f"there is no folder {images} of photographs, nor {root / images}; check --images")


def _within(folder: Path, name: str) -> _Place:
    parts = [part for part in PurePosixPath(name.replace("\\", "/")).parts if part not in ("..", "/", "//")]
    suffix = re.search(r"_([0-9]{1,2})$", folder.name)
    factor = int(suffix[1]) if suffix and 2 <= int(suffix[1]) <= MAX_FACTOR else 1
    return _Place(folder, factor, _endings(parts) or ("",), promising=True)


def _is_folder(path: Path) -> bool:
    try:
        return path.is_dir()
    except (OSError, ValueError):  # a name that no file system has
        return False
