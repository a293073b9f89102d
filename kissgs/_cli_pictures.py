"""Commands that take pictures. ``kissgs._cli`` registers them; heavy imports wait until one of them runs."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, cast, get_args

import typer

from kissgs._cli_files import print_json, show
from kissgs.errors import UnsupportedError

if TYPE_CHECKING:
    from kissgs.views.view import Views

ViewsOption = Annotated[
    Path | None,
    typer.Option(
        "--views",
        metavar="DATA",
        help="Cameras, and photographs if there are any: a folder with a COLMAP model or transforms.json. "
        "By default kissgs places cameras itself.",
    ),
]
ScaleOption = Annotated[
    int | None, typer.Option(min=1, help="Take the photographs from the folder of this scale: 4 for images_4.")
]
ImagesOption = Annotated[Path | None, typer.Option(help="Take the photographs from this folder.")]
ResolutionOption = Annotated[
    int | None, typer.Option(min=1, help="Largest longer side of a picture, pixels; by default 1600.")
]
SplitOption = Annotated[
    str, typer.Option(help="[bold]test[/] (held-out views), [bold]train[/] or [bold]all[/].", show_default=True)
]
DeviceOption = Annotated[str, typer.Option(help="Renders: [bold]cpu[/] or [bold]cuda[/].")]
ThreadsOption = Annotated[int, typer.Option(min=0, help="0: one per processor. The pictures do not depend on it.")]
ForceOption = Annotated[bool, typer.Option("--force", "-f", help="Overwrite files that exist.")]
QuietOption = Annotated[bool, typer.Option("--quiet", "-q", help="Print nothing but errors.")]


def evaluate(
    reference: Annotated[Path, typer.Argument(metavar="REFERENCE", help="The scene as it was: .ply or container.")],
    candidate: Annotated[Path, typer.Argument(metavar="CANDIDATE", help="What became of it: .ply or container.")],
    views: ViewsOption = None,
    scale: ScaleOption = None,
    images: ImagesOption = None,
    resolution: ResolutionOption = None,
    split: SplitOption = "test",
    seed: Annotated[int, typer.Option(min=0, help="Of the cameras that are drawn: another seed draws others.")] = 0,
    lpips: Annotated[bool, typer.Option("--lpips", help="Measure LPIPS too; needs kissgs\\[lpips].")] = False,
    html: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Write a page with pictures of both, and where they differ.")
    ] = None,
    device: DeviceOption = "cpu",
    threads: ThreadsOption = 0,
    force: ForceOption = False,
    as_json: Annotated[bool, typer.Option("--json", help="Print JSON.")] = False,
    quiet: QuietOption = False,
) -> None:
    """Compare a scene's pictures with those of its original, and with photographs: PSNR and SSIM."""
    from kissgs._console import progress_bar
    from kissgs.evaluation.html import Side, html_report
    from kissgs.evaluation.likeness import Split
    from kissgs.evaluation.pictures import evaluate as measure
    from kissgs.io.atomic import atomic_file, refuse_existing
    from kissgs.scenes import load, stored_bytes

    used = cast(Split, choice("--split", split, Split))
    where = device_of(device)
    if html is not None:
        refuse_existing(html, overwrite=force)
    capture = open_views(views, scale=scale, images=images, resolution=resolution)
    with progress_bar(quiet or as_json) as progress:
        sides = [
            Side(name=path.name, splats=load(path, threads=threads, progress=progress), bytes=stored_bytes(path))
            for path in (reference, candidate)
        ]
        scenes = sides[0].splats, sides[1].splats
        result = measure(
            *scenes,
            capture,
            split=used,
            seed=seed,
            lpips=lpips,
            device=where,
            threads=threads,
            progress=progress,
        )
        if html is not None:
            page = html_report(result, sides[0], sides[1], device=where, threads=threads, progress=progress)
            with atomic_file(html, overwrite=force) as file:
                file.write(page.encode(errors="replace"))  # file names may be no text
    sizes = {"reference": sides[0].bytes, "candidate": sides[1].bytes}
    if as_json:
        print_json({**result.as_dict(), "bytes": sizes})
    elif not quiet:
        from kissgs._picture_tables import evaluation_table

        show(evaluation_table(result, sides[0], sides[1], asked=split))
        if html is not None:
            show(f"\npictures  {html}")


def open_views(
    path: Path | None, *, scale: int | None = None, images: Path | None = None, resolution: int | None = None
) -> Views | None:
    """The capture at ``path``; None where none is given, and then nothing may be said about its photographs."""
    if path is None:
        for name, value in (("--scale", scale), ("--images", images), ("--resolution", resolution)):
            if value is not None:
                raise UnsupportedError(f"{name} is about the photographs of a capture; say which with --views")
        return None
    from kissgs.views.load import load_views

    return load_views(path, scale=scale, images=images, resolution=resolution)


def device_of(name: str) -> Literal["cpu", "cuda"]:
    """The value of ``--device``, if it is one."""
    return cast(Literal["cpu", "cuda"], choice("--device", name, Literal["cpu", "cuda"]))


def choice(option: str, value: str, allowed: Any) -> str:  # noqa: ANN401  a Literal has no type of its own
    """The value of an option that is one of ``allowed``, a Literal."""
    names = get_args(allowed)
    if value not in names:
        raise UnsupportedError(f"{option} {value}: choose {', '.join(names[:-1])} or {names[-1]}")
    return value
