"""``kissgs compact``: a ``.ply`` with fewer Gaussians."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

from kissgs.cli.files import for_each_input, say_notes, show, sibling, source, stdout
from kissgs.cli.options import (
    AntialiasedOption,
    ForceOption,
    ForceViewsOption,
    JsonOption,
    LevelOption,
    MaxGaussiansOption,
    QuietOption,
    RawAxesOption,
    ScenesArgument,
    SetOption,
    ThreadsOption,
    chosen,
    count_of,
    device_of,
    open_views,
    refuse_without_training,
    share_of,
)
from kissgs.core.errors import UnsupportedError

CHECKPOINT = ".checkpoint.npz"


def compact(
    scenes: ScenesArgument,
    output: Annotated[
        str | None,
        typer.Option(
            "--output", "-o", metavar="PATH", help="Output NAME.ply, a folder, or '-' for standard output. Required."
        ),
    ] = None,
    count: Annotated[
        str | None,
        typer.Option("--count", "-n", metavar="N", help="Number of Gaussians to keep, such as 200k or 1.5M."),
    ] = None,
    ratio: Annotated[
        str | None, typer.Option(metavar="SHARE", help="Share of the Gaussians to keep, such as 0.2 or 20%.")
    ] = None,
    max_psnr_drop: Annotated[
        float | None,
        typer.Option(metavar="DB", help="Keep as few Gaussians as lose at most this PSNR. Takes several runs."),
    ] = None,
    method: Annotated[
        str | None,
        typer.Option(
            metavar="METHOD",
            help="prune: remove what images miss least, and train the rest. merge: replace neighbours by one Gaussian; "
            "takes seconds, needs neither views nor torch. Default: prune.",
        ),
    ] = None,
    views: Annotated[
        Path | None,
        typer.Option(
            "--views",
            metavar="DATA",
            help="Capture to train on and to evaluate with: a COLMAP or transforms.json folder. "
            "Default: renderings of the scene.",
        ),
    ] = None,
    force_views: ForceViewsOption = False,
    preset: Annotated[
        str,
        typer.Option("--preset", "-p", help="fast only prunes; balanced, small and paper also train."),
    ] = "balanced",
    changes: SetOption = None,
    seed: Annotated[
        int | None,
        typer.Option(help="Seed of the image order and the virtual cameras; same seed, same result. Default: 0."),
    ] = None,
    evaluate: Annotated[
        bool, typer.Option("--evaluate", help="Measure PSNR, SSIM, MS-SSIM and compressed size after every step.")
    ] = False,
    checkpoint: Annotated[
        bool,
        typer.Option("--checkpoint", help="Save the training state next to the scene, and resume from it next time."),
    ] = False,
    max_gaussians: MaxGaussiansOption = None,
    level: LevelOption = 0,
    raw_axes: RawAxesOption = False,
    antialiased: AntialiasedOption = None,
    device: Annotated[
        str, typer.Option(help="Device of the training: cpu (reproducible) or cuda (results vary slightly).")
    ] = "cpu",
    threads: ThreadsOption = 0,
    force: ForceOption = False,
    as_json: JsonOption = False,
    quiet: QuietOption = False,
) -> None:
    """Reduce the number of Gaussians of scenes at nearly equal quality: score, prune and train (POPSpa), or merge."""
    from kissgs.cli.console import progress_bar
    from kissgs.cli.signals import stoppable
    from kissgs.io.ply import write_ply
    from kissgs.io.scene_format import ReadOptions
    from kissgs.pipeline.pipeline import compact as run
    from kissgs.training.checkpoint import delete_checkpoints

    settings = chosen(
        preset,
        changes,
        group="compact",
        seed=seed,
        method=method,
        count=None if count is None else count_of(count),
        ratio=None if ratio is None else share_of(ratio),
        max_psnr_drop=max_psnr_drop,
    )
    if not settings.compact.enabled:
        raise UnsupportedError(
            "missing the number of Gaussians to keep: give -n 200k, --ratio 0.2 or --max-psnr-drop 0.2"
        )
    refuse_without_training(settings, checkpoint=checkpoint, device=device)
    if output is None:
        raise UnsupportedError("missing -o: by default the output would overwrite the input")
    reading = ReadOptions(max_gaussians=max_gaussians, level=level, raw_axes=raw_axes, antialiased=antialiased)
    capture, training_device = open_views(views), device_of(device)

    def work(scene: str, target: Path) -> dict[str, Any]:
        piped = str(target) == "-"
        with progress_bar(quiet or as_json) as bar, stoppable(bar, settings.searches) as progress:
            result = run(
                source(scene),
                None if piped else target,
                settings=settings,
                reading=reading,
                evaluate=evaluate,
                views=capture,
                force_views=force_views,
                checkpoint=sibling(scene, CHECKPOINT) if checkpoint else None,
                overwrite=force,
                threads=threads,
                device=training_device,
                progress=progress,
            )
        if piped:
            import sys

            say_notes(scene, (result.report.note, *result.report.cleaned.notes), quiet)
            with stdout():
                write_ply(sys.stdout.buffer, result.splats)
            delete_checkpoints(result.checkpoint)
        elif not (quiet or as_json):
            from kissgs.cli.tables import compaction_table

            show(compaction_table(result.report, str(target)))
        return result.report.as_dict()

    for_each_input(scenes, output, ".ply", as_json, work)
