"""Scenes in files: read every format, write those that are no containers.

The module of a format is loaded when a file of that format is read.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from os import PathLike
from pathlib import Path
from typing import Literal

from kissgs.core.errors import InvalidContainerError, OutputError
from kissgs.core.origin import WORLD, centred, in_world, relative_to
from kissgs.core.progress import Progress, silent
from kissgs.core.splats import Cleaned, Splats, clean
from kissgs.io.atomic import atomic_file, reason_of, refuse_existing
from kissgs.pipeline.read_options import DEFAULT_READ_OPTIONS, ReadOptions
from kissgs.pipeline.scene_formats import SceneFormat, recognise, scene_root
from kissgs.pipeline.scene_output import output_format, write_scene

AnyPath = str | PathLike[str]


def load(
    path: AnyPath,
    *,
    max_gaussians: int | None = None,
    level: int = 0,
    raw_axes: bool = False,
    origin: Literal["auto"] | None = None,
    antialiased: bool | None = None,
    threads: int = 0,
    progress: Progress = silent,
) -> Splats:
    """Read and clean a scene of any format: see docs/reference/formats.md.

    Args:
        path: ``.ply``, ``.spz``, ``.splat``, ``.ksplat``, ``.glb`` or ``.gltf``; a SOG-XT or SOG container (zip,
            folder, or its ``meta.json``); a streamed scene (zip, folder, or its ``lod-meta.json`` or ``levels.json``).
        max_gaussians: see :class:`kissgs.ReadOptions`, as for ``level`` and ``raw_axes``.
        level: level of detail of a streamed scene; 0 is the finest.
        raw_axes: read ``.spz`` that stores the axes of a ``.ply`` without saying so.
        origin: see :class:`kissgs.ReadOptions`. By default, positions are those of the world wherever float32 can hold
            them; else they are relative to ``origin`` of the scene.
        antialiased: whether the scene was trained with antialiasing (:class:`kissgs.Splats`); None: as the file says.
        threads: number of threads; 0 means one per processor.
        progress: receives events.

    Raises:
        InvalidSceneError: the file is not a usable scene.
        InvalidContainerError: the container is damaged.
        UnsupportedError: the file is valid, but uses a feature that kissgs does not read.
    """
    reading = ReadOptions(
        max_gaussians=max_gaussians, level=level, raw_axes=raw_axes, origin=origin, antialiased=antialiased
    )
    splats, cleaned = clean(read_scene(Path(path), reading, threads=threads, progress=progress))
    splats = replace(splats, notes=(*splats.notes, *cleaned.notes))
    return splats if origin == "auto" else in_world(splats)


def save(
    splats: Splats, path: AnyPath, *, overwrite: bool = False, raw_axes: bool = False, progress: Progress = silent
) -> tuple[str, ...]:
    """Write a scene atomically, in the format that the ending of ``path`` names: see docs/reference/formats.md.

    ``.ply`` (binary, INRIA layout, at the scene's own SH degree) holds every number bit by bit. For the others,
    ``.compressed.ply``, ``.spz``, ``.splat``, ``.glb`` and ``.spz.glb``, the scene is cleaned. Containers are written
    by :func:`compress`.

    Args:
        splats: the scene; it is not changed.
        path: file to write.
        overwrite: replace the file if it exists.
        raw_axes: write ``.spz`` with the axes of a ``.ply``, as some tools expect them.
        progress: receives events.

    Returns:
        What the format cannot hold beyond its usual precision, one phrase each; nothing for ``.ply``.

    Raises:
        OutputError: the file exists and ``overwrite`` is false, its ending is of no such format, or writing fails.
        UnsupportedError: the format cannot hold the scene, such as ``.glb`` one without Gaussians.
    """
    kind = output_format(Path(path))
    with atomic_file(Path(path), overwrite=overwrite) as file:
        return write_scene(file, splats, kind, raw_axes=raw_axes, progress=progress)


def save_ply(splats: Splats, path: AnyPath, *, overwrite: bool = False, progress: Progress = silent) -> None:
    """Write a scene atomically as an exact ``.ply``, also where its name ends in ``.compressed.ply``.

    Raises:
        OutputError: as for :func:`check_ply`, or writing fails.
    """
    check_ply(Path(path), overwrite=overwrite)
    with atomic_file(Path(path), overwrite=overwrite) as file:
        write_scene(file, splats, "ply", progress=progress)


def check_ply(path: Path, *, overwrite: bool) -> None:
    """Check that a scene can be written to ``path``.

    Raises:
        OutputError: the ending is not ``.ply``, the file exists and ``overwrite`` is false, or there is no such folder.
    """
    if path.suffix.lower() != ".ply":
        raise OutputError(f"{path}: a scene is written as .ply; use compress to write a container")
    refuse_existing(path, overwrite=overwrite)


def open_scene(
    source: Splats | AnyPath | bytes, reading: ReadOptions, threads: int, progress: Progress
) -> tuple[Splats, Cleaned, int]:
    """Read and clean a scene; return it, the defects that were corrected, and the bytes of the source.

    Raises:
        KissgsError: the scene cannot be read.
    """
    if isinstance(source, Splats):
        splats = reading.marked(source)
        splats, cleaned = clean(centred(splats) if reading.origin == "auto" else splats)
        return splats, cleaned, source.nbytes
    progress("read", 0.0)
    scene = source if isinstance(source, bytes) else Path(source)
    splats, cleaned = clean(read_scene(scene, reading, threads=threads, progress=progress))
    return splats, cleaned, len(scene) if isinstance(scene, bytes) else stored_bytes(scene)


def read_scene(
    source: Path | bytes | Mapping[str, bytes],
    reading: ReadOptions = DEFAULT_READ_OPTIONS,
    *,
    threads: int = 0,
    progress: Progress = silent,
    only_containers: bool = False,
) -> Splats:
    """Read a scene without cleaning. With ``only_containers``, a ``.ply`` is refused.

    Raises:
        KissgsError: the scene cannot be read.
    """
    splats = reading.marked(_read(source, reading, threads, progress, only_containers))
    return centred(splats) if reading.origin == "auto" else splats


def _read(
    source: Path | bytes | Mapping[str, bytes],
    reading: ReadOptions,
    threads: int,
    progress: Progress,
    only_containers: bool,
) -> Splats:
    found = recognise(source)
    root = scene_root(source) if isinstance(source, Path) else source
    most = reading.max_compressed
    if found == "streamed-sog":
        from kissgs.sog import streamed

        return streamed.decode(root, level=reading.level, max_gaussians=most, threads=threads, progress=progress)
    if found == "streamed-sogxt":
        from kissgs.sogxt import streamed as streamed_sogxt

        return streamed_sogxt.decode(root, level=reading.level, max_gaussians=most, threads=threads, progress=progress)
    if found == "sog":
        from kissgs.sog.decode import decode as decode_sog

        return decode_sog(root, max_gaussians=most, threads=threads, progress=progress)
    if found == "sogxt" or (only_containers and found == "ply") or isinstance(source, Mapping):
        from kissgs.sogxt.decode import decode as decode_sogxt

        return decode_sogxt(root, max_gaussians=most, threads=threads, progress=progress)
    if found == "spz":
        from kissgs.io.spz import read_spz

        return read_spz(source, max_gaussians=most, raw_axes=reading.raw_axes, progress=progress)
    if found == "gltf":
        from kissgs.io.gltf import read_gltf

        return read_gltf(source, max_gaussians=most, progress=progress)
    return _reader(found)(source, max_gaussians=reading.max_gaussians, progress=progress)


def _reader(found: SceneFormat) -> Callable[..., Splats]:
    """Return the reader of a format without options."""
    if found == "splat":
        from kissgs.io.splat import read_splat

        return read_splat
    if found == "ksplat":
        from kissgs.io.ksplat import read_ksplat

        return read_ksplat
    from kissgs.io.ply import read_ply

    return read_ply


def reading_notes(splats: Splats) -> list[str]:
    """Return what reading a scene left out or changed, and where its positions are if they are not the world's."""
    where = [] if splats.origin == WORLD else [f"{relative_to(splats.origin)}, which containers record"]
    return [*splats.notes, *where]


def stored_bytes(path: Path) -> int:
    """Return the size of a file, or of all files in a folder and below it, in bytes.

    Raises:
        InvalidContainerError: the path cannot be read.
    """
    try:
        root = scene_root(path)
        if not root.is_dir():
            return root.stat().st_size
        return sum(entry.stat().st_size for entry in root.rglob("*") if entry.is_file())
    except OSError as error:
        raise InvalidContainerError(f"cannot read {path}: {reason_of(error)}") from error
