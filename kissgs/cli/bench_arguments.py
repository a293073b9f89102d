"""Options that several commands of ``kissgs bench`` share, as typer types."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

PresetsOption = Annotated[
    list[str] | None, typer.Option("--preset", "-p", help="Preset to measure; repeatable. Default: all.")
]
SetAllOption = Annotated[
    list[str] | None,
    typer.Option("--set", metavar="NAME=VALUE", help="Change a setting of all these presets; repeatable."),
]
ExternalCodecsOption = Annotated[
    list[str] | None,
    typer.Option("--external", help="External codec to measure, sog or spz, by splat-transform; repeatable."),
]
SplatTransformOption = Annotated[str, typer.Option(help="Command that starts splat-transform.")]
SogIterationsOption = Annotated[
    int | None,
    typer.Option(min=1, help="K-means iterations over the SH of .sog; each takes minutes without a GPU."),
]
RepeatsOption = Annotated[
    int, typer.Option(min=1, max=1000, help="Number of runs per codec: times are medians, memory is the maximum.")
]
SupervisionOption = Annotated[
    str,
    typer.Option(
        metavar="WHAT",
        help="Train with the [bold]photos[/] of --views, with renderings by its [bold]cameras[/], or with virtual "
        "cameras of the [bold]scene[/] alone. The evaluation uses --views in any case.",
    ),
]
PlotOption = Annotated[
    Path | None, typer.Option(metavar="FILE", help="Plot the results of one scene as .svg, .png or .pdf.")
]
ThreadsOption = Annotated[int, typer.Option(min=0, help="Number of threads; 0 for one per processor.")]
JsonOption = Annotated[bool, typer.Option("--json", help="Print JSON.")]
