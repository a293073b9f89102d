"""``kissgs compact``: a ``.ply`` with fewer Gaussians."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

from kissgs.cli.files import beside, each, show, source, stdout
from kissgs.cli.options import chosen, count_of, device_of, open_views
from kissgs.core.errors import UnsupportedError

CHECKPOINT = ".checkpoint.npz"


def compact(
    scenes: Annotated[list[str], typer.Argument(metavar="FILE…", help="Files or patterns; '-' reads standard input.")],
    output: Annotated[
        Path | None,
        typer.Option("--output", "-o", help="NAME.ply, a folder for them, or '-'. Needed: nothing is overwritten."),
    ] = None,
    count: Annotated[
        str | None, typer.Option("--count", "-n", metavar="N", help="Keep so many Gaussians: 200k, 1.5M.")
    ] = None,
    ratio: Annotated[float | None, typer.Option(metavar="SHARE", help="Keep this share of them: 0.2.")] = None,
    max_psnr_drop: Annotated[
        float | None, typer.Option(metavar="DB", help="Keep as few as lose no more than this. Takes several attempts.")
    ] = None,
    views: Annotated[
        Path | None,
        typer.Option("--views", metavar="DATA", help="Photographs to learn from, and held-out ones to judge by."),
    ] = None,
    preset: Annotated[
        str,
        typer.Option(
            "--preset", "-p", help="[bold]fast[/] only prunes; [bold]balanced[/], [bold]small[/], [bold]paper[/] train."
        ),
    ] = "balanced",
    changes: Annotated[
        list[str] | None,
        typer.Option("--set", metavar="NAME=VALUE", help="Change one setting of the preset; see docs/settings.md."),
    ] = None,
    seed: Annotated[
        int | None, typer.Option(help="Of the order of pictures and of virtual cameras. Same seed: same scene.")
    ] = None,
    evaluate: Annotated[
        bool, typer.Option("--evaluate", help="Measure PSNR, SSIM and bytes after every step.")
    ] = False,
    checkpoint: Annotated[
        bool,
        typer.Option("--checkpoint", help="Keep the state in a file beside the scene, and go on from it next time."),
    ] = False,
    device: Annotated[
        str, typer.Option(help="Where to train: [bold]cpu[/], or [bold]cuda[/], whose results vary a little.")
    ] = "cpu",
    threads: Annotated[int, typer.Option(min=0, help="0: one per processor. The result does not depend on it.")] = 0,
    force: Annotated[bool, typer.Option("--force", "-f", help="Overwrite files that exist.")] = False,
    as_json: Annotated[
        bool, typer.Option("--json", help="Print JSON: an object for one file, a list for several.")
    ] = False,
    quiet: Annotated[bool, typer.Option("--quiet", "-q", help="Print nothing but errors.")] = False,
) -> None:
    """Bring scenes down to fewer Gaussians that show the same: score, prune, train, prune, train (POPSpa)."""
    from kissgs.cli.console import progress_bar
    from kissgs.cli.signals import stoppable
    from kissgs.io.ply import write_ply
    from kissgs.pipeline.pipeline import compact as run
    from kissgs.training.checkpoint import forget

    settings = chosen(
        preset,
        changes,
        group="compact",
        seed=seed,
        count=None if count is None else count_of(count),
        ratio=ratio,
        max_psnr_drop=max_psnr_drop,
    )
    if not settings.compact.enabled:
        raise UnsupportedError("say how many Gaussians to keep: -n 200k, --ratio 0.2 or --max-psnr-drop 0.2")
    if output is None:
        raise UnsupportedError("say where to write with -o: beside the scene stands the scene itself")
    capture, where = open_views(views), device_of(device)

    def work(scene: str, target: Path) -> dict[str, Any]:
        piped = str(target) == "-"
        with progress_bar(quiet or as_json) as bar, stoppable(bar, settings.searches) as progress:
            result = run(
                source(scene),
                None if piped else target,
                settings=settings,
                evaluate=evaluate,
                views=capture,
                checkpoint=beside(scene, CHECKPOINT) if checkpoint else None,
                overwrite=force,
                threads=threads,
                device=where,
                progress=progress,
            )
        if piped:
            import sys

            with stdout():
                write_ply(sys.stdout.buffer, result.splats)
            forget(result.checkpoint)
        elif not (quiet or as_json):
            from kissgs.cli.tables import compaction_table

            show(compaction_table(result.report, str(target)))
        return result.report.as_dict()

    each(scenes, output, ".ply", as_json, work)
