"""Arguments and options that several commands share, as typer types."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

ScenesArgument = Annotated[
    list[str], typer.Argument(metavar="FILE…", help="Files or patterns; '-' reads standard input.")
]
FilesArgument = Annotated[list[str], typer.Argument(metavar="FILE…", help="Files or patterns.")]
PresetOption = Annotated[
    str, typer.Option("--preset", "-p", help="[bold]fast[/], [bold]balanced[/], [bold]small[/] or [bold]paper[/].")
]
SetOption = Annotated[
    list[str] | None,
    typer.Option("--set", metavar="NAME=VALUE", help="Change one setting of the preset; see docs/settings.md."),
]
SeedOption = Annotated[int | None, typer.Option(help="Seed of all random choices.")]
ForceOption = Annotated[bool, typer.Option("--force", "-f", help="Overwrite files that exist.")]
JsonOption = Annotated[bool, typer.Option("--json", help="Print JSON: an object for one file, a list for several.")]
QuietOption = Annotated[bool, typer.Option("--quiet", "-q", help="Print nothing but errors.")]
ThreadsOption = Annotated[int, typer.Option(min=0, help="0: one per processor. The bytes do not depend on it.")]
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
RenderDeviceOption = Annotated[str, typer.Option(help="Renders: [bold]cpu[/] or [bold]cuda[/].")]
RenderThreadsOption = Annotated[
    int, typer.Option(min=0, help="0: one per processor. The pictures do not depend on it.")
]
