"""``kissgs bench``: measurements of presets, external codecs, parts of the codec and the rasteriser."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from kissgs.cli.arguments import FilesArgument, ImagesOption, ResolutionOption, ScaleOption, ViewsOption
from kissgs.cli.bench_scenes import BenchOptions
from kissgs.cli.files import expand, print_json, show
from kissgs.cli.options import open_views
from kissgs.core.errors import UnsupportedError

if TYPE_CHECKING:
    from collections.abc import Mapping

VALID_WITH = {
    "--preset": ("", "--ablate", "--compaction", "--finetuning"),
    "--set": ("", "--ablate", "--compaction", "--finetuning"),
    "--external": ("",),
    "--sog-iterations": ("",),
    "--repeats": ("",),
    "--evaluate": ("",),
    "--quality-offset": ("", "--finetuning"),
    "--ratio": ("--compaction", "--finetuning"),
    "--strategy": ("--compaction",),
    "--supervision": ("--compaction", "--finetuning"),
    "--plot": ("", "--compaction", "--finetuning"),
    "--gaussians": ("", "--rendering"),
}
"""Measurements that an option applies to; "" is the measurement of codecs, made if no other is asked for."""

ThreadsOption = Annotated[int, typer.Option(min=0, help="Number of threads; 0 for one per processor.")]


def bench(
    scenes: FilesArgument,
    presets: Annotated[
        list[str] | None, typer.Option("--preset", "-p", help="Preset to measure; repeatable. Default: all.")
    ] = None,
    changes: Annotated[
        list[str] | None,
        typer.Option("--set", metavar="NAME=VALUE", help="Change a setting of all these presets; repeatable."),
    ] = None,
    external_codecs: Annotated[
        list[str] | None,
        typer.Option("--external", help="External codec to measure, sog or spz, by splat-transform; repeatable."),
    ] = None,
    splat_transform: Annotated[str, typer.Option(help="Command that starts splat-transform.")] = "splat-transform",
    sog_iterations: Annotated[
        int | None,
        typer.Option(min=1, help="K-means iterations over the SH of .sog; each takes minutes without a GPU."),
    ] = None,
    repeats: Annotated[
        int,
        typer.Option(min=1, max=1000, help="Number of runs per codec: times are medians, memory is the maximum."),
    ] = 1,
    evaluate: Annotated[
        bool,
        typer.Option(
            "--evaluate", help="Compare rendered images too; implied by --views, --quality-offset and --plot."
        ),
    ] = False,
    ablate: Annotated[
        bool,
        typer.Option("--ablate", help="Measure paper and balanced with one part of the codec left out at a time."),
    ] = False,
    rendering: Annotated[
        bool,
        typer.Option("--rendering", help="Measure the rasteriser: forward, backward, loss, Adam and removal scores."),
    ] = False,
    compaction: Annotated[
        bool,
        typer.Option("--compaction", help="Compare strategies of compaction, with the training of the preset."),
    ] = False,
    finetuning: Annotated[
        bool,
        typer.Option("--finetuning", help="Measure bytes and PSNR with and without fine-tuning."),
    ] = False,
    quality_offsets: Annotated[
        list[float] | None,
        typer.Option(
            "--quality-offset",
            min=-30,
            max=30,
            help="Measure balanced, or the presets of --preset, at this quality offset (dB) too; repeatable.",
        ),
    ] = None,
    ratios: Annotated[
        list[float] | None,
        typer.Option(
            "--ratio",
            min=0,
            max=1,
            help="With --compaction or --finetuning: share of the Gaussians to keep; repeatable.",
        ),
    ] = None,
    strategies: Annotated[
        list[str] | None,
        typer.Option("--strategy", help="With --compaction: strategy to measure; repeatable. Default: all."),
    ] = None,
    supervision: Annotated[
        str,
        typer.Option(
            metavar="WHAT",
            help="With --compaction or --finetuning: train with the [bold]photos[/] of --views, with renderings by its "
            "[bold]cameras[/], or with virtual cameras of the [bold]scene[/] alone. The evaluation uses --views in any "
            "case.",
        ),
    ] = "photos",
    plot: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="Plot the results of one scene as .svg, .png or .pdf."),
    ] = None,
    gaussians: Annotated[
        list[int] | None,
        typer.Option(min=1, help="Measure the scene resampled to this number of Gaussians; repeatable."),
    ] = None,
    views: ViewsOption = None,
    scale: ScaleOption = None,
    images: ImagesOption = None,
    resolution: ResolutionOption = None,
    threads: ThreadsOption = 0,
    as_json: Annotated[bool, typer.Option("--json", help="Print JSON.")] = False,
) -> None:
    """Measure bytes, time, memory and errors of presets and external codecs, each in a separate process."""
    measurements = {
        "--ablate": ablate,
        "--compaction": compaction,
        "--finetuning": finetuning,
        "--rendering": rendering,
    }
    given = {
        "--preset": presets,
        "--set": changes,
        "--external": external_codecs,
        "--sog-iterations": sog_iterations,
        "--repeats": repeats > 1,
        "--evaluate": evaluate,
        "--quality-offset": quality_offsets,
        "--ratio": ratios,
        "--strategy": strategies,
        "--supervision": supervision != "photos",
        "--plot": plot,
        "--gaussians": gaussians,
    }
    measurement = _only_one([name for name, wanted in measurements.items() if wanted])
    _check_options(measurement, given)
    if measurement in ("--compaction", "--finetuning") and len(presets or []) > 1:
        raise UnsupportedError(f"{measurement} measures one preset; give --preset once")
    capture = open_views(views, scale=scale, images=images, resolution=resolution)
    options = BenchOptions(
        scenes=list(dict.fromkeys(map(Path, expand(scenes)))),
        presets=presets or [],
        changes=changes,
        external_codecs=external_codecs or [],
        splat_transform=splat_transform,
        sog_iterations=sog_iterations,
        repeats=repeats,
        evaluate=evaluate,
        quality_offsets=quality_offsets or [],
        ratios=ratios or [],
        strategies=strategies or [],
        supervision=supervision,
        plot=plot,
        gaussians=gaussians or [],
        views=capture,
        threads=threads,
    )
    _measure(measurement, options, as_json)


def _measure(measurement: str, options: BenchOptions, as_json: bool) -> None:
    from kissgs.cli import bench_comparison, bench_curves

    if options.plot is not None:  # before a long measurement
        from kissgs.benchmark.plots import check_plot

        if len(options.scenes) > 1:
            raise UnsupportedError("--plot takes one scene; give one FILE")
        check_plot(options.plot)
    measure = {
        "": bench_comparison.comparison,
        "--ablate": bench_comparison.ablation,
        "--compaction": bench_curves.compaction,
        "--finetuning": bench_curves.finetuning,
        "--rendering": bench_comparison.rendering,
    }[measurement]
    output = measure(options)
    try:  # results that took long are plotted even if they cannot be printed
        if as_json:
            print_json(output.rows)
        elif output.rows:
            show(output.table)
    finally:
        if options.plot is not None and output.draw is not None:
            output.draw(options.plot)
    for failure in output.failures:
        sys.stderr.write(f"kissgs: {failure}\n")
    if output.failures:
        raise typer.Exit(2)


def _only_one(measurements: list[str]) -> str:
    if len(measurements) > 1:
        raise UnsupportedError(f"{' and '.join(measurements)} cannot be combined; run one at a time")
    return measurements[0] if measurements else ""


def _check_options(measurement: str, given: Mapping[str, object]) -> None:
    """Check that all given options apply to this measurement."""
    if measurement == "--rendering" and (given["--preset"] or given["--external"]):
        raise UnsupportedError("--rendering measures the rasteriser only; leave out --preset and --external")
    for option, value in given.items():
        if value and measurement not in VALID_WITH[option]:
            others = " or ".join(filter(None, VALID_WITH[option]))
            raise UnsupportedError(
                f"{option} does not apply to {measurement}; leave one of them out"
                if measurement
                else f"{option} needs {others}"
            )
