"""The command line: thin, prints what the library returns. Heavy imports wait until a command needs them."""

from __future__ import annotations

import contextlib
import json
import os
import sys
from pathlib import Path
from typing import Annotated, Any, NoReturn

import typer

from kissgs import _cli_bench, _cli_compact, _cli_pictures, _cli_remote, _cli_render
from kissgs._cli_files import beside, each, show, source, stdout, write_stdout
from kissgs._cli_settings import budget_of, chosen, spelled_out
from kissgs._cli_signals import stoppable, unwinding
from kissgs._version import __version__
from kissgs.errors import InvalidContainerError, KissgsError, UnsupportedError

app = typer.Typer(
    name="kissgs",
    help="Compress 3D Gaussian Splatting scenes (.ply) into SOG-XT containers that any browser can open.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    rich_markup_mode="rich",
)

Scenes = Annotated[list[str], typer.Argument(metavar="FILE…", help="Files or patterns; '-' reads standard input.")]
Files = Annotated[list[str], typer.Argument(metavar="FILE…", help="Files or patterns.")]
PresetOption = Annotated[
    str, typer.Option("--preset", "-p", help="[bold]fast[/], [bold]balanced[/], [bold]small[/] or [bold]paper[/].")
]
SetOption = Annotated[
    list[str] | None,
    typer.Option("--set", metavar="NAME=VALUE", help="Change one setting of the preset; see docs/settings.md."),
]
SeedOption = Annotated[int | None, typer.Option(help="Of all random choices: same input, settings, seed: same bytes.")]
ForceOption = Annotated[bool, typer.Option("--force", "-f", help="Overwrite files that exist.")]
JsonOption = Annotated[bool, typer.Option("--json", help="Print JSON: an object for one file, a list for several.")]
QuietOption = Annotated[bool, typer.Option("--quiet", "-q", help="Print nothing but errors.")]
ThreadsOption = Annotated[int, typer.Option(min=0, help="0: one per processor. The bytes do not depend on it.")]


def run() -> None:
    """Do what the command line says."""
    os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")  # torch's idle threads would take the processor from ours
    unwinding(_run)


def _run() -> None:
    try:
        app(spelled_out(sys.argv[1:]))
    except KissgsError as error:
        _fail(error)
    except OSError as error:
        if error.filename is None:  # of no file that the user could have named: a bug
            raise
        _fail(UnsupportedError(f"cannot use {error.filename!s:.100}: {(error.strerror or str(error)).lower()}"))


@app.command()
def compress(
    scenes: Scenes,
    output: Annotated[
        Path | None,
        typer.Option("--output", "-o", help="NAME.zip, a folder for the zips, or '-'; by default beside the scene."),
    ] = None,
    preset: PresetOption = "balanced",
    changes: SetOption = None,
    psnr: Annotated[
        float | None, typer.Option(metavar="DB", help="The smallest container with this PSNR to the scene's pictures.")
    ] = None,
    target_size: Annotated[
        str | None, typer.Option(metavar="SIZE", help="The best container of at most this size: 800kB, 2.5MB.")
    ] = None,
    max_psnr_drop: Annotated[
        float | None,
        typer.Option(
            metavar="DB", help="The smallest container whose pictures lose no more: 0.1; better with --views."
        ),
    ] = None,
    compact: Annotated[
        str | None,
        typer.Option(
            metavar="BUDGET",
            help="Fewer Gaussians first: 200k, 20% or 0.2dB, see 'compact'; or [bold]auto[/]: as many as serve "
            "--target-size, --max-psnr-drop or --psnr best.",
        ),
    ] = None,
    finetune: Annotated[
        str | None,
        typer.Option(
            metavar="[STEPS]",
            help="Then fit the numbers in the images to --views, or to pictures of the scene: fewer bytes at equal "
            "PSNR, and a minute or two more. By default as many steps as the preset has.",
        ),
    ] = None,
    seed: SeedOption = None,
    unpacked: Annotated[bool, typer.Option("--unpacked", help="Write folders instead of zips.")] = False,
    evaluate: Annotated[bool, typer.Option("--evaluate", help="Measure PSNR and SSIM of the result.")] = False,
    views: Annotated[
        Path | None,
        typer.Option(
            "--views",
            metavar="DATA",
            help="Photographs: learn from them, keep what they see best, and judge by those held out.",
        ),
    ] = None,
    cache: Annotated[
        bool, typer.Option("--cache", help="Keep what was seen of a scene in a file beside it, for the next time.")
    ] = False,
    checkpoint: Annotated[
        bool,
        typer.Option(
            "--checkpoint", help="Keep the state of --compact and --finetune beside the scene; see 'compact'."
        ),
    ] = False,
    device: Annotated[
        str, typer.Option(help="Where --compact and --finetune train: [bold]cpu[/] or [bold]cuda[/].")
    ] = "cpu",
    threads: ThreadsOption = 0,
    force: ForceOption = False,
    as_json: JsonOption = False,
    quiet: QuietOption = False,
) -> None:
    """Compress scenes, each into a container of its own."""
    from kissgs.pipeline import compress as run
    from kissgs.training.checkpoint import forget

    budget = None if compact is None else budget_of(compact)
    settings = chosen(
        preset,
        changes,
        budget=budget,
        finetune=finetune,
        seed=seed,
        psnr=psnr,
        target_size=target_size,
        max_psnr_drop=max_psnr_drop,
    )
    if not (settings.compact.wanted or settings.finetune.wanted) and (checkpoint or device != "cpu"):
        raise UnsupportedError("--checkpoint and --device are about training; they go with --compact and --finetune")
    looks = evaluate or settings.encode.weigh or settings.compact.wanted or settings.finetune.wanted
    capture, where = _cli_pictures.open_views(views), _cli_pictures.device_of(device)
    if views is not None and not looks and not quiet:
        sys.stderr.write(f"kissgs: {preset} takes no pictures, so --views changes nothing; --evaluate judges by them\n")

    def work(scene: str, target: Path) -> dict[str, Any]:
        piped = str(target) == "-"
        with _progress(quiet or as_json) as bar, stoppable(bar, settings.searches) as progress:
            if evaluate:  # announced here, because it is no stage of the evaluation
                from kissgs.rendering.rasterizer import load_kernels

                load_kernels(progress)
            result = run(
                source(scene),
                None if piped else target,
                settings=settings,
                cache=beside(scene, ".importance.npz") if cache else None,
                evaluate=evaluate,
                views=capture,
                checkpoint=beside(scene, _cli_compact.CHECKPOINT) if checkpoint else None,
                overwrite=force,
                threads=threads,
                device=where,
                progress=progress,
            )
        if piped:
            write_stdout(result.to_zip())
            forget(*result.checkpoints)
        elif not (quiet or as_json):
            from kissgs._tables import report_table

            show(report_table(result.report, str(target)))
        return result.report.as_dict()

    each(scenes, output, "" if unpacked else ".zip", as_json, work)


@app.command()
def decompress(
    containers: Scenes,
    output: Annotated[
        Path | None,
        typer.Option("--output", "-o", help="NAME.ply, a folder for them, or '-'; by default beside the container."),
    ] = None,
    max_gaussians: Annotated[int | None, typer.Option(min=0, help="Refuse more; by default 20 million.")] = None,
    threads: ThreadsOption = 0,
    force: ForceOption = False,
    as_json: JsonOption = False,
    quiet: QuietOption = False,
) -> None:
    """Turn containers back into .ply files."""
    from kissgs.io.ply import write_ply
    from kissgs.pipeline import decompress as run
    from kissgs.sogxt.decode import MAX_GAUSSIANS

    def work(container: str, target: Path) -> dict[str, Any]:
        piped = str(target) == "-"
        with _progress(quiet or as_json) as progress:
            splats = run(
                source(container),
                None if piped else target,
                max_gaussians=MAX_GAUSSIANS if max_gaussians is None else max_gaussians,
                overwrite=force,
                threads=threads,
                progress=progress,
            )
        if piped:
            with stdout():
                write_ply(sys.stdout.buffer, splats)
            return {}
        if not (quiet or as_json):
            show(f"{target}  {len(splats):,} Gaussians, SH degree {splats.sh_degree}")
        return {"count": len(splats), "sh_degree": splats.sh_degree, "bytes": target.stat().st_size}

    each(containers, output, ".ply", as_json, work, unreadable=InvalidContainerError)


@app.command()
def info(files: Files, as_json: JsonOption = False) -> None:
    """Show what .ply files and containers hold."""
    from kissgs._tables import info_table
    from kissgs.info import describe

    def work(file: str, target: Path) -> dict[str, Any]:
        found = describe(Path(file))
        if not as_json:
            show(info_table(found))
        return found.as_dict()

    each(files, Path("-"), "", as_json, work, writes=False)


app.command()(_cli_compact.compact)
app.command()(_cli_render.render)
app.command()(_cli_pictures.evaluate)


@app.command()
def sample(
    output: Annotated[Path, typer.Argument(help="The .ply to write.")],
    gaussians: Annotated[int, typer.Option(min=0, help="How many.")] = 60_000,
    degree: Annotated[int, typer.Option(min=0, max=3, help="Of its spherical harmonics.")] = 3,
    seed: Annotated[int, typer.Option(min=0, help="Another seed makes another scene.")] = 0,
    force: ForceOption = False,
) -> None:
    """Make a sample scene: glossy, textured things on a table."""
    from kissgs.sample import sample_scene
    from kissgs.scenes import save

    save(sample_scene(gaussians, sh_degree=degree, seed=seed), output, overwrite=force)


app.command()(_cli_bench.bench)
app.add_typer(_cli_remote.app)


@app.command()
def warmup() -> None:
    """Compile the encoder's and the rasteriser's kernels now, so that no command has to wait for them later."""
    from kissgs.rendering.rasterizer import load_kernels as load_rasterizer
    from kissgs.sogxt.encode import load_kernels as load_encoder

    with _progress(False) as progress:  # one stage for both: it is announced once
        progress("kernels", 0.0)
        load_encoder()
        load_rasterizer()
        progress("kernels", 1.0)


@app.callback(invoke_without_command=True)
def _version(version: Annotated[bool, typer.Option("--version", help="Print the version and exit.")] = False) -> None:
    if version:
        typer.echo(f"kissgs {__version__}")
        raise typer.Exit


def _progress(silent: bool) -> Any:  # noqa: ANN401
    from kissgs._console import progress_bar

    return progress_bar(silent)


def _fail(error: KissgsError) -> NoReturn:
    if "--json" in sys.argv:
        with contextlib.suppress(KissgsError):  # it may be standard output that failed
            write_stdout((json.dumps({"error": {"code": error.code, "message": str(error)}}) + "\n").encode())
    sys.stderr.write(f"kissgs: {error}\n")
    sys.exit(2)
