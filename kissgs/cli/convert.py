"""``kissgs convert``: write scenes of any format in a plain one."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Annotated, Any

import typer

from kissgs.cli.console import progress_bar
from kissgs.cli.files import for_each_input, say_notes, show, source, stdout
from kissgs.cli.options import (
    ForceOption,
    JsonOption,
    OriginOption,
    SceneOptions,
    reads_scenes,
)
from kissgs.core.errors import InvalidSceneError, OutputError
from kissgs.formats import ENDINGS, OUTPUT_FORMATS, SCENE_ENDINGS, WRITTEN, alternatives, output_format


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
    from kissgs.core.origin import in_world
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
