"""``kissgs decompress``: decode containers and scenes of other formats into ``.ply`` files."""

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
    QuietOption,
    RawAxesOption,
    ScenesArgument,
    ThreadsOption,
)
from kissgs.core.errors import InvalidContainerError


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
    max_gaussians: MaxGaussiansOption = None,
    level: LevelOption = 0,
    raw_axes: RawAxesOption = False,
    antialiased: AntialiasedOption = None,
    threads: ThreadsOption = 0,
    force: ForceOption = False,
    as_json: JsonOption = False,
    quiet: QuietOption = False,
) -> None:
    """Decode containers and scenes of other formats into .ply files."""
    from kissgs.pipeline.decompress import decompress as run

    def work(container: str, target: Path) -> dict[str, Any]:
        piped = str(target) == "-"
        with progress_bar(quiet or as_json) as progress:
            splats = run(
                source(container),
                None if piped else target,
                max_gaussians=max_gaussians,
                level=level,
                raw_axes=raw_axes,
                antialiased=antialiased,
                overwrite=force,
                threads=threads,
                progress=progress,
            )
        say_notes(str(target), splats.notes, quiet or as_json)
        if piped:
            from kissgs.io.ply import write_ply

            with stdout():
                write_ply(sys.stdout.buffer, splats)
            return {}
        if not (quiet or as_json):
            from kissgs.cli.tables import gaussians

            show(f"{target}  {gaussians(len(splats))}, SH degree {splats.sh_degree}")
        size = target.stat().st_size
        return {"count": len(splats), "sh_degree": splats.sh_degree, "bytes": size, "notes": list(splats.notes)}

    for_each_input(containers, output, ".ply", as_json, work, unreadable=InvalidContainerError)
