"""Formats in which a scene is written, by the ending of a name. Containers are written by ``compress``."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

from kissgs.core.errors import OutputError
from kissgs.core.origin import WORLD, origin_for, relative_to, world_positions
from kissgs.core.progress import Progress, silent
from kissgs.core.splats import Splats, clean
from kissgs.io.container_names import ENDINGS
from kissgs.io.scene_file import BinaryWriter

OutputFormat = Literal["ply", "compressed.ply", "spz", "splat", "glb", "spz.glb"]
OUTPUT_FORMATS: tuple[OutputFormat, ...] = ("ply", "compressed.ply", "spz", "splat", "glb", "spz.glb")
"""Formats that are written; each is the ending of its files without the first dot."""


def output_format(path: Path) -> OutputFormat:
    """Return the format that the ending of a name stands for.

    Raises:
        OutputError: no format that is written has this ending.
    """
    name = path.name.lower()
    found = [kind for kind in OUTPUT_FORMATS if name.endswith(f".{kind}")]
    if found:
        return max(found, key=len)
    if path.suffix.lower() in ENDINGS:
        raise OutputError(f"{path!s:.100} is the name of a container; kissgs compress writes those")
    raise OutputError(
        f"{path!s:.100} has no ending of a format that is written: .{', .'.join(OUTPUT_FORMATS)}; choose one of them"
    )


def write_scene(
    file: BinaryWriter, splats: Splats, kind: OutputFormat, *, raw_axes: bool = False, progress: Progress = silent
) -> tuple[str, ...]:
    """Write a scene in a format, which all but ``ply`` need cleaned; return what the format cannot hold.

    Each loss beyond the steps that the format always has is one phrase. ``raw_axes`` is for ``spz``.

    Raises:
        UnsupportedError: the format cannot hold the scene.
    """
    if kind == "ply":
        from kissgs.io.ply import write_ply

        write_ply(file, splats, progress=progress)
        return ()
    splats = clean(splats)[0]
    notes = _write_cleaned(file, splats, kind, raw_axes, progress)
    if splats.origin != WORLD:
        kept = "records it as a translation" if kind.endswith("glb") else "does not record it"
        rounded = origin_for(world_positions(splats), splats.scales) != WORLD
        reason = ", because float32 would round those of the world" if rounded else ""
        notes = (*notes, f"{relative_to(splats.origin)}{reason}; .{kind} {kept}")
    return notes


def _write_cleaned(
    file: BinaryWriter, splats: Splats, kind: OutputFormat, raw_axes: bool, progress: Progress
) -> tuple[str, ...]:
    if kind == "spz":
        from kissgs.io.spz_writer import write_spz

        return write_spz(file, splats, raw_axes=raw_axes, progress=progress)
    if kind == "compressed.ply":
        from kissgs.io.compressed_ply import write_compressed

        return write_compressed(file, splats, progress=progress)
    if kind == "splat":
        from kissgs.io.splat import write_splat

        return write_splat(file, splats, progress=progress)
    from kissgs.io.gltf_writer import write_glb, write_spz_glb

    return (write_glb if kind == "glb" else write_spz_glb)(file, splats, progress=progress)
