"""``kissgs bench``: measurements of presets, external codecs, parts of the codec and the rasteriser."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Annotated

import typer

from kissgs.cli.arguments import FilesArgument, ImagesOption, ResolutionOption, ScaleOption, ViewsOption
from kissgs.cli.bench_scenes import BenchOptions, BenchOutput
from kissgs.cli.files import expand, print_json, show
from kissgs.cli.options import open_views
from kissgs.core.errors import UnsupportedError

app = typer.Typer(name="bench", help="Measure codecs, compaction, fine-tuning and rendering.", no_args_is_help=True)

PresetsOption = Annotated[list[str] | None, typer.Option("--preset", "-p", help="Preset to measure; repeatable.")]
PresetOption = Annotated[str, typer.Option("--preset", "-p", help="Preset to measure.")]
ChangesOption = Annotated[
    list[str] | None, typer.Option("--set", metavar="NAME=VALUE", help="Change a setting; repeatable.")
]
RepeatsOption = Annotated[
    int, typer.Option(min=1, max=1000, help="Number of runs per codec: times are medians, memory is the maximum.")
]
EvaluateOption = Annotated[bool, typer.Option("--evaluate", help="Compare rendered images too; implied by --views.")]
CountsOption = Annotated[
    list[int], typer.Option("--gaussians", min=1, help="Resample the scene to this number of Gaussians; repeatable.")
]
RatiosOption = Annotated[
    list[float] | None,
    typer.Option("--ratio", min=0, max=1, help="Share of the Gaussians to keep; repeatable."),
]
SupervisionOption = Annotated[
    str,
    typer.Option(
        metavar="WHAT",
        help="Train with the [bold]photos[/] of --views, with renderings by its [bold]cameras[/], or with virtual "
        "cameras of the [bold]scene[/] alone. The evaluation uses --views in any case.",
    ),
]
OffsetsOption = Annotated[
    list[float] | None, typer.Option("--quality-offset", min=-30, max=30, help="Quality offset, dB; repeatable.")
]
PlotOption = Annotated[
    Path | None, typer.Option(metavar="FILE", help="Plot the results of one scene as .svg, .png or .pdf.")
]
ThreadsOption = Annotated[int, typer.Option(min=0, help="Number of threads; 0 for one per processor.")]
JsonOption = Annotated[bool, typer.Option("--json", help="Print JSON.")]


@app.command()
def codecs(
    scenes: FilesArgument,
    presets: PresetsOption = None,
    changes: ChangesOption = None,
    external_codecs: Annotated[
        list[str] | None,
        typer.Option("--external", help="External codec to measure, sog or spz, by splat-transform; repeatable."),
    ] = None,
    splat_transform: Annotated[str, typer.Option(help="Command that starts splat-transform.")] = "splat-transform",
    sog_iterations: Annotated[
        int | None,
        typer.Option(min=1, help="K-means iterations over the SH of .sog; each takes minutes without a GPU."),
    ] = None,
    repeats: RepeatsOption = 1,
    evaluate: EvaluateOption = False,
    quality_offsets: OffsetsOption = None,
    plot: PlotOption = None,
    views: ViewsOption = None,
    scale: ScaleOption = None,
    images: ImagesOption = None,
    resolution: ResolutionOption = None,
    threads: ThreadsOption = 0,
    as_json: JsonOption = False,
) -> None:
    """Measure bytes, time, memory and errors of presets and external codecs, each in a separate process.

    Without --preset, all presets are measured, and --quality-offset applies to balanced. --quality-offset and --plot
    imply --evaluate.
    """
    options = BenchOptions(
        scenes=_paths(scenes),
        presets=presets or [],
        changes=changes,
        external_codecs=external_codecs or [],
        splat_transform=splat_transform,
        sog_iterations=sog_iterations,
        repeats=repeats,
        evaluate=evaluate,
        quality_offsets=quality_offsets or [],
        plot=plot,
        views=open_views(views, scale=scale, images=images, resolution=resolution),
        threads=threads,
    )
    _check_plot(options)
    from kissgs.cli.bench_comparison import comparison

    _print(comparison(options), plot, as_json)


@app.command()
def scaling(
    scenes: FilesArgument,
    gaussians: CountsOption,
    presets: PresetsOption = None,
    changes: ChangesOption = None,
    repeats: RepeatsOption = 1,
    evaluate: EvaluateOption = False,
    plot: PlotOption = None,
    views: ViewsOption = None,
    scale: ScaleOption = None,
    images: ImagesOption = None,
    resolution: ResolutionOption = None,
    threads: ThreadsOption = 0,
    as_json: JsonOption = False,
) -> None:
    """Measure presets on a scene resampled to several numbers of Gaussians."""
    options = BenchOptions(
        scenes=_paths(scenes),
        presets=presets or [],
        changes=changes,
        repeats=repeats,
        evaluate=evaluate,
        plot=plot,
        gaussians=gaussians,
        views=open_views(views, scale=scale, images=images, resolution=resolution),
        threads=threads,
    )
    _check_plot(options)
    from kissgs.cli.bench_comparison import comparison

    _print(comparison(options), plot, as_json)


@app.command()
def ablation(
    scenes: FilesArgument,
    presets: PresetsOption = None,
    changes: ChangesOption = None,
    views: ViewsOption = None,
    scale: ScaleOption = None,
    images: ImagesOption = None,
    resolution: ResolutionOption = None,
    threads: ThreadsOption = 0,
    as_json: JsonOption = False,
) -> None:
    """Measure paper and balanced, or the presets of --preset, with one part of the codec left out at a time."""
    from kissgs.cli import bench_comparison

    options = BenchOptions(
        scenes=_paths(scenes),
        presets=presets or [],
        changes=changes,
        views=open_views(views, scale=scale, images=images, resolution=resolution),
        threads=threads,
    )
    _print(bench_comparison.ablation(options), None, as_json)


@app.command()
def compaction(
    scenes: FilesArgument,
    preset: PresetOption = "balanced",
    changes: ChangesOption = None,
    ratios: RatiosOption = None,
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
    """Compare strategies of compaction, with the training of a preset."""
    options = BenchOptions(
        scenes=_paths(scenes),
        presets=[preset],
        changes=changes,
        ratios=ratios or [],
        strategies=strategies or [],
        supervision=supervision,
        plot=plot,
        views=open_views(views, scale=scale, images=images, resolution=resolution),
        threads=threads,
    )
    _check_plot(options)
    from kissgs.cli import bench_curves

    _print(bench_curves.compaction(options), plot, as_json)


@app.command()
def finetuning(
    scenes: FilesArgument,
    preset: PresetOption = "balanced",
    changes: ChangesOption = None,
    quality_offsets: OffsetsOption = None,
    ratios: RatiosOption = None,
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
    options = BenchOptions(
        scenes=_paths(scenes),
        presets=[preset],
        changes=changes,
        quality_offsets=quality_offsets or [],
        ratios=ratios or [],
        supervision=supervision,
        plot=plot,
        views=open_views(views, scale=scale, images=images, resolution=resolution),
        threads=threads,
    )
    _check_plot(options)
    from kissgs.cli import bench_curves

    _print(bench_curves.finetuning(options), plot, as_json)


@app.command()
def rendering(
    scenes: FilesArgument,
    gaussians: Annotated[
        list[int] | None,
        typer.Option(min=1, help="Resample the scene to this number of Gaussians; repeatable. Default: all."),
    ] = None,
    views: ViewsOption = None,
    scale: ScaleOption = None,
    images: ImagesOption = None,
    resolution: ResolutionOption = None,
    threads: ThreadsOption = 0,
    as_json: JsonOption = False,
) -> None:
    """Measure the rasteriser: forward, backward, loss, Adam and removal scores."""
    from kissgs.cli import bench_comparison

    options = BenchOptions(
        scenes=_paths(scenes),
        gaussians=gaussians or [],
        views=open_views(views, scale=scale, images=images, resolution=resolution),
        threads=threads,
    )
    _print(bench_comparison.rendering(options), None, as_json)


def _paths(scenes: list[str]) -> list[Path]:
    return list(dict.fromkeys(map(Path, expand(scenes))))


def _check_plot(options: BenchOptions) -> None:
    """Refuse a plot that cannot be made, before a long measurement."""
    if options.plot is not None:
        from kissgs.benchmark.plots import check_plot

        if len(options.scenes) > 1:
            raise UnsupportedError("--plot takes one scene; give one FILE")
        check_plot(options.plot)


def _print(output: BenchOutput, plot: Path | None, as_json: bool) -> None:
    """Print and plot the results; exit status 2 if a part failed."""
    try:  # results that took long are plotted even if they cannot be printed
        if as_json:
            print_json(output.rows)
        elif output.rows:
            show(output.table)
    finally:
        if plot is not None and output.draw is not None:
            output.draw(plot)
    for failure in output.failures:
        sys.stderr.write(f"kissgs: {failure}\n")
    if output.failures:
        raise typer.Exit(2)
