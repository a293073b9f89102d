"""``kissgs bench``: presets and other tools measured on the user's scenes, and what pictures of them cost."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from kissgs._cli_files import expand, print_json, show
from kissgs._cli_pictures import ImagesOption, ResolutionOption, ScaleOption, ViewsOption, open_views
from kissgs._cli_settings import chosen
from kissgs.errors import UnsupportedError

if TYPE_CHECKING:
    from rich.console import RenderableType

    from kissgs.compaction.study import Point
    from kissgs.curves import RatePoint
    from kissgs.views.view import Views

ThreadsOption = Annotated[int, typer.Option(min=0, help="0: one per processor.")]


def bench(
    scenes: Annotated[list[str], typer.Argument(metavar="FILE…", help="Files or patterns.")],
    presets: Annotated[
        list[str] | None, typer.Option("--preset", "-p", help="Repeat for several; default: all.")
    ] = None,
    changes: Annotated[
        list[str] | None, typer.Option("--set", metavar="NAME=VALUE", help="Change one setting of all these presets.")
    ] = None,
    peers: Annotated[list[str] | None, typer.Option("--peer", help="sog or spz, by splat-transform.")] = None,
    splat_transform: Annotated[str, typer.Option(help="How to start it.")] = "splat-transform",
    sog_iterations: Annotated[
        int | None, typer.Option(min=1, help="Of .sog's SH k-means: without a GPU each takes minutes.")
    ] = None,
    pictures: Annotated[bool, typer.Option("--pictures", help="Compare pictures too; implied by --views.")] = False,
    rendering: Annotated[
        bool, typer.Option("--rendering", help="Measure the rasteriser instead: pictures, gradients, loss, scores.")
    ] = False,
    compaction: Annotated[
        bool,
        typer.Option("--compaction", help="Measure ways to have fewer Gaussians instead, with each preset's training."),
    ] = False,
    finetuning: Annotated[
        bool,
        typer.Option("--finetuning", help="Measure bytes and PSNR with fine-tuning and without instead."),
    ] = False,
    fidelities: Annotated[
        list[float] | None,
        typer.Option("--fidelity", min=-30, max=30, help="With --finetuning: at this one. Repeat for several."),
    ] = None,
    ratios: Annotated[
        list[float] | None,
        typer.Option("--ratio", min=0, max=1, help="With --compaction: keep this share. Repeat for several."),
    ] = None,
    ways: Annotated[
        list[str] | None, typer.Option("--way", help="With --compaction: only this way. Repeat for several.")
    ] = None,
    learn_from: Annotated[
        str,
        typer.Option(
            metavar="WHAT",
            help="With these two: from the [bold]photos[/] of --views, from its [bold]cameras[/] alone, or from the "
            "[bold]scene[/] alone. --views judges in any case.",
        ),
    ] = "photos",
    plot: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="With these two: PSNR over count or bytes, as .svg, .png or .pdf."),
    ] = None,
    gaussians: Annotated[
        list[int] | None,
        typer.Option(min=1, help="With --rendering: resample the scene to so many. Repeat for several."),
    ] = None,
    views: ViewsOption = None,
    scale: ScaleOption = None,
    images: ImagesOption = None,
    resolution: ResolutionOption = None,
    threads: ThreadsOption = 0,
    as_json: Annotated[bool, typer.Option("--json", help="Print JSON.")] = False,
) -> None:
    """Measure bytes, time, memory and errors of presets and of other tools, each in a process of its own."""
    capture = open_views(views, scale=scale, images=images, resolution=resolution)
    rows: list[dict[str, Any]]
    table: RenderableType
    curves: list[tuple[str, Point]] = []
    drawn: list[tuple[str, RatePoint]] = []
    if not compaction and (ratios or ways):
        raise UnsupportedError("--ratio and --way go with --compaction")
    if not finetuning and fidelities:
        raise UnsupportedError("--fidelity goes with --finetuning; for a preset, --set fidelity=…")
    if not (compaction or finetuning) and (plot or learn_from != "photos"):
        raise UnsupportedError("--learn-from and --plot go with --compaction or --finetuning")
    if (compaction or finetuning) and (rendering or peers or gaussians or len(presets or []) > 1):
        what = "--compaction" if compaction else "--finetuning"
        raise UnsupportedError(f"{what} goes with one --preset, and with nothing else that is measured")
    preset = (presets or ["balanced"])[0]
    if compaction and finetuning:
        raise UnsupportedError("--compaction and --finetuning are two measurements; make one after the other")
    if finetuning:
        from kissgs._cli_curves import finetuning_curves, finetuning_table

        drawn = finetuning_curves(expand(scenes), preset, changes, fidelities, plot, capture, learn_from, threads)
        rows = [{"scene": scene, **point.as_dict()} for scene, point in drawn]
        table = finetuning_table(drawn)
    elif compaction:
        from kissgs._cli_curves import compaction_curves, curves_table

        curves = compaction_curves(expand(scenes), preset, changes, ratios, ways, plot, capture, learn_from, threads)
        rows = [{"scene": scene, **point.as_dict()} for scene, point in curves]
        table = curves_table(curves)
    elif rendering:
        if presets or peers:
            raise UnsupportedError("--rendering measures the rasteriser, no presets and no peers")
        rows, table = _rendering(expand(scenes), gaussians, capture, threads)
    else:
        if gaussians:
            raise UnsupportedError("--gaussians goes with --rendering; to compress, make a scene: kissgs sample")
        compared = pictures or capture is not None
        peer_options = {"command": splat_transform, "sh_iterations": sog_iterations}
        rows, table = _compression(
            expand(scenes), presets, changes, peers or [], peer_options, compared, capture, threads
        )
    if as_json:
        print_json(rows)
    else:
        show(table)
    if plot is not None:  # last: what it shows has taken long to find
        from kissgs._plots import compaction_plot, finetuning_plot

        if finetuning:
            finetuning_plot([point for _, point in drawn], plot)
        else:
            compaction_plot([point for _, point in curves], plot)


def _compression(
    scenes: list[str],
    presets: list[str] | None,
    changes: list[str] | None,
    peers: list[str],
    peer_options: dict[str, Any],
    pictures: bool,
    views: Views | None,
    threads: int,
) -> tuple[list[dict[str, Any]], RenderableType]:
    import shlex

    from kissgs._tables import bench_table
    from kissgs.bench import isolated_roundtrip
    from kissgs.evaluation.peers import measure_peer
    from kissgs.settings import Preset

    all_settings = [chosen(name, changes) for name in presets or list(Preset)]
    command, iterations = shlex.split(peer_options["command"]), peer_options["sh_iterations"]
    rows: list[tuple[str, str, Any]] = []
    for scene in expand(scenes):
        path = Path(scene)
        for settings in all_settings:
            result = isolated_roundtrip(path, settings, pictures=pictures, views=views, threads=threads)
            rows.append((path.name, str(settings.preset), result))
        for peer in peers:
            peer_iterations = iterations if peer == "sog" else None
            other = measure_peer(
                path, peer, command=command, sh_iterations=peer_iterations, pictures=pictures, views=views
            )
            rows.append((path.name, peer, other))
    numbers = [{"scene": scene, "encoder": name, **result.as_dict()} for scene, name, result in rows]
    return numbers, bench_table(rows)


def _rendering(
    scenes: list[str], counts: list[int] | None, views: Views | None, threads: int
) -> tuple[list[dict[str, Any]], RenderableType]:
    from kissgs._console import progress_bar
    from kissgs._picture_tables import rendering_table
    from kissgs.evaluation.speed import rendering_cost, resampled
    from kissgs.scenes import load
    from kissgs.views.virtual import virtual_views

    rows = []
    with progress_bar(False) as progress:
        for scene in scenes:
            splats = load(scene, threads=threads, progress=progress)
            chosen = views or virtual_views(splats, threads=threads, progress=progress)
            cameras = [view.camera for view in chosen.test or chosen.train]
            for count in counts or [len(splats)]:
                cost = rendering_cost(resampled(splats, count), cameras, threads=threads, progress=progress)
                rows.append((Path(scene).name, cost))
    return [{"scene": scene, **cost.as_dict()} for scene, cost in rows], rendering_table(rows)
