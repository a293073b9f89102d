"""``kissgs compress``: compress scenes into containers."""

from __future__ import annotations

import contextlib
import sys
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from kissgs.cli.arguments import (
    ContainerOption,
    ForceOption,
    JsonOption,
    LevelOption,
    MaxGaussiansOption,
    PresetOption,
    QuietOption,
    RawAxesOption,
    RayOption,
    ScenesArgument,
    SeedOption,
    SetOption,
    ThreadsOption,
)
from kissgs.cli.compact import CHECKPOINT
from kissgs.cli.console import progress_bar
from kissgs.cli.files import for_each_input, show, sibling, source, write_stdout
from kissgs.cli.interrupts import say_when_interrupted
from kissgs.cli.options import budget_of, chosen, device_of, open_views
from kissgs.cli.signals import stoppable
from kissgs.core.errors import UnsupportedError
from kissgs.io.container_names import named_manifest

if TYPE_CHECKING:
    from kissgs.pipeline.read_options import ReadOptions
    from kissgs.settings import Settings


def compress(
    scenes: ScenesArgument,
    output: Annotated[
        Path | None,
        typer.Option(
            "--output",
            "-o",
            help="Output NAME.zip, NAME.sog, FOLDER/lod-meta.json or NAME.sogxt/ for levels of detail, a folder, or "
            "'-' for standard output. Default: next to the scene.",
        ),
    ] = None,
    container: ContainerOption = None,
    preset: PresetOption = "balanced",
    changes: SetOption = None,
    psnr: Annotated[
        float | None,
        typer.Option(
            metavar="DB", help="Find the smallest container with at least this PSNR to the scene's renderings."
        ),
    ] = None,
    target_size: Annotated[
        str | None,
        typer.Option(metavar="SIZE", help="Find the best container of at most this size, such as 800kB or 2.5MB."),
    ] = None,
    max_psnr_drop: Annotated[
        float | None,
        typer.Option(
            metavar="DB",
            help="Find the smallest container that loses at most this PSNR, such as 0.1. Best with --views.",
        ),
    ] = None,
    max_ssim_drop: Annotated[
        float | None,
        typer.Option(
            metavar="SSIM",
            help="Find the smallest container that loses at most this SSIM, such as 0.003; also with --max-psnr-drop.",
        ),
    ] = None,
    compact: Annotated[
        str | None,
        typer.Option(
            metavar="BUDGET",
            help="First reduce the number of Gaussians, see 'kissgs compact': to a count (200k), a share (20%) or a "
            "PSNR drop (0.2dB); auto searches the count that is best for --target-size, --max-psnr-drop or --psnr.",
        ),
    ] = None,
    finetune: Annotated[
        str | None,
        typer.Option(
            metavar="[STEPS]",
            help="Fine-tune the quantised values on the photographs of --views, or on renderings of the scene: fewer "
            "bytes at equal PSNR, a minute or two more. Default number of steps: that of the preset.",
        ),
    ] = None,
    seed: SeedOption = None,
    unpacked: Annotated[bool, typer.Option("--unpacked", help="Write a folder instead of a zip.")] = False,
    evaluate: Annotated[
        bool, typer.Option("--evaluate", help="Decode the result, and measure PSNR and SSIM of its renderings.")
    ] = False,
    views: Annotated[
        Path | None,
        typer.Option(
            "--views",
            metavar="DATA",
            help="Capture (COLMAP or transforms.json folder): training views give sensitivity and training targets, "
            "held-out views evaluate. Default: virtual cameras.",
        ),
    ] = None,
    cache: Annotated[
        bool, typer.Option("--cache", help="Cache the sensitivity next to the scene as NAME.sensitivity.npz.")
    ] = False,
    checkpoint: Annotated[
        bool,
        typer.Option(
            "--checkpoint", help="Save the state of --compact and --finetune next to the scene, and resume from it."
        ),
    ] = False,
    max_gaussians: MaxGaussiansOption = None,
    level: LevelOption = 0,
    raw_axes: RawAxesOption = False,
    device: Annotated[str, typer.Option(help="Device of --compact and --finetune: cpu or cuda.")] = "cpu",
    threads: ThreadsOption = 0,
    ray: RayOption = None,
    force: ForceOption = False,
    as_json: JsonOption = False,
    quiet: QuietOption = False,
) -> None:
    """Compress each scene into a SOG-XT container, into SOG, or into a folder with levels of detail."""
    from kissgs.io.container_names import ending_of, named_container
    from kissgs.pipeline.pipeline import compress as run
    from kissgs.pipeline.read_options import ReadOptions
    from kissgs.training.checkpoint import delete_checkpoints

    kind = named_container(container, output)
    reading = ReadOptions(max_gaussians=max_gaussians, level=level, raw_axes=raw_axes)
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
        max_ssim_drop=max_ssim_drop,
    )
    if not (settings.compact.enabled or settings.finetune.enabled) and (checkpoint or device != "cpu"):
        raise UnsupportedError("--checkpoint and --device only apply to training: add --compact or --finetune")
    renders = evaluate or settings.encode.rate_distortion or settings.compact.enabled or settings.finetune.enabled
    capture, training_device = open_views(views), device_of(device)
    if views is not None and not renders and not quiet:
        sys.stderr.write(f"kissgs: --views has no effect: the preset {preset} renders no images; add --evaluate\n")

    manifest = None if output is None else named_manifest(output)
    if manifest is not None:
        unused = {
            "--views": views,
            "--evaluate": evaluate,
            "--cache": cache,
            "--container": container,
            "--unpacked": unpacked,
        }
        if wrong := next((name for name, value in unused.items() if value), None):
            raise UnsupportedError(f"levels of detail ({manifest.name}) are made without {wrong}")
        for_each_input(
            scenes,
            manifest,
            ".json",
            as_json,
            partial(_streamed, settings, reading, force, ray, threads, quiet or as_json),
        )
        return

    ending = "" if unpacked else ending_of(kind)
    if ray is not None:
        from kissgs.cli.compress_cluster import ClusterCompression

        with ClusterCompression(
            address=ray,
            settings=settings,
            reading=reading,
            container=kind,
            cache=cache,
            evaluate=evaluate,
            views=views,
            checkpoint=checkpoint,
            force=force,
            threads=threads,
            device=training_device,
            quiet=quiet or as_json,
        ) as cluster:
            for_each_input(scenes, output, ending, as_json, cluster.result, before=cluster.submit)
        return

    def work(scene: str, target: Path) -> dict[str, Any]:
        piped = str(target) == "-"
        with progress_bar(quiet or as_json) as bar, stoppable(bar, settings.searches) as progress:
            if evaluate:  # reported here, because evaluation reports only one stage
                from kissgs.rendering.rasterizer import load_kernels

                load_kernels(progress)
            result = run(
                source(scene),
                None if piped else target,
                settings=settings,
                reading=reading,
                container=kind,
                cache=sibling(scene, ".sensitivity.npz") if cache else None,
                evaluate=evaluate,
                views=capture,
                checkpoint=sibling(scene, CHECKPOINT) if checkpoint else None,
                overwrite=force,
                threads=threads,
                device=training_device,
                progress=progress,
            )
        if piped:
            write_stdout(result.to_zip())
            delete_checkpoints(*result.checkpoints)
        elif not (quiet or as_json):
            from kissgs.cli.tables import report_table

            show(report_table(result.report, str(target)))
        return result.report.as_dict()

    for_each_input(scenes, output, ending, as_json, work)


def _streamed(
    settings: Settings,
    reading: ReadOptions,
    force: bool,
    ray: str | None,
    threads: int,
    quiet: bool,
    scene: str,
    target: Path,
) -> dict[str, Any]:
    """Compress one scene into a streamed scene."""
    if scene == "-":
        raise UnsupportedError("levels of detail need a file: it is read more than once")
    with progress_bar(quiet) as bar, contextlib.ExitStack() as ending:

        def progress(stage: str, fraction: float, note: str = "") -> None:
            if stage == "scratch" and not quiet:
                sys.stderr.write(f"kissgs: {note}\n")
            if stage in ("merge", "cameras", "images"):  # what is interrupted earlier begins anew
                say_when_interrupted("the same command goes on where it was")
            bar(stage, fraction, note)

        progress("kernels", 0.0)
        from kissgs.streaming.compress import compress_streamed

        runner = None
        if ray is not None:
            from kissgs.runners import open_runner

            progress("cluster", 0.0)
            runner = open_runner("ray", ray)
            ending.callback(runner.close)
        report = compress_streamed(
            scene,
            target,
            settings=settings,
            reading=reading,
            overwrite=force,
            runner=runner,
            threads=threads,
            progress=progress,
        )
    if not quiet:
        from kissgs.cli.tables import streamed_table

        show(streamed_table(report, str(target)))
    return asdict(report)
