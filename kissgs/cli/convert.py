"""``kissgs info``, ``kissgs decompress`` and ``kissgs convert``: describe, decode and rewrite scenes."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Annotated, Any

import typer

from kissgs.cli.files import for_each_input, progress_bar, say_notes, show, source, stdout
from kissgs.cli.options import (
    FilesArgument,
    ForceOption,
    JsonOption,
    OriginOption,
    SceneOptions,
    ScenesArgument,
    reads_scenes,
)
from kissgs.core.errors import InvalidContainerError, InvalidSceneError, OutputError
from kissgs.formats import ENDINGS, OUTPUT_FORMATS, SCENE_ENDINGS, WRITTEN, alternatives, output_format

# ``kissgs info``: describe the contents of scene files.


@reads_scenes
def info(
    files: FilesArgument,
    as_json: JsonOption = False,
    *,
    common: SceneOptions,
) -> None:
    """Describe scenes of any format and containers: Gaussians, SH degree, bytes per file, value ranges."""
    from kissgs.cli.tables import info_table
    from kissgs.pipeline.scene_files import describe

    def work(file: str, target: Path) -> dict[str, Any]:
        found = describe(Path(file), common.reading())
        if not as_json:
            show(info_table(found))
        return found.as_dict()

    for_each_input(files, Path("-"), "", as_json, work, writes=False)


# ``kissgs decompress``: decode containers and scenes of other formats into ``.ply`` files.


@reads_scenes
def decompress(
    containers: ScenesArgument,
    output: Annotated[
        str | None,
        typer.Option(
            "--output",
            "-o",
            metavar="PATH",
            help="Output NAME.ply, a folder, or '-' for standard output. Default: next to the container.",
        ),
    ] = None,
    force: ForceOption = False,
    as_json: JsonOption = False,
    *,
    common: SceneOptions,
) -> None:
    """Decode containers and scenes of other formats into .ply files."""
    from kissgs.pipeline.scene_files import decompress as run

    quiet = common.quiet or as_json

    def work(container: str, target: Path) -> dict[str, Any]:
        piped = str(target) == "-"
        with progress_bar(quiet) as progress:
            splats = run(
                source(container),
                None if piped else target,
                max_gaussians=common.max_gaussians,
                level=common.level or 0,
                raw_axes=common.raw_axes,
                antialiased=common.antialiased,
                overwrite=force,
                threads=common.threads,
                progress=progress,
            )
        say_notes(str(target), splats.notes, quiet)
        if piped:
            from kissgs.io.ply import write_ply

            with stdout():
                write_ply(sys.stdout.buffer, splats)
            return {}
        if not quiet:
            from kissgs.cli.tables import gaussians

            show(f"{target}  {gaussians(len(splats))}, SH degree {splats.sh_degree}")
        size = target.stat().st_size
        return {"count": len(splats), "sh_degree": splats.sh_degree, "bytes": size, "notes": list(splats.notes)}

    for_each_input(containers, output, ".ply", as_json, work, unreadable=InvalidContainerError)


# ``kissgs convert``: write scenes of any format in a plain one.


@reads_scenes
def convert(
    files: Annotated[
        list[str],
        typer.Argument(
            metavar="IN… OUT",
            help=f"Scenes ('-' reads standard input), then the output: NAME{alternatives(WRITTEN)}; with --to also a "
            "folder, or '-' for standard output.",
        ),
    ],
    to: Annotated[
        str | None,
        typer.Option("--to", help=f"Format where OUT has no ending: {alternatives(OUTPUT_FORMATS)}."),
    ] = None,
    origin: OriginOption = None,
    force: ForceOption = False,
    as_json: JsonOption = False,
    *,
    common: SceneOptions,
) -> None:
    """Convert scenes into other formats; the ending of OUT decides."""
    from kissgs.core.positions import in_world
    from kissgs.core.splats import clean
    from kissgs.io.files import atomic_file, refuse_existing
    from kissgs.pipeline.scene_files import read_scene, write_scene

    *inputs, output = files
    if not inputs:
        raise OutputError("convert needs an input and an output: kissgs convert IN OUT")
    kind = _output_format(output, to)
    reading, quiet = common.reading(origin), common.quiet or as_json

    def work(scene: str, target: Path) -> dict[str, Any]:
        piped = str(target) == "-"
        if not piped:
            refuse_existing(target, overwrite=force)
        with progress_bar(quiet) as progress:
            splats, cleaned = clean(read_scene(source(scene), reading, threads=common.threads, progress=progress))
            splats = splats if origin else in_world(splats)
            with stdout() if piped else atomic_file(target, overwrite=force) as file:
                stream = sys.stdout.buffer if file is None else file
                losses = write_scene(stream, splats, kind, raw_axes=common.raw_axes, progress=progress)
        notes = [*splats.notes, *cleaned.notes, *losses]
        say_notes(str(target), notes, quiet)
        if piped:
            return {}
        if not quiet:
            show(f"{target}  {len(splats):,} Gaussians, {target.stat().st_size:,} bytes")
        degree = 0 if kind == "splat" else splats.sh_degree
        size = target.stat().st_size
        return {"format": kind, "count": len(splats), "sh_degree": degree, "bytes": size, "notes": notes}

    for_each_input(inputs, output, f".{kind}", as_json, work, unreadable=InvalidSceneError)


def _output_format(output: str, to: str | None) -> str:
    """Return the format of the outputs: ``--to``, or what the ending of the output stands for."""
    if to is None:
        if output == "-":
            raise OutputError(f"standard output has no ending; give --to: {', '.join(OUTPUT_FORMATS)}")
        return output_format(Path(output))
    wanted = next((kind for kind in OUTPUT_FORMATS if kind == to.lower().removeprefix(".")), None)
    if wanted is None:
        raise OutputError(f"--to {to[:40]} is no format that is written; choose {', '.join(OUTPUT_FORMATS)}")
    if Path(output).suffix.lower() in (*ENDINGS, *SCENE_ENDINGS):
        found = output_format(Path(output))
        if found != wanted:
            raise OutputError(f"{output[:100]} has the ending of {found}, but --to asks for {wanted}; choose one")
    return wanted
