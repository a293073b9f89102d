"""Where the photographs of a capture are: full-size or scaled folders, other extensions, other capitals.

A file of cameras names photographs as they were when it was made. Captures are often passed on with only scaled
copies of them, in folders such as ``images_4`` beside where ``images`` was.
"""

from __future__ import annotations

import os
import re
from collections.abc import Collection, Sequence
from dataclasses import dataclass
from pathlib import Path, PurePosixPath

from kissgs.errors import InvalidViewsError
from kissgs.views._files import quoted
from kissgs.views.pixels import EXTENSIONS

MAX_FACTOR = 64
"""Of scaled folders; a larger number after the underscore, such as a year, is part of the name."""


@dataclass(frozen=True, slots=True)
class FoundPhoto:
    """A photograph's file, and how many times smaller than the original its folder's name says that it is."""

    path: Path
    factor: int


@dataclass(frozen=True, slots=True)
class _Place:
    """Where a photograph is looked for.

    ``names`` are tried in ``folder``, whose files are ``factor`` times smaller than the originals. ``promising`` means
    that the folder is there and for photographs only, rather than being the capture's own.
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
    trains outdoor scenes, else the largest. A file may have another extension, or other capitals, than its name says,
    where that name itself does not exist.

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
        places = [_place(name, root, scale, disk) for name in names]
    else:
        folder = _named_folder(images, root)
        places = [_within(folder, name) for name in names]
    found = [disk.find(place) for place in places]
    missing = [i for i, photo in enumerate(found) if photo is None]
    if len(missing) == len(names) and not any(place.promising for place in places):
        return None
    if missing:
        raise InvalidViewsError(
            f"{len(missing)} of {len(names)} photographs are missing, the first is {quoted(names[missing[0]])}, "
            f"looked for in {places[missing[0]].folder}; add them, or name the folder that has them all (--images)"
        )
    return tuple(photo for photo in found if photo is not None)


def _usual(factors: Collection[int]) -> int:
    return next((factor for factor in (1, 4) if factor in factors), min(factors))


class _Disk:
    """What folders hold, each looked at once."""

    def __init__(self) -> None:
        self._listings: dict[Path, tuple[set[str], dict[str, list[str]]]] = {}
        self._variants: dict[Path, dict[int, Path]] = {}

    def find(self, place: _Place) -> FoundPhoto | None:
        """The photograph of the first of the names that is there."""
        for name in place.names:
            path = PurePosixPath(name)
            file = self._match(place.folder / path.parent, path.name)
            if file is not None:
                return FoundPhoto(place.folder / path.parent / file, place.factor)
        return None

    def variants(self, folder: Path) -> dict[int, Path]:
        """``folder`` and its scaled copies, as far as they are there, by how many times smaller they are."""
        if folder not in self._variants:
            found = {1: folder} if _is_folder(folder) else {}
            for factor in range(2, MAX_FACTOR + 1):
                scaled = folder.parent / f"{folder.name}_{factor}"
                if _is_folder(scaled):
                    found[factor] = scaled
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


def _place(name: str, root: Path, scale: int | None, disk: _Disk) -> _Place:
    """The folder that ``name`` begins with, or its scaled copy."""
    folder, rest = _split(name, root)
    if folder == root or folder.name == "..":  # the name has no folder of its own, so there are no scaled ones
        return _Place(folder, 1, (rest,), promising=False)
    variants = disk.variants(folder)
    if not variants:
        return _Place(folder, 1, (rest,), promising=False)
    factor = _usual(variants) if scale is None else scale
    if factor not in variants:
        wanted = folder.name if factor == 1 else f"{folder.name}_{factor}"
        there = ", ".join(variants[known].name for known in sorted(variants))
        raise InvalidViewsError(f"there is no folder {wanted} in {folder.parent}, only {there}; choose another --scale")
    return _Place(variants[factor], factor, (rest,), promising=True)


def _split(name: str, root: Path) -> tuple[Path, str]:
    """The folder of photographs that ``name`` begins with, and the name within it."""
    path = PurePosixPath(name.replace("\\", "/"))
    if path.is_absolute() or re.match("[A-Za-z]:/", str(path)):
        # On another machine it was elsewhere; then the folder's own name may still be found beside the cameras.
        parent = Path(path.parent)
        return (parent if _is_folder(parent) else root / parent.name), path.name
    parts = list(path.parts)
    ups = next((i for i, part in enumerate(parts) if part != ".."), len(parts))
    folder = root.joinpath(*parts[:ups])
    if len(parts) - ups > 1:
        return folder / parts[ups], "/".join(parts[ups + 1 :])
    return folder, "/".join(parts[ups:])


def _named_folder(images: Path, root: Path) -> Path:
    for folder in (images, root / images):
        if _is_folder(folder):
            return folder
    raise InvalidViewsError(f"there is no folder {images} of photographs, nor {root / images}; check --images")


def _within(folder: Path, name: str) -> _Place:
    parts = [part for part in PurePosixPath(name.replace("\\", "/")).parts if part not in ("..", "/")]
    names = dict.fromkeys(["/".join(parts), "/".join(parts[1:] or parts), parts[-1] if parts else ""])
    suffix = re.search(r"_([0-9]{1,2})$", folder.name)
    factor = int(suffix[1]) if suffix and 2 <= int(suffix[1]) <= MAX_FACTOR else 1
    return _Place(folder, factor, tuple(names), promising=True)


def _is_folder(path: Path) -> bool:
    try:
        return path.is_dir()
    except (OSError, ValueError):  # a name that no file system has
        return False
