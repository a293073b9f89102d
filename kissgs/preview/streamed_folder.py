"""Folders of streamed scenes, for the page: which of their files it may ask for, and which level fits into one page."""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from kissgs.core.errors import KissgsError
from kissgs.io.packed_files import Source
from kissgs.io.streamed import StreamedFormat
from kissgs.pipeline.scene_formats import STREAMED_FORMATS, recognise, scene_root
from kissgs.sog import streamed as streamed_sog
from kissgs.sog.metadata import read_layout
from kissgs.sog.names import META_NAME
from kissgs.sogxt import streamed as streamed_sogxt

PAGE_GAUSSIANS = 1_000_000
"""Largest number of Gaussians of the level that a page of one file gets, so that phones open it."""


@dataclass(frozen=True)
class StreamedFolder:
    """A streamed scene whose files are read when the page asks for them.

    Attributes:
        name: name of the folder.
        manifest: name of the manifest in it.
        files: all files of the scene by their paths from the folder, the manifest included, and no others.
        missing: files that the scene should have, but that are not in the folder.
        unusable: files that are there, but that are no files, or links that lead out of the folder or nowhere.
    """

    name: str
    manifest: str
    files: dict[str, Path]
    missing: tuple[str, ...]
    unusable: tuple[str, ...]


def is_streamed(source: Path | bytes) -> bool:
    """Whether a scene is a streamed one, in a folder or a zip."""
    return recognise(source) in STREAMED_FORMATS


def is_streamed_folder(source: Path) -> bool:
    """Whether a path is the folder of a streamed scene, or its manifest, and no zip."""
    return scene_root(source).is_dir() and is_streamed(source)


def streamed_folder(source: Path) -> StreamedFolder:
    """Return the files of a streamed scene.

    Files that the scene lacks or that cannot be reached, and links that lead out of the folder, are left out: the page
    names them, and shows the rest.

    Args:
        source: the folder, or its manifest.

    Raises:
        KissgsError: the manifest is damaged, or names files that are not below its folder.
    """
    folder, kind = scene_root(source), _format(source)
    with kind.open(folder) as opened:
        tree = kind.read_manifest(opened)
        names = [kind.manifest]
        for name in (*tree.filenames, *([tree.environment] if tree.environment else [])):
            names += _container_files(opened, name)
    root = folder.resolve()
    inside = {name: path for name in names if (path := _file_inside(root, name)) is not None}
    others = [name for name in names if name not in inside]
    unusable = tuple(name for name in others if os.path.lexists(root / name))
    return StreamedFolder(
        name=os.fsencode(root.name).decode(errors="replace") or "scene",
        manifest=kind.manifest,
        files=inside,
        missing=tuple(name for name in others if name not in unusable),
        unusable=unusable,
    )


def _file_inside(root: Path, name: str) -> Path | None:
    """Return a file of a folder without links; None if it is missing, out of the folder, or out of reach."""
    try:
        path = (root / name).resolve()
        return path if path.is_relative_to(root) and path.is_file() else None
    except (OSError, RuntimeError):  # a closed folder; a link to itself
        return None


def _format(source: Path | bytes) -> StreamedFormat[Any]:
    return streamed_sog.STREAMED if recognise(source) == "streamed-sog" else streamed_sogxt.STREAMED


def _container_files(files: Source, name: str) -> list[str]:
    """Return the files of one container: a folder's metadata and images, or the container itself."""
    parent, _, last = name.rpartition("/")
    if last != META_NAME:
        return [name]
    try:
        layout = read_layout(files, name)
    except KissgsError:
        return [name]
    images = [*layout.files.values(), *([] if layout.rest is None else [layout.rest.centroids, layout.rest.labels])]
    return [name, *(f"{parent}/{image}" if parent else image for image in images)]


def fitting_level(source: Path | bytes, max_gaussians: int | None = None) -> tuple[int, int]:
    """Return the finest level that fits into a page of one file, or else the coarsest, and the number of levels.

    Args:
        source: the folder of a streamed scene, its manifest, or a zip of it.
        max_gaussians: largest number of Gaussians of a level with the environment, if below ``PAGE_GAUSSIANS``.

    Raises:
        KissgsError: the manifest or the environment is missing or damaged.
    """
    kind = _format(source)
    with kind.open(scene_root(source) if isinstance(source, Path) else source) as files:
        tree = kind.read_manifest(files)
        environment = 0 if tree.environment is None else kind.opened(files, tree.environment).count
    most = (PAGE_GAUSSIANS if max_gaussians is None else min(max_gaussians, PAGE_GAUSSIANS)) - environment
    fitting = (level for level in range(tree.levels) if tree.count(level) <= most)
    return next(fitting, tree.levels - 1), tree.levels
