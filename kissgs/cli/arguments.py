"""Arguments and options that several commands share, as typer types."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

ScenesArgument = Annotated[
    list[str], typer.Argument(metavar="FILE…", help="Files or glob patterns; '-' reads standard input.")
]
FilesArgument = Annotated[list[str], typer.Argument(metavar="FILE…", help="Files or glob patterns.")]
ContainerOption = Annotated[
    str | None,
    typer.Option(
        metavar="NAME",
        help="Container: sogxt, or sog for other viewers. Default: sog if --output ends in .sog, else sogxt.",
    ),
]
PresetOption = Annotated[
    str, typer.Option("--preset", "-p", help="Trade-off of speed, size and quality: fast, balanced, small or paper.")
]
SetOption = Annotated[
    list[str] | None,
    typer.Option(
        "--set",
        metavar="NAME=VALUE",
        help="Change a setting of the preset; repeatable. List: docs/reference/settings.md.",
    ),
]
SeedOption = Annotated[int | None, typer.Option(help="Seed of all random choices; same seed, same result. Default: 0.")]
ForceOption = Annotated[bool, typer.Option("--force", "-f", help="Overwrite existing output files.")]
JsonOption = Annotated[
    bool, typer.Option("--json", help="Print a JSON report: an object for one file, a list for several.")
]
MaxGaussiansOption = Annotated[
    int | None,
    typer.Option(
        min=0,
        help="Refuse files with more Gaussians. Default: 20 million in compressed formats, whose files can declare far "
        "more than they hold.",
    ),
]
LevelOption = Annotated[
    int, typer.Option(min=0, help="Level of detail of a streamed scene; 0 is the finest.", show_default=True)
]
RawAxesOption = Annotated[
    bool,
    typer.Option(
        "--raw-axes",
        help="Take the axes of .spz as those of a .ply, as splat-transform writes and reads them. Default: y up.",
    ),
]
OriginOption = Annotated[
    str | None,
    typer.Option(
        metavar="auto",
        help="auto: make positions relative to the middle of the scene, where they have fine steps, and record it: for "
        "scenes far from the origin. Default: as in the file.",
    ),
]
AntialiasedOption = Annotated[
    bool | None,
    typer.Option(
        "--antialiased/--classic",
        help="Take the scene as trained with antialiasing, or as a classic one. Default: as the file is marked.",
    ),
]
QuietOption = Annotated[bool, typer.Option("--quiet", "-q", help="Print only errors.")]
ThreadsOption = Annotated[
    int, typer.Option(min=0, help="Number of threads; 0 for one per processor. The output does not depend on it.")
]
ViewsOption = Annotated[
    Path | None,
    typer.Option(
        "--views",
        metavar="DATA",
        help="Capture with cameras and optionally photographs: a folder with a COLMAP model or a transforms.json. "
        "Default: virtual cameras.",
    ),
]
ForceViewsOption = Annotated[
    bool, typer.Option("--force-views", help="Accept --views whose photographs do not show the scene.")
]
ScaleOption = Annotated[
    int | None,
    typer.Option(min=1, help="Downscaling factor of the photographs of --views: 4 reads the folder images_4."),
]
ImagesOption = Annotated[
    Path | None, typer.Option(help="Folder of the photographs of --views, if it is not the capture's own.")
]
ResolutionOption = Annotated[
    int | None, typer.Option(min=1, help="Limit of the longer side of the photographs, pixels. Default: 1600.")
]
SplitOption = Annotated[
    str, typer.Option(help="Views of --views to use: test (held-out), train or all.", show_default=True)
]
RenderDeviceOption = Annotated[str, typer.Option(help="Device of the rasteriser: cpu or cuda.")]
RenderThreadsOption = Annotated[
    int, typer.Option(min=0, help="Number of threads; 0 for one per processor. The images do not depend on it.")
]
PsnrOption = Annotated[
    float | None,
    typer.Option(metavar="DB", help="Find the smallest container with at least this PSNR to the scene's renderings."),
]
TargetSizeOption = Annotated[
    str | None,
    typer.Option(metavar="SIZE", help="Find the best container of at most this size, such as 800kB or 2.5MB."),
]
MaxPsnrDropOption = Annotated[
    float | None,
    typer.Option(metavar="DB", help="Find the smallest container that loses at most this PSNR, such as 0.1."),
]
MaxSsimDropOption = Annotated[
    float | None,
    typer.Option(
        metavar="SSIM",
        help="Find the smallest container that loses at most this SSIM, such as 0.003.",
    ),
]
TimeOption = Annotated[
    str | None,
    typer.Option(
        "--time",
        metavar="TIME",
        help="Time for each scene, such as 30s, 2min or 1h: the best that is found in it. With a goal, which comes "
        "first, it bounds the search. --evaluate takes longer.",
    ),
]
RayOption = Annotated[
    str | None,
    typer.Option(
        "--ray",
        metavar="[HOST:PORT]",
        help="Compress the scenes on the nodes of a Ray cluster: all machines must see scenes, outputs and --views at "
        "the same paths, on shared storage. Default address: RAY_ADDRESS, a cluster on this machine, or a new one that "
        "uses its processors. Needs the extra ray; docs/guide/many-machines.md.",
    ),
]
