"""``decompress``: it needs no encoder, so that a small container is decoded soon after the program starts."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

from kissgs.core.origin import in_world
from kissgs.core.progress import Progress, silent
from kissgs.core.splats import Splats, clean
from kissgs.formats import FORMATS
from kissgs.io.scene_format import ReadOptions
from kissgs.pipeline.scene_files import AnyPath, check_ply, read_scene, recognise, save_ply


def decompress(
    source: AnyPath | bytes | Mapping[str, bytes],
    destination: AnyPath | None = None,
    *,
    max_gaussians: int | None = None,
    level: int = 0,
    raw_axes: bool = False,
    antialiased: bool | None = None,
    overwrite: bool = False,
    threads: int = 0,
    progress: Progress = silent,
) -> Splats:
    """Decode a SOG-XT container, or a scene of another compressed format.

    Args:
        source: path of a zip or a folder, the bytes of a zip, or the files in memory; or any other file that
            :func:`kissgs.load` reads, except a ``.ply``.
        destination: ``.ply`` to write; by default nothing is written.
        max_gaussians: see :class:`kissgs.ReadOptions`, as for ``level`` and ``raw_axes``.
        level: level of detail of a streamed scene; 0 is the finest.
        raw_axes: read ``.spz`` that stores the axes of a ``.ply`` without saying so.
        antialiased: see :func:`kissgs.load`.
        overwrite: replace ``destination`` if it exists.
        threads: number of threads; 0 means one per processor.
        progress: receives events.

    Returns:
        The scene exactly as stored: quaternions are as quantised, so their length is only approximately 1. Only
        formats other than containers can hold values that cannot be drawn, such as NaN: such a scene is cleaned as by
        :func:`kissgs.load`, and ``notes`` says so. Positions are those of the world where float32 can hold them, else
        relative to its ``origin``.

    Raises:
        InvalidContainerError: the container is damaged.
        InvalidSceneError: a file of another format is damaged.
        UnsupportedError: the file has a feature that kissgs does not read.
        OutputError: ``destination`` cannot be written.
    """
    if destination is not None:
        check_ply(Path(destination), overwrite=overwrite)
    scene = source if isinstance(source, bytes | Mapping) else Path(source)
    splats = read_scene(
        scene,
        ReadOptions(max_gaussians=max_gaussians, level=level, raw_axes=raw_axes, antialiased=antialiased),
        threads=threads,
        progress=progress,
        only_containers=True,
    )
    if not FORMATS[recognise(scene)].is_container:
        usable, cleaned = clean(splats)
        if cleaned.notes:
            splats = replace(usable, notes=(*splats.notes, *cleaned.notes))
    splats = in_world(splats)
    if destination is not None:
        save_ply(splats, destination, overwrite=overwrite, progress=progress)
    return splats
