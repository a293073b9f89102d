"""``kissgs view``: show a scene in the browser, or write a page that shows it."""

from __future__ import annotations

import contextlib
import os
import sys
import threading
import webbrowser
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from kissgs.cli.console import progress_bar
from kissgs.cli.files import check_input, say_notes, show, source
from kissgs.cli.interrupts import Interrupted
from kissgs.cli.options import ForceOption, SceneOptions, reads_scenes
from kissgs.core.errors import InvalidSceneError, OutputError, UnsupportedError

if TYPE_CHECKING:
    from kissgs.preview.page_scene import PageScene, StreamedFolder


@reads_scenes
def view(
    scene: Annotated[
        str, typer.Argument(metavar="FILE", help="Scene of any format, or a container; '-' reads standard input.")
    ],
    output: Annotated[
        Path | None,
        typer.Option(
            "--output",
            "-o",
            metavar="PAGE.html",
            help="Write one HTML file with viewer and scene, which opens from disk without a network, and exit.",
        ),
    ] = None,
    port: Annotated[int, typer.Option(min=0, max=65535, help="TCP port of the server; 0 for a free one.")] = 0,
    browser: Annotated[
        bool, typer.Option("--browser/--no-browser", help="Whether to open the browser, or to print the address only.")
    ] = True,
    fetch: Annotated[
        bool, typer.Option("--fetch-viewer", help="Download Spark and three.js first, if they are not installed.")
    ] = False,
    force: ForceOption = False,
    *,
    common: SceneOptions,
) -> None:
    """Show a scene in the browser, from a server on this machine that Ctrl-C ends; -o writes a page instead.

    Of a streamed scene it shows what the camera sees, as it comes near; with -o, the finest level of at most a million
    Gaussians; with --level, that level alone.
    """
    from kissgs.preview.page_scene import fetch_viewer, page_files

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
    from kissgs.io.files import atomic_file, refuse_existing
    from kissgs.preview.page_scene import fitting_level, is_streamed, page_container
    from kissgs.preview.standalone_page import standalone_page

    if output.suffix.lower() not in (".html", ".htm"):
        raise OutputError(f"{output!s:.100} is not the name of a page: end it in .html")
    refuse_existing(output, overwrite=force)
    content, chosen, reading = source(scene), "", common.reading()
    if common.level is None and is_streamed(content):
        level, levels = fitting_level(content, reading.max_gaussians)
        reading = replace(reading, level=level)
        chosen = f", level {level} of 0 to {levels - 1}"
    with progress_bar(common.quiet) as progress:
        container = page_container(content, reading, threads=common.threads, progress=progress)
    say_notes(scene, container.notes, common.quiet)
    page = standalone_page(container)
    with atomic_file(output, overwrite=force) as file:
        file.write(page)
    if not common.quiet:
        made = f", compressed by the preset balanced to {len(container.data):,} bytes" if container.converted else ""
        show(f"{output}  {len(page):,} bytes, holds {container.name}{chosen}{made}")


def _serve(scene: str, common: SceneOptions, port: int, browser: bool) -> None:
    from kissgs.preview.server import PageServer

    with PageServer(_prepare(scene, common), port) as server, contextlib.suppress(Interrupted):
        sys.stdout.write(f"{server.url}  (Ctrl-C ends)\n")
        sys.stdout.flush()
        if browser and _has_display():
            threading.Thread(target=webbrowser.open, args=(server.url,), daemon=True).start()
        server.serve_forever()


def _prepare(scene: str, common: SceneOptions) -> PageScene | StreamedFolder:
    """Return what the server gets: a scene in memory, or the folder of a streamed one."""
    from kissgs.preview.page_scene import is_streamed_folder, page_scene, streamed_folder

    content = source(scene)
    if common.level is None and isinstance(content, Path) and is_streamed_folder(content):
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
        folder = streamed_folder(content)
        if not common.quiet:
            _warn(scene, folder)
        return folder
    with progress_bar(common.quiet) as progress:
        prepared = page_scene(content, common.reading(), threads=common.threads, progress=progress)
    say_notes(scene, prepared.notes, common.quiet)
    return prepared


def _warn(scene: str, folder: StreamedFolder) -> None:
    """Say which files the page cannot get: those that are missing, and those that are there."""
    if folder.missing:
        sys.stderr.write(
            f"kissgs: {scene} lacks {_listed(folder.missing)}, so a part will be missing; export or download the scene "
            "again\n"
        )
    if folder.unusable:
        sys.stderr.write(
            f"kissgs: the page gets only files inside {scene}, not links out of it, so a part will be missing; copy "
            f"what they lead to: {_listed(folder.unusable)}\n"
        )


def _listed(names: tuple[str, ...]) -> str:
    others = len(names) - 1
    return names[0] + (f" and {others} more file{'s' * (others > 1)}" if others else "")


def _has_display() -> bool:
    """Whether a browser with windows can open; one in the terminal would cover the address."""
    return sys.platform in ("darwin", "win32") or bool(os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY"))
