"""``kissgs bench``: presets and other tools measured on the user's scenes, and what pictures of them cost."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from kissgs.cli.arguments import ImagesOption, ResolutionOption, ScaleOption, ViewsOption
from kissgs.cli.bench_scenes import Asked
from kissgs.cli.files import expand, print_json, show
from kissgs.cli.options import open_views
from kissgs.core.errors import UnsupportedError

if TYPE_CHECKING:
    from collections.abc import Mapping

GOES_WITH = {
    "--preset": ("", "--ablate", "--compaction", "--finetuning"),
    "--set": ("", "--ablate", "--compaction", "--finetuning"),
    "--peer": ("",),
    "--sog-iterations": ("",),
    "--repeats": ("",),
    "--pictures": ("",),
    "--quality-offset": ("", "--finetuning"),
    "--ratio": ("--compaction", "--finetuning"),
    "--way": ("--compaction",),
    "--learn-from": ("--compaction", "--finetuning"),
    "--plot": ("", "--compaction", "--finetuning"),
    "--gaussians": ("", "--rendering"),
}
"""Options that not all measurements have; "" is the one that none of the others asks for."""

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
    repeats: Annotated[
        int, typer.Option(min=1, max=1000, help="Measure each preset so often: medians of times, the most of memory.")
    ] = 1,
    pictures: Annotated[
        bool, typer.Option("--pictures", help="Compare pictures too; implied by --views, --quality-offset and --plot.")
    ] = False,
    ablate: Annotated[
        bool,
        typer.Option("--ablate", help="Measure what each part of paper and balanced is worth instead: leave one out."),
    ] = False,
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
        typer.Option(
            "--quality-offset",
            min=-30,
            max=30,
            help="Measure balanced, or the presets that are named, at this one too. Repeat for a curve.",
        ),
    ] = None,
    ratios: Annotated[
        list[float] | None,
        typer.Option(
            "--ratio",
            min=0,
            max=1,
            help="With --compaction, --finetuning: keep this share. Repeat for several.",
        ),
    ] = None,
    ways: Annotated[
        list[str] | None, typer.Option("--way", help="With --compaction: only this way. Repeat for several.")
    ] = None,
    learn_from: Annotated[
        str,
        typer.Option(
            metavar="WHAT",
            help="With --compaction and --finetuning: from the [bold]photos[/] of --views, from its [bold]cameras[/] "
            "alone, or from the [bold]scene[/] alone. --views judges in any case.",
        ),
    ] = "photos",
    plot: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="Draw what was measured of one scene, as .svg, .png or .pdf."),
    ] = None,
    gaussians: Annotated[
        list[int] | None,
        typer.Option(min=1, help="Resample the scene to so many, to see how times grow. Repeat for several."),
    ] = None,
    views: ViewsOption = None,
    scale: ScaleOption = None,
    images: ImagesOption = None,
    resolution: ResolutionOption = None,
    threads: ThreadsOption = 0,
    as_json: Annotated[bool, typer.Option("--json", help="Print JSON.")] = False,
) -> None:
    """Measure bytes, time, memory and errors of presets and of other tools, each in a process of its own."""
    studies = {"--ablate": ablate, "--compaction": compaction, "--finetuning": finetuning, "--rendering": rendering}
    given = {
        "--preset": presets,
        "--set": changes,
        "--peer": peers,
        "--sog-iterations": sog_iterations,
        "--repeats": repeats > 1,
        "--pictures": pictures,
        "--quality-offset": fidelities,
        "--ratio": ratios,
        "--way": ways,
        "--learn-from": learn_from != "photos",
        "--plot": plot,
        "--gaussians": gaussians,
    }
    study = _only_one([name for name, wanted in studies.items() if wanted])
    _check_options(study, given)
    if study in ("--compaction", "--finetuning") and len(presets or []) > 1:
        raise UnsupportedError(f"{study} goes with one --preset")
    capture = open_views(views, scale=scale, images=images, resolution=resolution)
    asked = Asked(
        scenes=list(dict.fromkeys(map(Path, expand(scenes)))),
        presets=presets or [],
        changes=changes,
        peers=peers or [],
        splat_transform=splat_transform,
        sog_iterations=sog_iterations,
        repeats=repeats,
        pictures=pictures,
        fidelities=fidelities or [],
        ratios=ratios or [],
        ways=ways or [],
        learn_from=learn_from,
        plot=plot,
        gaussians=gaussians or [],
        views=capture,
        threads=threads,
    )
    _measure(study, asked, as_json)


def _measure(study: str, asked: Asked, as_json: bool) -> None:
    from kissgs.cli import bench_comparison, bench_curves

    if asked.plot is not None:  # before the work that it is to show
        from kissgs.benchmark.plots import check_plot

        if len(asked.scenes) > 1:
            raise UnsupportedError("--plot draws one scene; name one")
        check_plot(asked.plot)
    measure = {
        "": bench_comparison.comparison,
        "--ablate": bench_comparison.ablation,
        "--compaction": bench_curves.compaction,
        "--finetuning": bench_curves.finetuning,
        "--rendering": bench_comparison.rendering,
    }[study]
    outcome = measure(asked)
    try:  # what has taken long to find is told where one can be written to, and drawn where the other can
        if as_json:
            print_json(outcome.rows)
        elif outcome.rows:
            show(outcome.table)
    finally:
        if asked.plot is not None and outcome.draw is not None:
            outcome.draw(asked.plot)
    for failure in outcome.failures:
        sys.stderr.write(f"kissgs: {failure}\n")
    if outcome.failures:
        raise typer.Exit(2)


def _only_one(studies: list[str]) -> str:
    if len(studies) > 1:
        raise UnsupportedError(f"{' and '.join(studies)} are several measurements; make one after the other")
    return studies[0] if studies else ""


def _check_options(study: str, given: Mapping[str, object]) -> None:
    """Whether all that is given means something to this measurement."""
    if study == "--rendering" and (given["--preset"] or given["--peer"]):
        raise UnsupportedError("--rendering measures the rasteriser, no presets and no peers")
    for option, value in given.items():
        if value and study not in GOES_WITH[option]:
            others = " or ".join(filter(None, GOES_WITH[option]))
            raise UnsupportedError(f"{option} does not go with {study}" if study else f"{option} goes with {others}")
