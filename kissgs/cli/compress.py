"""``kissgs compress``: scenes into containers."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Annotated, Any

import typer

from kissgs.cli.arguments import (
    ForceOption,
    JsonOption,
    PresetOption,
    QuietOption,
    ScenesArgument,
    SeedOption,
    SetOption,
    ThreadsOption,
)
from kissgs.cli.compact import CHECKPOINT
from kissgs.cli.console import progress_bar
from kissgs.cli.files import beside, each, show, source, write_stdout
from kissgs.cli.options import budget_of, chosen, device_of, open_views
from kissgs.cli.signals import stoppable
from kissgs.core.errors import UnsupportedError


def compress(
    scenes: ScenesArgument,
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
    from kissgs.pipeline.pipeline import compress as run
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
    if not (settings.compact.enabled or settings.finetune.enabled) and (checkpoint or device != "cpu"):
        raise UnsupportedError("--checkpoint and --device are about training; they go with --compact and --finetune")
    looks = evaluate or settings.encode.rate_distortion or settings.compact.enabled or settings.finetune.enabled
    capture, where = open_views(views), device_of(device)
    if views is not None and not looks and not quiet:
        sys.stderr.write(f"kissgs: {preset} takes no pictures, so --views changes nothing; --evaluate judges by them\n")

    def work(scene: str, target: Path) -> dict[str, Any]:
        piped = str(target) == "-"
        with progress_bar(quiet or as_json) as bar, stoppable(bar, settings.searches) as progress:
            if evaluate:  # announced here, because it is no stage of the evaluation
                from kissgs.rendering.rasterizer import load_kernels

                load_kernels(progress)
            result = run(
                source(scene),
                None if piped else target,
                settings=settings,
                cache=beside(scene, ".sensitivity.npz") if cache else None,
                evaluate=evaluate,
                views=capture,
                checkpoint=beside(scene, CHECKPOINT) if checkpoint else None,
                overwrite=force,
                threads=threads,
                device=where,
                progress=progress,
            )
        if piped:
            write_stdout(result.to_zip())
            forget(*result.checkpoints)
        elif not (quiet or as_json):
            from kissgs.cli.tables import report_table

            show(report_table(result.report, str(target)))
        return result.report.as_dict()

    each(scenes, output, "" if unpacked else ".zip", as_json, work)
