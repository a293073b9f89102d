"""``info``, ``settings``, ``decompress``, ``convert`` and ``sample``: describe, decode, rewrite and make scenes."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from typer import Argument, Option

from kissgs.cli.files import Result, for_each_input, gaussians, progress_bar, say_notes, show, source, stdout
from kissgs.cli.options import (
    FilesArgument,
    ForceOption,
    JsonOption,
    OriginOption,
    SceneOptions,
    ScenesArgument,
    output_option,
    with_option_groups,
)
from kissgs.core.errors import InvalidContainerError, OutputError
from kissgs.formats import ENDINGS, OUTPUT_FORMATS, SCENE_ENDINGS, WRITTEN, alternatives, output_format

# ``kissgs info`` and ``kissgs settings``: describe the contents of scene files, and settings.


@with_option_groups
def info(files: FilesArgument, as_json: JsonOption = False, *, common: SceneOptions) -> None:
    """Describe scenes of any format and containers: Gaussians, SH degree, bytes per file, value ranges."""
    from kissgs.cli.tables import info_table
    from kissgs.pipeline.scene_files import describe

    def work(file: str, target: Path) -> Result:
        found = describe(Path(file), common.reading())
        return found.as_dict(), info_table(found)

    for_each_input(files, None, "", work, as_json=as_json, quiet=False, writes=False)


def settings() -> None:
    """List what --set takes: settings of the encoder, compact.NAME and finetune.NAME."""
    from kissgs.cli.tables import settings_table

    show(settings_table())


# ``kissgs decompress``: decode containers and scenes of other formats into ``.ply`` files.


@with_option_groups
def decompress(
    containers: ScenesArgument,
    output: Annotated[
        str | None,
        output_option("Output NAME.ply, a folder, or '-' for standard output. Default: next to the container."),
    ] = None,
    force: ForceOption = False,
    as_json: JsonOption = False,
    *,
    common: SceneOptions,
) -> None:
    """Decode containers and scenes of other formats into .ply files."""
    from kissgs.pipeline.scene_files import decompress as run

    quiet = common.quiet or as_json

    def work(container: str, target: Path) -> Result:
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

            with stdout() as file:
                write_ply(file, splats)
            return {}, ""
        report = {"count": len(splats), "sh_degree": splats.sh_degree, "bytes": target.stat().st_size}
        line = f"{target}  {gaussians(len(splats))}, SH degree {splats.sh_degree}"
        return {**report, "notes": list(splats.notes)}, line

    for_each_input(containers, output, ".ply", work, as_json=as_json, quiet=quiet, unreadable=InvalidContainerError)


# ``kissgs convert``: write scenes of any format in a plain one.


@with_option_groups
def convert(
    files: Annotated[
        list[str],
        Argument(
            metavar="IN… OUT",
            help=f"Scenes ('-' reads standard input), then the output: NAME{alternatives(WRITTEN)}; with --to also a "
            "folder, or '-' for standard output.",
        ),
    ],
    to: Annotated[
        str | None, Option("--to", help=f"Format where OUT has no ending: {alternatives(OUTPUT_FORMATS)}.")
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

    def work(scene: str, target: Path) -> Result:
        piped = str(target) == "-"
        if not piped:
            refuse_existing(target, overwrite=force)
        with progress_bar(quiet, [("read", 1.0), ("write", 1.0)]) as progress:
            splats, cleaned = clean(read_scene(source(scene), reading, threads=common.threads, progress=progress))
            splats = splats if origin else in_world(splats)
            with stdout() if piped else atomic_file(target, overwrite=force) as file:
                losses = write_scene(file, splats, kind, raw_axes=common.raw_axes, progress=progress)
        notes = [*splats.notes, *cleaned.notes, *losses]
        say_notes(str(target), notes, quiet)
        if piped:
            return {}, ""
        degree, size = 0 if kind == "splat" else splats.sh_degree, target.stat().st_size
        report = {"format": kind, "count": len(splats), "sh_degree": degree, "bytes": size, "notes": notes}
        return report, f"{target}  {gaussians(len(splats))}, {size:,} bytes"

    for_each_input(inputs, output, f".{kind}", work, as_json=as_json, quiet=quiet)


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


# ``kissgs sample``: write a synthetic scene for tests and demos.


def sample(
    output: Annotated[Path, Argument(help="Output NAME.ply; other formats as for convert.")],
    gaussians: Annotated[int, Option(min=0, help="Number of Gaussians.")] = 60_000,
    force: ForceOption = False,
) -> None:
    """Write a synthetic sample scene: shiny, textured objects on a table."""
    from kissgs.pipeline.scene_files import save
    from kissgs.synthetic import sample_scene

    save(sample_scene(gaussians), output, overwrite=force)
