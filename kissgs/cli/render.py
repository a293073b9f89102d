"""``kissgs render``: pictures of a scene. ``kissgs.cli.app`` registers it; heavy imports wait until it runs."""

from __future__ import annotations

import re
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from kissgs.cli.arguments import (
    ForceOption,
    ImagesOption,
    QuietOption,
    RenderDeviceOption,
    RenderThreadsOption,
    ResolutionOption,
    ScaleOption,
    ViewsOption,
)
from kissgs.cli.files import each, is_folder, show, write_stdout
from kissgs.cli.options import device_of, open_views
from kissgs.core.errors import UnsupportedError

if TYPE_CHECKING:
    from kissgs.cameras.render import RenderedImages

FPS, QUALITY = 12, 85
COLOURS = {"black": "#000000", "white": "#ffffff"}

OutputOption = Annotated[
    Path | None,
    typer.Option(
        "--output", "-o", help="NAME.png, NAME.webp, a folder, or '-' for PNG; by default a .png beside the scene."
    ),
]
ViewOption = Annotated[
    str | None,
    typer.Option(
        "--view",
        metavar="N|NAME|FILE.json",
        help="From where: a view of --views, else a virtual one, by its name, or by its number from 0 in the order of "
        "names; or a camera that --save-camera wrote; or FILE.json:N or FILE.json:NAME of the cameras.json that 3DGS "
        "writes. By default the first view of --views, else the best virtual one.",
    ),
]
OrbitOption = Annotated[
    bool,
    typer.Option(
        "--orbit",
        help="Go around the scene, or to and fro where only one side was captured. "
        "As .webp a film that repeats, as .png a sheet of pictures.",
    ),
]
SheetOption = Annotated[
    bool, typer.Option("--sheet", help="All views of --views, else the virtual ones, on one sheet with their names.")
]
SizeOption = Annotated[
    str | None,
    typer.Option(
        metavar="WxH",
        help="Pixels of a picture; with --orbit or --sheet of each. By default those of the camera, else 1280x960; "
        "640x480 in a film, 320x240 on a sheet.",
    ),
]
BackgroundOption = Annotated[
    str | None,
    typer.Option(metavar="COLOUR", help="black, white or #rrggbb; by default that of --views, else black."),
]
FramesOption = Annotated[
    int | None, typer.Option(min=3, max=3600, help="Pictures of an --orbit; by default 48 in a film, 24 on a sheet.")
]
FpsOption = Annotated[int | None, typer.Option(min=1, max=60, help=f"Of a film; by default {FPS}.")]
QualityOption = Annotated[
    int | None, typer.Option(min=0, max=100, help=f"Of .webp; 100 is lossless, the default is {QUALITY}.")
]
SaveCameraOption = Annotated[
    Path | None,
    typer.Option(metavar="FILE.json", help="Write the camera of the picture, for --view and other programs."),
]


def render(
    file: Annotated[str, typer.Argument(metavar="FILE", help="The scene: .ply or container.")],
    output: OutputOption = None,
    view: ViewOption = None,
    orbit: OrbitOption = False,
    sheet: SheetOption = False,
    size: SizeOption = None,
    background: BackgroundOption = None,
    frames: FramesOption = None,
    fps: FpsOption = None,
    quality: QualityOption = None,
    save_camera: SaveCameraOption = None,
    views: ViewsOption = None,
    scale: ScaleOption = None,
    images: ImagesOption = None,
    resolution: ResolutionOption = None,
    device: RenderDeviceOption = "cpu",
    threads: RenderThreadsOption = 0,
    force: ForceOption = False,
    as_json: Annotated[bool, typer.Option("--json", help="Print JSON: what was written, and the cameras.")] = False,
    quiet: QuietOption = False,
) -> None:
    """Take a picture of a scene, a film or a sheet of pictures around it, or a sheet of its views."""
    from kissgs.cameras.captures.camera_json import write_camera
    from kissgs.cameras.render import RenderJob
    from kissgs.cli.console import progress_bar
    from kissgs.io.atomic import refuse_existing
    from kissgs.pipeline.scene_files import load

    suffix = _suffix(file, output)
    film = orbit and suffix == ".webp"
    _refuse({"--view": view, "--orbit": orbit, "--sheet": sheet}, most=1, why="choose one")
    if view is not None and ".json" in view.lower():
        _refuse({"--views": views}, why=f"{view} is a camera already")
    if orbit:
        _refuse({"--views": views}, why="--orbit finds its own way around the scene")
    else:
        _refuse({"--frames": frames}, why="it is for --orbit")
    if orbit or sheet:
        _refuse({"--save-camera": save_camera}, why="it is for a single picture; --json tells all cameras")
    if not film:
        _refuse({"--fps": fps}, why="it is for films: --orbit -o NAME.webp")
    if suffix != ".webp":
        _refuse({"--quality": quality}, why="it is for .webp; a .png is lossless")
    asked, colour, where = _size(size), _colour(background), device_of(device)
    capture = open_views(views, scale=scale, images=images, resolution=resolution)

    def work(name: str, target: Path) -> dict[str, Any]:
        piped = str(target) == "-"
        for path in ([] if piped else [target]) + ([] if save_camera is None else [save_camera]):
            refuse_existing(path, overwrite=force)
        with progress_bar(quiet or as_json) as progress:
            photographer = RenderJob(
                splats=load(Path(name), threads=threads, progress=progress),
                size=asked,
                background=colour,
                device=where,
                threads=threads,
                progress=progress,
            )
            if orbit:
                shots = photographer.film(frames) if film else photographer.strip(frames)
            else:
                shots = photographer.sheet(capture) if sheet else photographer.single(capture, view)
            progress("write", 0.0)
            data = _encoded(shots, suffix, FPS if fps is None else fps, QUALITY if quality is None else quality)
            progress("write", 1.0)
        _deliver(data, target, force=force)
        if save_camera is not None:
            write_camera(save_camera, shots.views[0].camera, overwrite=force)
        report = _report(shots, len(data))
        if not (quiet or as_json or piped):
            saved = "" if save_camera is None else f"; {save_camera}"
            show(f"{target}  {report['width']}x{report['height']}, {shots.what}{saved}")
        return report

    each([file], output, suffix, as_json, work)


def _deliver(data: bytes, target: Path, *, force: bool) -> None:
    from kissgs.io.atomic import atomic_file

    if str(target) == "-":
        write_stdout(data)
        return
    with atomic_file(target, overwrite=force) as file:
        file.write(data)


def _suffix(file: str, output: Path | None) -> str:
    """Of what will be written: .png unless .webp is asked for."""
    if file == "-":
        raise UnsupportedError("render reads a file, not standard input")
    if output is None or is_folder(output) or str(output) == "-" or not output.suffix:
        return ".png"
    if output.suffix.lower() not in (".png", ".webp"):
        raise UnsupportedError(f"{output}: pictures are written as .png or .webp")
    return output.suffix.lower()


def _refuse(options: dict[str, object], *, why: str, most: int = 0) -> None:
    """Raise if more than so many of these are given."""
    given = [name for name, value in options.items() if value is not None and value is not False]
    if len(given) > most:
        raise UnsupportedError(f"{' and '.join(given)}: {why}" if most else f"leave out {given[0]}: {why}")


def _size(text: str | None) -> tuple[int, int] | None:
    if text is None:
        return None
    found = re.fullmatch(r"([1-9]\d{0,5})[xX×]([1-9]\d{0,5})", text.strip(), re.ASCII)
    if found is None:
        raise UnsupportedError(f"--size {text}: write WIDTHxHEIGHT in pixels, such as 1280x960")
    return int(found[1]), int(found[2])


def _colour(text: str | None) -> tuple[float, float, float] | None:
    if text is None:
        return None
    found = re.fullmatch(r"#([0-9a-f]{2})([0-9a-f]{2})([0-9a-f]{2})", COLOURS.get(text.lower(), text.lower()))
    if found is None:
        raise UnsupportedError(f"--background {text}: write black, white or #rrggbb, such as '#87ceeb'")
    red, green, blue = (int(value, 16) / 255 for value in found.groups())
    return red, green, blue


def _encoded(shots: RenderedImages, suffix: str, fps: int, quality: int) -> bytes:
    from kissgs.rendering.images import film, png

    return png(shots.pictures[0]) if suffix == ".png" else film(shots.pictures, fps=fps, quality=quality)


def _report(shots: RenderedImages, size: int) -> dict[str, Any]:
    from kissgs.cameras.captures.camera_json import camera_as_dict

    height, width = shots.pictures[0].shape[:2]
    cameras = [{"name": view.name, **camera_as_dict(view.camera)} for view in shots.views]
    return {"width": width, "height": height, "frames": len(shots.pictures), "bytes": size, "cameras": cameras}
