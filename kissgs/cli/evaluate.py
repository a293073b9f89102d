"""``kissgs evaluate``: compare a scene with its original, and with photographs."""

from __future__ import annotations

import sys
from dataclasses import asdict, replace
from pathlib import Path
from typing import Annotated, cast

import typer

from kissgs.cli.files import print_json, say_notes, show
from kissgs.cli.options import (
    ForceOption,
    ImagesOption,
    RenderDeviceOption,
    ScaleOption,
    SceneOptions,
    SplitOption,
    ViewsOption,
    choice,
    device_of,
    open_views,
    reads_scenes,
)


@reads_scenes
def evaluate(
    reference: Annotated[
        Path, typer.Argument(metavar="REFERENCE", help="Original scene, of any format that kissgs reads.")
    ],
    candidate: Annotated[
        Path, typer.Argument(metavar="CANDIDATE", help="Scene to evaluate, of any format that kissgs reads.")
    ],
    views: ViewsOption = None,
    scale: ScaleOption = None,
    images: ImagesOption = None,
    split: SplitOption = "test",
    seed: Annotated[int, typer.Option(min=0, help="Seed of the virtual cameras.")] = 0,
    distance: Annotated[
        float,
        typer.Option(metavar="FACTOR", help="Move the virtual cameras to this many times their distance, such as 4."),
    ] = 1.0,
    flip: Annotated[bool, typer.Option("--flip", help="Also measure FLIP; needs the extra kissgs\\[flip].")] = False,
    lpips: Annotated[
        bool, typer.Option("--lpips", help="Also measure LPIPS; needs the extra kissgs\\[lpips].")
    ] = False,
    html: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="Write an HTML report with renderings of both scenes and error maps."),
    ] = None,
    device: RenderDeviceOption = "cpu",
    force: ForceOption = False,
    as_json: Annotated[bool, typer.Option("--json", help="Print a JSON report.")] = False,
    *,
    common: SceneOptions,
) -> None:
    """Compare the renderings of a scene with those of its original, and with photographs: PSNR, SSIM and MS-SSIM."""
    from kissgs.cli.console import progress_bar
    from kissgs.core.origin import with_origin
    from kissgs.evaluation.evaluate import evaluate as measure
    from kissgs.evaluation.html import ReportScene, html_report
    from kissgs.evaluation.results import Split
    from kissgs.io.files import atomic_file, refuse_existing
    from kissgs.pipeline.scene_files import load, stored_bytes

    quiet, threads = common.quiet or as_json, common.threads
    used_split = cast(Split, choice("--split", split, Split))
    render_device = device_of(device)
    if html is not None:
        refuse_existing(html, overwrite=force)
    capture = open_views(views, scale=scale, images=images)
    with progress_bar(quiet) as progress:
        reading = asdict(common.reading())
        sides = [
            ReportScene(
                name=path.name,
                splats=load(path, threads=threads, progress=progress, **reading),
                bytes=stored_bytes(path),
            )
            for path in (reference, candidate)
        ]
        sides[1] = replace(sides[1], splats=with_origin(sides[1].splats, sides[0].splats.origin))
        scenes = sides[0].splats, sides[1].splats
        result = measure(
            *scenes,
            capture,
            split=used_split,
            seed=seed,
            distance=distance,
            flip=flip,
            lpips=lpips,
            device=render_device,
            threads=threads,
            progress=progress,
        )
        if html is not None:
            page = html_report(result, sides[0], sides[1], device=render_device, threads=threads, progress=progress)
            with atomic_file(html, overwrite=force) as file:
                file.write(page.encode(errors="replace"))  # file names may be invalid UTF-8
    for side in sides:
        say_notes(side.name, side.splats.notes, common.quiet)
    if scenes[0].antialiased != scenes[1].antialiased and not common.quiet:
        marked, other = sides if scenes[0].antialiased else sides[::-1]
        sys.stderr.write(
            f"kissgs: {marked.name} is marked as trained with antialiasing, and {other.name} is not; each is drawn so "
            "(for both: --antialiased or --classic)\n"
        )
    sizes = {"reference": sides[0].bytes, "candidate": sides[1].bytes}
    if as_json:
        print_json({**result.as_dict(), "bytes": sizes})
    elif not quiet:
        from kissgs.cli.tables import evaluation_table

        show(evaluation_table(result, sides[0], sides[1], asked=split))
        if html is not None:
            show(f"\nreport  {html}")
