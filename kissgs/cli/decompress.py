"""``kissgs decompress``: decode containers and scenes of other formats into ``.ply`` files."""

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
    SceneOptions,
    ScenesArgument,
    reads_scenes,
)
from kissgs.core.errors import InvalidContainerError


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
    from kissgs.pipeline.decompress import decompress as run

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
