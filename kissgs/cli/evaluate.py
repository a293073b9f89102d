"""``kissgs evaluate``: compare a scene with its original, and with photographs."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

from typer import Argument, Option

from kissgs.cli.files import print_json, progress_bar, say_notes, show
from kissgs.cli.options import CaptureOptions, ForceOption, SceneOptions, one_of, with_option_groups

if TYPE_CHECKING:
    from kissgs.core.context import Progress
    from kissgs.evaluation.html import ReportScene

Split = Literal["test", "train", "all"]


@with_option_groups
def evaluate(
    reference: Annotated[Path, Argument(metavar="REFERENCE", help="Original scene, of any format that kissgs reads.")],
    candidate: Annotated[
        Path, Argument(metavar="CANDIDATE", help="Scene to evaluate, of any format that kissgs reads.")
    ],
    *,
    capture: CaptureOptions,
    split: Annotated[
        Split,
        Option(
            metavar="NAME",
            parser=one_of("--split", "test", "train", "all"),
            help="Views of --views to use: test (held-out), train or all.",
        ),
    ] = "test",
    seed: Annotated[int, Option(min=0, help="Seed of the virtual cameras.")] = 0,
    distance: Annotated[
        float, Option(metavar="FACTOR", help="Move the virtual cameras to this many times their distance, such as 4.")
    ] = 1.0,
    flip: Annotated[bool, Option("--flip", help="Also measure FLIP; needs the extra kissgs\\[flip].")] = False,
    lpips: Annotated[bool, Option("--lpips", help="Also measure LPIPS; needs the extra kissgs\\[lpips].")] = False,
    html: Annotated[
        Path | None, Option(metavar="FILE", help="Write an HTML report with renderings of both scenes and error maps.")
    ] = None,
    force: ForceOption = False,
    as_json: Annotated[bool, Option("--json", help="Print a JSON report.")] = False,
    common: SceneOptions,
) -> None:
    """Compare the renderings of a scene with those of its original, and with photographs: PSNR, SSIM and MS-SSIM."""
    from kissgs.cli.tables import evaluation_table
    from kissgs.core.context import Context
    from kissgs.core.positions import with_origin
    from kissgs.evaluation.evaluate import evaluate as measure
    from kissgs.evaluation.html import html_report
    from kissgs.io.files import atomic_file, refuse_existing

    quiet, threads = common.quiet or as_json, common.threads
    if html is not None:
        refuse_existing(html, overwrite=force)
    views = capture.open(reference)
    with progress_bar(quiet, [("read", 1.0), ("cameras", 2.0), ("evaluate", 5.0), ("html", 2.0)]) as progress:
        sides = _sides_of((reference, candidate), common, progress)
        sides[1] = replace(sides[1], splats=with_origin(sides[1].splats, sides[0].splats.origin))
        result = measure(
            sides[0].splats,
            sides[1].splats,
            views,
            split=split,
            seed=seed,
            distance=distance,
            flip=flip,
            lpips=lpips,
            device=capture.device,
            threads=threads,
            progress=progress,
        )
        if html is not None:
            page = html_report(result, sides[0], sides[1], Context(threads, capture.device, progress))
            with atomic_file(html, overwrite=force) as file:
                file.write(page.encode(errors="replace"))  # file names may be invalid UTF-8
    for side in sides:
        say_notes(side.name, side.splats.notes, common.quiet)
    if sides[0].splats.antialiased != sides[1].splats.antialiased and not common.quiet:
        marked, other = sides if sides[0].splats.antialiased else sides[::-1]
        sys.stderr.write(
            f"kissgs: {marked.name} is marked as trained with antialiasing, and {other.name} is not; each is drawn so "
            "(for both: --antialiased or --classic)\n"
        )
    sizes = {"reference": sides[0].bytes, "candidate": sides[1].bytes}
    if as_json:
        print_json({**result.as_dict(), "bytes": sizes})
    elif not quiet:
        show(evaluation_table(result, sides[0], sides[1], asked=split))
        if html is not None:
            show(f"\nreport  {html}")


def _sides_of(paths: Sequence[Path], common: SceneOptions, progress: Progress) -> list[ReportScene]:
    """Read the scenes to compare; the level of detail concerns those that have levels, which one of them must."""
    from kissgs.evaluation.html import ReportScene
    from kissgs.pipeline.scene_files import has_levels, load, stored_bytes

    streamed = [path for path in paths if has_levels(path)]
    sides = []
    for path in paths:
        reading = asdict(common.reading())
        if streamed and path not in streamed:
            reading["level"] = 0
        splats = load(path, threads=common.threads, progress=progress, **reading)
        sides.append(ReportScene(name=path.name, splats=splats, bytes=stored_bytes(path)))
    return sides
