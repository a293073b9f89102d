"""The preview page: its files, and scenes and folders of streamed scenes in the forms that it reads."""

from __future__ import annotations

import base64
import hashlib
import io
import os
import re
import subprocess
import sys
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from kissgs.core.errors import InvalidSceneError, KissgsError, UnsupportedError
from kissgs.core.origin import WORLD
from kissgs.core.progress import Progress, silent
from kissgs.formats import CONTAINERS, FORMATS, ending_of
from kissgs.io.containers import META_NAME, Source, open_source
from kissgs.io.files import reason_of
from kissgs.io.ply import write_ply
from kissgs.io.scene_format import DEFAULT_READ_OPTIONS, ReadOptions
from kissgs.io.streamed import StreamedFormat
from kissgs.pipeline.pipeline import compress
from kissgs.pipeline.scene_files import open_scene, recognise, scene_root
from kissgs.sog import streamed as streamed_sog
from kissgs.sog.metadata import read_layout
from kissgs.sogxt import streamed as streamed_sogxt
from kissgs.sogxt.container import zip_bytes

PAGE_GAUSSIANS = 1_000_000
"""Largest number of Gaussians of the level that a page of one file gets, so that phones open it."""


@dataclass(frozen=True)
class StreamedFolder:
    """A streamed scene whose files are read when the page asks for them."""

    name: str  # of the folder
    manifest: str
    files: dict[str, Path]  # by their paths from the folder, the manifest included
    missing: tuple[str, ...]
    unusable: tuple[str, ...]  # no files, or links that lead out of the folder or nowhere


def is_streamed(source: Path | bytes) -> bool:
    """Whether a scene is a streamed one, in a folder or a zip."""
    return FORMATS[recognise(source)].manifest is not None


def is_streamed_folder(source: Path) -> bool:
    """Whether a path is the folder of a streamed scene, or its manifest, and no zip."""
    return scene_root(source).is_dir() and is_streamed(source)


def streamed_folder(source: Path) -> StreamedFolder:
    """Return the files of a streamed scene; the page names those that cannot be reached, and shows the rest."""
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
    return [name, *(f"{parent}/{image}" if parent else image for image in layout.images)]


def fitting_level(source: Path | bytes, max_gaussians: int | None = None) -> tuple[int, int]:
    """Return the finest level that fits into a page of one file, or else the coarsest, and the number of levels."""
    kind = _format(source)
    with kind.open(scene_root(source) if isinstance(source, Path) else source) as files:
        tree = kind.read_manifest(files)
        environment = 0 if tree.environment is None else kind.opened(files, tree.environment).count
    most = (PAGE_GAUSSIANS if max_gaussians is None else min(max_gaussians, PAGE_GAUSSIANS)) - environment
    fitting = (level for level in range(tree.levels) if tree.count(level) <= most)
    return next(fitting, tree.levels - 1), tree.levels


# Files of the preview page: where they are, which belong to it, and its content security policy.

_PACKAGE = Path(__file__).parents[1]

ROOT = _PACKAGE if (_PACKAGE / "web_decoder").is_dir() else _PACKAGE.parent
"""Folder of ``web_decoder`` and ``scripts``: the package itself in a wheel, the folder around it in a checkout."""

PAGE = "preview.html"

_FILE = re.compile(r"(preview/)?[\w-]+\.(js|css)|vendor/([\w-]+/)+([\w.-]+\.js|LICENSE)", re.ASCII)
_IMPORT_MAP = re.compile(r'<script type="importmap">(.*?)</script>', re.DOTALL)


def page_files() -> dict[str, Path]:
    """Return the files of the page by their paths from it, such as ``vendor/three/build/three.module.min.js``."""
    folder = ROOT / "web_decoder"
    if not (folder / PAGE).is_file():
        raise UnsupportedError(
            f"this installation has no preview page: {folder / PAGE} is missing; install kissgs again"
        )
    if not (folder / "vendor" / "versions.json").is_file():
        raise UnsupportedError(
            "Spark and three.js, which draw the scene, are not installed; add --fetch-viewer to download them once"
        )
    paths = {path.relative_to(folder).as_posix(): path for path in _candidates(folder)}
    return {PAGE: folder / PAGE, **{name: path for name, path in sorted(paths.items()) if _FILE.fullmatch(name)}}


def _candidates(folder: Path) -> list[Path]:
    return [path for part in ("*", "preview/*", "vendor/**/*") for path in folder.glob(part) if path.is_file()]


def fetch_viewer() -> None:
    """Download Spark and three.js if they are missing, at the versions and hashes that this version of kissgs names."""
    done = subprocess.run([sys.executable, ROOT / "scripts" / "vendor"], stdout=sys.stderr, check=False)
    if done.returncode:
        raise UnsupportedError("Spark and three.js could not be downloaded; the reason is above")


def read_page(files: dict[str, Path]) -> str:
    """Return the page as browsers see it, with ``\\n`` at the ends of lines."""
    return files[PAGE].read_text(encoding="utf-8").replace("\r\n", "\n")


def import_map(page: str) -> str:
    """Return the text of the page's import map, JSON."""
    found = _IMPORT_MAP.search(page)
    assert found is not None, "the preview page has an import map"  # noqa: S101
    return found[1]


def hash_source(text: str) -> str:
    """Return the source expression of a content security policy for an inline script or style."""
    return f"'sha256-{base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()}'"


# Scenes in the forms that the preview page reads: containers as they are, all others as ``.ply``.

_MAX_FILE_BYTES = 1 << 30
_FILE_ENDINGS = (".webp", ".json", ".yaml", ".yml")


@dataclass(frozen=True)
class PageScene:
    """A file for the page, which recognises its format by the ending of its name."""

    name: str  # ends in .zip, .sog or .ply
    data: bytes
    converted: bool  # from another format
    notes: tuple[str, ...] = ()  # what reading the scene left out or changed


def page_scene(
    source: Path | bytes, reading: ReadOptions = DEFAULT_READ_OPTIONS, *, threads: int = 0, progress: Progress = silent
) -> PageScene:
    """Return a scene for the page: a SOG-XT or SOG container unchanged, any other as a ``.ply`` of equal values."""
    splats, cleaned, _ = open_scene(source, reading, threads, progress)
    notes = (*splats.notes, *cleaned.notes)
    container = _as_container(source, reading)
    if container is not None:
        return replace(container, notes=notes)
    file = io.BytesIO()
    write_ply(file, replace(splats, origin=WORLD), progress=progress)  # viewers draw a scene better near the origin
    return PageScene(f"{_stem(source)}.ply", file.getvalue(), converted=recognise(source) != "ply", notes=notes)


def page_container(
    source: Path | bytes, reading: ReadOptions = DEFAULT_READ_OPTIONS, *, threads: int = 0, progress: Progress = silent
) -> PageScene:
    """Return a scene as a container: SOG-XT or SOG unchanged, any other compressed by the preset ``balanced``."""
    container = _as_container(source, reading)
    if container is not None:  # whoever gets the page cannot mend a damaged one
        splats, cleaned, _ = open_scene(source, reading, threads, progress)
        return replace(container, notes=(*splats.notes, *cleaned.notes))
    result = compress(source, reading=reading, threads=threads, progress=progress)
    notes = tuple(filter(None, (result.report.note, *result.report.cleaned.notes)))
    return PageScene(f"{_stem(source)}.zip", result.to_zip(), converted=True, notes=notes)


def _as_container(source: Path | bytes, reading: ReadOptions) -> PageScene | None:
    """Return the zip of a container, None for other formats. The files of a folder are packed.

    A container is not shown as it is if its mark of antialiasing does not count.
    """
    found = recognise(source)
    kind = next((kind for kind in CONTAINERS if kind == found), None)
    if kind is None or reading.antialiased is not None:
        return None
    root = scene_root(source) if isinstance(source, Path) else source
    name = f"{_stem(source)}{ending_of(kind)}"
    if isinstance(root, bytes):
        return PageScene(name, root, converted=False)
    if not root.is_dir():
        try:
            return PageScene(name, root.read_bytes(), converted=False)
        except OSError as error:
            raise InvalidSceneError(f"cannot read {root!s:.100}: {reason_of(error)}") from error
    with open_source(root) as files:
        names = sorted(name for name in files.names() if name.endswith(_FILE_ENDINGS))
        return PageScene(name, zip_bytes({name: files.read(name, _MAX_FILE_BYTES) for name in names}), converted=False)


def _stem(source: Path | bytes) -> str:
    """Return the name of a scene without its ending, in characters that UTF-8 has."""
    if isinstance(source, bytes):
        return "scene"
    root = scene_root(source).absolute()
    return os.fsencode(root.name if root.is_dir() else root.stem).decode(errors="replace") or "scene"
