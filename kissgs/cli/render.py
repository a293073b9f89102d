"""``kissgs view`` and ``kissgs render``: a scene in a browser, and in images."""

from __future__ import annotations

import contextlib
import os
import re
import sys
import threading
import webbrowser
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from typer import Argument, Option

from kissgs.cli.files import Result, check_input, for_each_input, progress_bar, say_notes, show, source, write_output
from kissgs.cli.interrupts import Interrupted
from kissgs.cli.options import CaptureOptions, ForceOption, SceneOptions, output_option, with_option_groups
from kissgs.core.errors import InvalidSceneError, OutputError, UnsupportedError
from kissgs.formats import names_folder

if TYPE_CHECKING:
    from kissgs.preview import PageScene, StreamedFolder


# ``kissgs view``: show a scene in the browser, or write a page that shows it.


@with_option_groups
def view(
    scene: Annotated[
        str, Argument(metavar="FILE", help="Scene of any format, or a container; '-' reads standard input.")
    ],
    output: Annotated[
        Path | None,
        output_option(
            "Write one HTML file with viewer and scene, which opens from disk without a network, and exit.",
            metavar="PAGE.html",
        ),
    ] = None,
    port: Annotated[int, Option(min=0, max=65535, help="TCP port of the server; 0 for a free one.")] = 0,
    browser: Annotated[
        bool, Option("--browser/--no-browser", help="Whether to open the browser, or to print the address only.")
    ] = True,
    fetch: Annotated[
        bool, Option("--fetch-viewer", help="Download Spark and three.js first, if they are not installed.")
    ] = False,
    force: ForceOption = False,
    *,
    common: SceneOptions,
) -> None:
    """Show a scene in the browser, from a server on this machine that Ctrl-C ends; -o writes a page instead.

    Of a streamed scene it shows what the camera sees, as it comes near; with -o, the finest level of at most a million
    Gaussians; with --level, that level alone.
    """
    from kissgs.preview import fetch_viewer, page_files

    check_input(scene, InvalidSceneError)
    if fetch:
        fetch_viewer()
    page_files()  # before the work
    if output is None:
        _serve(scene, common, port, browser)
    elif port or not browser:
        raise UnsupportedError("--port and --no-browser are for the server, which -o does not start")
    else:
        _write(scene, common, output, force)


def _write(scene: str, common: SceneOptions, output: Path, force: bool) -> None:
    from kissgs.io.files import refuse_existing
    from kissgs.preview import fitting_level, page_container, standalone_page

    if output.suffix.lower() not in (".html", ".htm"):
        raise OutputError(f"{output!s:.100} is not the name of a page: end it in .html")
    refuse_existing(output, overwrite=force)
    content, chosen, reading = source(scene), "", common.reading()
    if common.level is None and (fitting := fitting_level(content, reading.max_gaussians)) is not None:
        reading = replace(reading, level=fitting[0])
        chosen = f", level {fitting[0]} of 0 to {fitting[1] - 1}"
    with progress_bar(common.quiet) as progress:
        container = page_container(content, reading, threads=common.threads, progress=progress)
    say_notes(scene, container.notes, common.quiet)
    page = standalone_page(container)
    write_output(output, page, force=force)
    if not common.quiet:
        made = f", compressed by the preset balanced to {len(container.data):,} bytes" if container.converted else ""
        show(f"{output}  {len(page):,} bytes, holds {container.name}{chosen}{made}")


def _serve(scene: str, common: SceneOptions, port: int, browser: bool) -> None:
    from kissgs.preview import PageServer

    with PageServer(_prepare(scene, common), port) as server, contextlib.suppress(Interrupted):
        sys.stdout.write(f"{server.url}  (Ctrl-C ends)\n")
        sys.stdout.flush()
        # Whether a browser with windows can open; one in the terminal would cover the address.
        windows = sys.platform in ("darwin", "win32") or os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")
        if browser and windows:
            threading.Thread(target=webbrowser.open, args=(server.url,), daemon=True).start()
        server.serve_forever()


def _prepare(scene: str, common: SceneOptions) -> PageScene | StreamedFolder:
    """Return what the server gets: a scene in memory, or the folder of a streamed one."""
    from kissgs.preview import page_scene, streamed_folder

    content = source(scene)
    folder = streamed_folder(content) if common.level is None and isinstance(content, Path) else None
    if folder is not None:
        if common.max_gaussians is not None:
            raise UnsupportedError(
                "--max-gaussians does not apply to a streamed scene that the page loads in parts; "
                "add &gaussians=N to the page's address, or name a --level"
            )
        if common.antialiased is not None:
            raise UnsupportedError(
                "--antialiased and --classic do not apply to a streamed scene that the page loads in parts; name a "
                "--level"
            )
        if folder.missing and not common.quiet:
            sys.stderr.write(
                f"kissgs: {scene} lacks {_listed(folder.missing)}, so a part will be missing; export or download the "
                "scene again\n"
            )
        if folder.unusable and not common.quiet:
            sys.stderr.write(
                f"kissgs: the page gets only files inside {scene}, not links out of it, so a part will be missing; "
                f"copy what they lead to: {_listed(folder.unusable)}\n"
            )
        return folder
    with progress_bar(common.quiet) as progress:
        prepared = page_scene(content, common.reading(), threads=common.threads, progress=progress)
    say_notes(scene, prepared.notes, common.quiet)
    return prepared


def _listed(names: tuple[str, ...]) -> str:
    others = len(names) - 1
    return names[0] + (f" and {others} more file{'s' * (others > 1)}" if others else "")


# ``kissgs render``: render images and animations of a scene. Heavy imports are deferred until it runs.

FPS, QUALITY = 12, 85
STEPS = [("read", 1.0), ("kernels", 1.0), ("cameras", 2.0), ("render", 5.0), ("write", 1.0)]  # seconds, about
COLOURS = {"black": "#000000", "white": "#ffffff"}


@dataclass(frozen=True, kw_only=True)
class ImageOptions:
    """Options of ``kissgs render`` for what is to be seen."""

    view: Annotated[
        str | None,
        Option(
            "--view",
            metavar="N|NAME|FILE.json",
            help="Camera: a view of --views, or else a virtual view, by name or by its number from 0 in order of "
            "names; or a file of --save-camera; or FILE.json:N or FILE.json:NAME of a cameras.json of 3DGS. Default: "
            "the first view of --views, or else the best virtual view.",
        ),
    ] = None
    orbit: Annotated[
        bool,
        Option(
            "--orbit",
            help="Render an orbit around the scene, or an arc forth and back if only one side was captured: an "
            "animation as .webp, a contact sheet as .png.",
        ),
    ] = False
    sheet: Annotated[
        bool, Option("--sheet", help="Render a contact sheet of all views of --views, or else of the virtual views.")
    ] = False
    size: Annotated[
        str | None,
        Option(
            metavar="WxH",
            help="Size of each image, pixels. Default: that of the camera, or else 1280x960; 640x480 in an animation, "
            "320x240 on a contact sheet.",
        ),
    ] = None
    background: Annotated[
        str | None,
        Option(
            metavar="COLOUR",
            help="Background colour: black, white or #rrggbb. Default: that of --views, or else black.",
        ),
    ] = None
    frames: Annotated[
        int | None,
        Option(min=3, max=3600, help="Images of an --orbit. Default: 48 in an animation, 24 on a contact sheet."),
    ] = None
    save_camera: Annotated[
        Path | None,
        Option(metavar="FILE.json", help="Write the camera of the image as JSON, for --view and other programs."),
    ] = None

    def refuse_contradictions(self, views: Path | None) -> None:
        """Raise UnsupportedError for options that do not go together; ``views`` is the value of ``--views``."""
        _refuse({"--view": self.view, "--orbit": self.orbit, "--sheet": self.sheet}, most=1, why="choose one")
        if self.view is not None and ".json" in self.view.lower():
            _refuse({"--views": views}, why=f"{self.view} is a camera file")
        if self.orbit:
            _refuse({"--views": views}, why="--orbit computes its own cameras")
        else:
            _refuse({"--frames": self.frames}, why="it only applies to --orbit")
        if self.orbit or self.sheet:
            why = "it only applies to a single image; --json prints all cameras"
            _refuse({"--save-camera": self.save_camera}, why=why)

    def pixels(self) -> tuple[int, int] | None:
        """Parse ``--size``: width and height."""
        if self.size is None:
            return None
        found = re.fullmatch(r"([1-9]\d{0,5})[xX×]([1-9]\d{0,5})", self.size.strip(), re.ASCII)
        if found is None:
            raise UnsupportedError(f"--size {self.size}: give WIDTHxHEIGHT in pixels, such as 1280x960")
        return int(found[1]), int(found[2])

    def colour(self) -> tuple[float, float, float] | None:
        """Parse ``--background``: red, green and blue, 0 to 1."""
        if self.background is None:
            return None
        code = COLOURS.get(self.background.lower(), self.background.lower())
        found = re.fullmatch(r"#([0-9a-f]{2})([0-9a-f]{2})([0-9a-f]{2})", code)
        if found is None:
            raise UnsupportedError(f"--background {self.background}: give black, white or #rrggbb, such as '#87ceeb'")
        red, green, blue = (int(value, 16) / 255 for value in found.groups())
        return red, green, blue


def _refuse(options: dict[str, object], *, why: str, most: int = 0) -> None:
    """Raise an error if more than ``most`` of these options are given."""
    given = [name for name, value in options.items() if value is not None and value is not False]
    if len(given) > most:
        raise UnsupportedError(f"{' and '.join(given)}: {why}" if most else f"leave out {given[0]}: {why}")


@with_option_groups
def render(
    file: Annotated[str, Argument(metavar="FILE", help="Scene to render, of any format that kissgs reads.")],
    output: Annotated[
        str | None,
        output_option(
            "Output NAME.png, NAME.webp, a folder, or '-' for a PNG on standard output. Default: a .png next "
            "to the scene."
        ),
    ] = None,
    *,
    image: ImageOptions,
    capture: CaptureOptions,
    force: ForceOption = False,
    as_json: Annotated[bool, Option("--json", help="Print a JSON report: the output file and the cameras.")] = False,
    common: SceneOptions,
) -> None:
    """Render an image of a scene, an orbit around it (animation or contact sheet), or all its views."""
    from kissgs.cameras.captures.transforms_json import camera_as_dict, write_camera
    from kissgs.cameras.render import RenderJob
    from kissgs.core.context import Context
    from kissgs.evaluation.evaluate import in_scene_frame
    from kissgs.io.files import refuse_existing
    from kissgs.pipeline.scene_files import load
    from kissgs.rendering.images import animated_webp, png

    threads, quiet, suffix = common.threads, common.quiet or as_json, ".png"
    if file == "-":
        raise UnsupportedError("kissgs render reads a file, not standard input")
    if output not in (None, "-") and not names_folder(output):
        suffix = Path(output).suffix.lower()
        if suffix not in (".png", ".webp"):
            raise UnsupportedError(f"{output}: images are written as .png or .webp")
    image.refuse_contradictions(capture.views)
    size, background, views = image.pixels(), image.colour(), capture.open(Path(file))

    def work(name: str, target: Path) -> Result:
        for path in (target, image.save_camera):
            if path is not None and str(path) != "-":
                refuse_existing(path, overwrite=force)
        with progress_bar(quiet, STEPS) as progress:
            job = RenderJob(
                splats=load(Path(name), threads=threads, progress=progress, **asdict(common.reading())),
                size=size,
                background=background,
                context=Context(threads, capture.device, progress),
            )
            fitting = views and in_scene_frame(job.splats, views, job.context)
            if image.orbit:
                rendered = (job.animation if suffix == ".webp" else job.orbit_sheet)(image.frames)
            else:
                rendered = job.view_sheet(fitting) if image.sheet else job.single(fitting, image.view)
            progress("write", 0.0)
            images = rendered.images
            data = png(images[0]) if suffix == ".png" else animated_webp(images, fps=FPS, quality=QUALITY)
            progress("write", 1.0)
        say_notes(name, job.splats.notes, common.quiet)
        write_output(target, data, force=force)
        if image.save_camera is not None:
            write_camera(image.save_camera, rendered.views[0].camera, overwrite=force)
        saved = "" if image.save_camera is None else f"; {image.save_camera}"
        height, width = rendered.images[0].shape[:2]
        cameras = [{"name": view.name, **camera_as_dict(view.camera)} for view in rendered.views]
        report = {"width": width, "height": height, "frames": len(rendered.images), "bytes": len(data)}
        line = f"{target}  {width}x{height}, {rendered.description}{saved}"
        return {**report, "cameras": cameras}, line

    for_each_input([file], output, suffix, work, as_json=as_json, quiet=quiet)
