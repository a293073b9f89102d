"""``kissgs convert``: write scenes of any format in a plain one."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Annotated, Any

import typer

from kissgs.cli.console import progress_bar
from kissgs.cli.files import for_each_input, say_notes, show, source, stdout
from kissgs.cli.options import (
    AntialiasedOption,
    ForceOption,
    JsonOption,
    LevelOption,
    MaxGaussiansOption,
    OriginOption,
    QuietOption,
    RawAxesOption,
    ThreadsOption,
    reading_options,
)
from kissgs.core.errors import InvalidSceneError, OutputError
from kissgs.formats import ENDINGS, OUTPUT_FORMATS, SCENE_ENDINGS, WRITTEN, alternatives, output_format


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
    max_gaussians: MaxGaussiansOption = None,
    level: LevelOption = 0,
    raw_axes: RawAxesOption = False,
    origin: OriginOption = None,
    antialiased: AntialiasedOption = None,
    threads: ThreadsOption = 0,
    force: ForceOption = False,
    as_json: JsonOption = False,
    quiet: QuietOption = False,
) -> None:
    """Convert scenes into other formats; the ending of OUT decides."""
    from kissgs.core.origin import in_world
    from kissgs.core.splats import clean
    from kissgs.io.files import atomic_file, refuse_existing
    from kissgs.pipeline.scene_files import read_scene, write_scene

    *inputs, output = files
    if not inputs:
        raise OutputError("convert needs an input and an output: kissgs convert IN OUT")
    kind = _output_format(output, to)
    reading = reading_options(max_gaussians, level, raw_axes, origin, antialiased)

    def work(scene: str, target: Path) -> dict[str, Any]:
        piped = str(target) == "-"
        if not piped:
            refuse_existing(target, overwrite=force)
        with progress_bar(quiet or as_json) as progress:
            splats, cleaned = clean(read_scene(source(scene), reading, threads=threads, progress=progress))
            splats = splats if origin else in_world(splats)
            with stdout() if piped else atomic_file(target, overwrite=force) as file:
                stream = sys.stdout.buffer if file is None else file
                losses = write_scene(stream, splats, kind, raw_axes=raw_axes, progress=progress)
        notes = [*splats.notes, *cleaned.notes, *losses]
        say_notes(str(target), notes, quiet or as_json)
        if piped:
            return {}
        if not (quiet or as_json):
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
