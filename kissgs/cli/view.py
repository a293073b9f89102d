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
from kissgs.cli.options import (
    AntialiasedOption,
    ForceOption,
    MaxGaussiansOption,
    QuietOption,
    RawAxesOption,
    ThreadsOption,
)
from kissgs.core.errors import InvalidSceneError, OutputError, UnsupportedError

if TYPE_CHECKING:
    from kissgs.io.scene_format import ReadOptions
    from kissgs.preview.page_scene import PageScene, StreamedFolder


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
    max_gaussians: MaxGaussiansOption = None,
    level: Annotated[
        int | None,
        typer.Option(
            min=0,
            help="Show this level of detail of a streamed scene alone; 0 is the finest. Default: what the camera sees, "
            "as it comes near; with -o, the finest level of at most a million Gaussians.",
        ),
    ] = None,
    raw_axes: RawAxesOption = False,
    antialiased: AntialiasedOption = None,
    threads: ThreadsOption = 0,
    force: ForceOption = False,
    quiet: QuietOption = False,
) -> None:
    """Show a scene in the browser, from a server on this machine that Ctrl-C ends; -o writes a page instead."""
    from kissgs.io.scene_format import ReadOptions
    from kissgs.preview.page_scene import fetch_viewer, page_files

    reading = ReadOptions(max_gaussians=max_gaussians, level=level or 0, raw_axes=raw_axes, antialiased=antialiased)
    check_input(scene, InvalidSceneError)
    if fetch:
        fetch_viewer()
    page_files()  # before the work
    if output is None:
        _serve(scene, reading, level is None, port, browser, threads, quiet)
    elif port or not browser:
        raise UnsupportedError("--port and --no-browser are for the server, which -o does not start")
    else:
        _write(scene, reading, level is None, output, threads, force, quiet)


def _write(
    scene: str, reading: ReadOptions, any_level: bool, output: Path, threads: int, force: bool, quiet: bool
) -> None:
    from kissgs.io.files import atomic_file, refuse_existing
    from kissgs.preview.page_scene import fitting_level, is_streamed, page_container
    from kissgs.preview.standalone_page import standalone_page

    if output.suffix.lower() not in (".html", ".htm"):
        raise OutputError(f"{output!s:.100} is not the name of a page: end it in .html")
    refuse_existing(output, overwrite=force)
    content, chosen = source(scene), ""
    if any_level and is_streamed(content):
        level, levels = fitting_level(content, reading.max_gaussians)
        reading = replace(reading, level=level)
        chosen = f", level {level} of 0 to {levels - 1}"
    with progress_bar(quiet) as progress:
        container = page_container(content, reading, threads=threads, progress=progress)
    say_notes(scene, container.notes, quiet)
    page = standalone_page(container)
    with atomic_file(output, overwrite=force) as file:
        file.write(page)
    if not quiet:
        made = f", compressed by the preset balanced to {len(container.data):,} bytes" if container.converted else ""
        show(f"{output}  {len(page):,} bytes, holds {container.name}{chosen}{made}")


def _serve(
    scene: str, reading: ReadOptions, all_levels: bool, port: int, browser: bool, threads: int, quiet: bool
) -> None:
    from kissgs.preview.server import PageServer

    prepared = _prepare(scene, reading, all_levels, threads, quiet)
    with PageServer(prepared, port) as server, contextlib.suppress(Interrupted):
        sys.stdout.write(f"{server.url}  (Ctrl-C ends)\n")
        sys.stdout.flush()
        if browser and _has_display():
            threading.Thread(target=webbrowser.open, args=(server.url,), daemon=True).start()
        server.serve_forever()


def _prepare(
    scene: str, reading: ReadOptions, all_levels: bool, threads: int, quiet: bool
) -> PageScene | StreamedFolder:
    """Return what the server gets: a scene in memory, or the folder of a streamed one."""
    from kissgs.preview.page_scene import is_streamed_folder, page_scene, streamed_folder

    content = source(scene)
    if all_levels and isinstance(content, Path) and is_streamed_folder(content):
        if reading.max_gaussians is not None:
            raise UnsupportedError(
                "--max-gaussians does not apply to a streamed scene that the page loads in parts; "
                "add &gaussians=N to the page's address, or name a --level"
            )
        if reading.antialiased is not None:
            raise UnsupportedError(
                "--antialiased and --classic do not apply to a streamed scene that the page loads in parts; name a "
                "--level"
            )
        folder = streamed_folder(content)
        if not quiet:
            _warn(scene, folder)
        return folder
    with progress_bar(quiet) as progress:
        prepared = page_scene(content, reading, threads=threads, progress=progress)
    say_notes(scene, prepared.notes, quiet)
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
