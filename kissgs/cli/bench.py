"""``kissgs bench``: measurements of presets, external codecs, parts of the codec and the rasteriser."""

from __future__ import annotations

from typing import Annotated

import typer

from kissgs.cli.arguments import FilesArgument, ImagesOption, ResolutionOption, ScaleOption, SetOption, ViewsOption
from kissgs.cli.bench_arguments import (
    ExternalCodecsOption,
    JsonOption,
    PlotOption,
    PresetsOption,
    RepeatsOption,
    SetAllOption,
    SogIterationsOption,
    SplatTransformOption,
    SupervisionOption,
    ThreadsOption,
)
from kissgs.cli.bench_capacity import capacity
from kissgs.cli.bench_scenes import open_inputs, report
from kissgs.cli.options import open_views

app = typer.Typer(
    name="bench",
    help="Measure presets, external codecs, parts of the codec and the rasteriser on your scenes.",
    no_args_is_help=True,
)


@app.command()
def codecs(
    scenes: FilesArgument,
    presets: PresetsOption = None,
    changes: SetAllOption = None,
    containers: Annotated[
        list[str] | None,
        typer.Option("--container", help="Container of the presets, sogxt or sog; repeatable. Default: sogxt."),
    ] = None,
    external_codecs: ExternalCodecsOption = None,
    splat_transform: SplatTransformOption = "splat-transform",
    sog_iterations: SogIterationsOption = None,
    quality_offsets: Annotated[
        list[float] | None,
        typer.Option(
            "--quality-offset",
            min=-30,
            max=30,
            help="Measure balanced, or the presets of --preset, at this quality offset (dB) too; repeatable.",
        ),
    ] = None,
    repeats: RepeatsOption = 1,
    evaluate: Annotated[
        bool,
        typer.Option(
            "--evaluate", help="Compare rendered images too; implied by --views, --quality-offset and --plot."
        ),
    ] = False,
    plot: PlotOption = None,
    views: ViewsOption = None,
    scale: ScaleOption = None,
    images: ImagesOption = None,
    resolution: ResolutionOption = None,
    threads: ThreadsOption = 0,
    as_json: JsonOption = False,
) -> None:
    """Measure bytes, times, memory and errors of presets and external codecs, each in a separate process."""
    capture = open_views(views, scale=scale, images=images, resolution=resolution)
    inputs = open_inputs(scenes, capture, threads, plot)
    from kissgs.cli import bench_codecs

    output = bench_codecs.codecs(
        inputs,
        presets=presets,
        changes=changes,
        containers=containers or [],
        external=bench_codecs.ExternalCodecs(external_codecs or [], splat_transform, sog_iterations),
        quality_offsets=quality_offsets or [],
        repeats=repeats,
        evaluate=evaluate or plot is not None,
    )
    report(output, as_json, plot)


@app.command()
def frontier(
    scenes: FilesArgument,
    times: Annotated[
        list[str] | None,
        typer.Option(
            "--time", metavar="TIME", help="Time limit to measure; repeatable. Default: 5s, 30s, 2min and 10min."
        ),
    ] = None,
    presets: PresetsOption = None,
    changes: SetAllOption = None,
    external_codecs: ExternalCodecsOption = None,
    splat_transform: SplatTransformOption = "splat-transform",
    sog_iterations: SogIterationsOption = None,
    plot: PlotOption = None,
    views: ViewsOption = None,
    scale: ScaleOption = None,
    images: ImagesOption = None,
    resolution: ResolutionOption = None,
    threads: ThreadsOption = 0,
    as_json: JsonOption = False,
) -> None:
    """Measure bytes and quality of what is found in limited times, beside presets and external codecs."""
    capture = open_views(views, scale=scale, images=images, resolution=resolution)
    inputs = open_inputs(scenes, capture, threads, plot)
    from kissgs.cli import bench_codecs, bench_frontier

    output = bench_frontier.frontier(
        inputs,
        times=times or [],
        presets=presets,
        changes=changes,
        external=bench_codecs.ExternalCodecs(external_codecs or [], splat_transform, sog_iterations),
    )
    report(output, as_json, plot)


@app.command()
def scaling(
    counts: Annotated[
        list[int],
        typer.Option(
            "--gaussians",
            min=1,
            help="Measure the scene resampled to this number of Gaussians, or a sample scene of it; repeatable.",
        ),
    ],
    scenes: Annotated[
        list[str] | None, typer.Argument(metavar="FILE…", help="Files or glob patterns. Default: sample scenes.")
    ] = None,
    degrees: Annotated[
        list[int] | None,
        typer.Option("--degree", min=0, max=3, help="Degree of the sample scenes; repeatable. Default: 3."),
    ] = None,
    presets: PresetsOption = None,
    changes: SetAllOption = None,
    external_codecs: ExternalCodecsOption = None,
    splat_transform: SplatTransformOption = "splat-transform",
    sog_iterations: SogIterationsOption = None,
    repeats: RepeatsOption = 1,
    evaluate: Annotated[
        bool, typer.Option("--evaluate", help="Compare rendered images too; implied by --views.")
    ] = False,
    plot: PlotOption = None,
    views: ViewsOption = None,
    scale: ScaleOption = None,
    images: ImagesOption = None,
    resolution: ResolutionOption = None,
    threads: ThreadsOption = 0,
    as_json: JsonOption = False,
) -> None:
    """Measure how bytes, and times and memory of every stage, grow with the number of Gaussians.

    Ctrl-C ends it with what is measured.
    """
    capture = open_views(views, scale=scale, images=images, resolution=resolution)
    inputs = open_inputs(scenes or [], capture, threads, plot)
    from kissgs.cli import bench_scaling
    from kissgs.cli.bench_codecs import ExternalCodecs

    output = bench_scaling.scaling(
        inputs,
        counts,
        degrees=degrees or [],
        presets=presets,
        changes=changes,
        external=ExternalCodecs(external_codecs or [], splat_transform, sog_iterations),
        repeats=repeats,
        evaluate=evaluate,
        plotted=plot is not None,
    )
    report(output, as_json, plot)


@app.command()
def ablation(
    scenes: FilesArgument,
    presets: Annotated[
        list[str] | None,
        typer.Option(
            "--preset",
            "-p",
            help="Preset to measure: paper, balanced or small; repeatable. Default: paper and balanced.",
        ),
    ] = None,
    changes: SetAllOption = None,
    views: ViewsOption = None,
    scale: ScaleOption = None,
    images: ImagesOption = None,
    resolution: ResolutionOption = None,
    threads: ThreadsOption = 0,
    as_json: JsonOption = False,
) -> None:
    """Measure bytes and PSNR of presets with one part of the codec left out or one setting changed at a time."""
    capture = open_views(views, scale=scale, images=images, resolution=resolution)
    inputs = open_inputs(scenes, capture, threads)
    from kissgs.cli import bench_ablation

    report(bench_ablation.ablation(inputs, presets=presets, changes=changes), as_json)


@app.command()
def compaction(
    scenes: FilesArgument,
    preset: Annotated[
        str, typer.Option("--preset", "-p", help="fast only prunes; balanced, small and paper also train.")
    ] = "balanced",
    changes: SetOption = None,
    ratios: Annotated[
        list[float] | None,
        typer.Option(
            "--ratio",
            min=0,
            max=1,
            help="Share of the Gaussians to keep; repeatable. Default: 0.7, 0.5, 0.3, 0.2, 0.1 and 0.05.",
        ),
    ] = None,
    strategies: Annotated[
        list[str] | None, typer.Option("--strategy", help="Strategy to measure; repeatable. Default: all.")
    ] = None,
    supervision: SupervisionOption = "photos",
    plot: PlotOption = None,
    views: ViewsOption = None,
    scale: ScaleOption = None,
    images: ImagesOption = None,
    resolution: ResolutionOption = None,
    threads: ThreadsOption = 0,
    as_json: JsonOption = False,
) -> None:
    """Compare strategies of compaction at equal numbers of Gaussians and of training steps."""
    capture = open_views(views, scale=scale, images=images, resolution=resolution)
    inputs = open_inputs(scenes, capture, threads, plot)
    from kissgs.cli import bench_curves

    output = bench_curves.compaction(
        inputs,
        preset=preset,
        changes=changes,
        ratios=ratios or [],
        strategies=strategies or [],
        supervision=supervision,
    )
    report(output, as_json, plot)


@app.command()
def finetuning(
    scenes: FilesArgument,
    preset: Annotated[
        str, typer.Option("--preset", "-p", help="Preset with rate-distortion planning: balanced or small.")
    ] = "balanced",
    changes: SetOption = None,
    quality_offsets: Annotated[
        list[float] | None,
        typer.Option(
            "--quality-offset",
            min=-30,
            max=30,
            help="Quality offset to measure (dB); repeatable. Default: -8, -5, -2 and 1; with --ratio, that of the "
            "preset.",
        ),
    ] = None,
    ratios: Annotated[
        list[float] | None,
        typer.Option(
            "--ratio",
            min=0,
            max=1,
            help="First compact the scene to this share of its Gaussians; repeatable. Default: no compaction.",
        ),
    ] = None,
    supervision: SupervisionOption = "photos",
    plot: PlotOption = None,
    views: ViewsOption = None,
    scale: ScaleOption = None,
    images: ImagesOption = None,
    resolution: ResolutionOption = None,
    threads: ThreadsOption = 0,
    as_json: JsonOption = False,
) -> None:
    """Measure bytes and PSNR with and without fine-tuning."""
    capture = open_views(views, scale=scale, images=images, resolution=resolution)
    inputs = open_inputs(scenes, capture, threads, plot)
    from kissgs.cli import bench_curves

    output = bench_curves.finetuning(
        inputs,
        preset=preset,
        changes=changes,
        quality_offsets=quality_offsets or [],
        ratios=ratios or [],
        supervision=supervision,
    )
    report(output, as_json, plot)


@app.command()
def rendering(
    scenes: FilesArgument,
    counts: Annotated[
        list[int] | None,
        typer.Option(
            "--gaussians",
            min=1,
            help="Measure the scene resampled to this number of Gaussians; repeatable. Default: the scene as it is.",
        ),
    ] = None,
    views: ViewsOption = None,
    scale: ScaleOption = None,
    images: ImagesOption = None,
    resolution: ResolutionOption = None,
    threads: ThreadsOption = 0,
    as_json: JsonOption = False,
) -> None:
    """Measure CPU times of the rasteriser: forward, backward, loss, Adam and removal scores."""
    capture = open_views(views, scale=scale, images=images, resolution=resolution)
    inputs = open_inputs(scenes, capture, threads)
    from kissgs.cli import bench_rendering

    report(bench_rendering.rendering(inputs, counts or []), as_json)


app.command()(capacity)
