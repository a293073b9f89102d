"""``kissgs remote``: compress with a kissgs service."""

from __future__ import annotations

import functools
import os
import tempfile
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from typer import Argument, Option

from kissgs.cli.files import Result, announcing, for_each_input, is_folder, print_json, progress_bar, show
from kissgs.cli.options import (
    EncodingOptions,
    FilesArgument,
    ForceOption,
    ViewsOption,
    output_option,
    with_option_groups,
)
from kissgs.core.errors import OutputError, RemoteError, UnsupportedError
from kissgs.formats import OUTPUT_FORMATS, ending_of, named_container

if TYPE_CHECKING:
    from kissgs.client import Remote

ServerOption = Annotated[str, Option("--server", envvar="KISSGS_SERVER", metavar="URL", help="URL of the service.")]
ServiceJsonOption = Annotated[bool, Option("--json", help="Print the response of the service as JSON.")]
JobArgument = Annotated[str, Argument(help="Id of the job, see 'kissgs remote list'.")]
DEFAULT_SERVER = "http://127.0.0.1:8000"

app = typer.Typer(
    name="remote",
    help="Compress with a kissgs service. If it needs an API key, set the variable KISSGS_KEY.",
    no_args_is_help=True,
)


@app.command()
@with_option_groups
def compress(
    scenes: FilesArgument,
    output: Annotated[
        str | None, output_option("Output NAME.zip, NAME.sog or a folder. Default: next to the scene.")
    ] = None,
    server: ServerOption = DEFAULT_SERVER,
    *,
    encoding: EncodingOptions,
    views: ViewsOption = None,
    force: ForceOption = False,
    as_json: ServiceJsonOption = False,
    quiet: Annotated[bool, Option("--quiet", "-q", help="Print only errors.")] = False,
) -> None:
    """Compress scenes on a server. Ctrl-C cancels the job."""
    from kissgs.cameras.captures.load import capture_of, pack_capture
    from kissgs.cli.tables import status_table
    from kissgs.client import WAIT
    from kissgs.io.files import open_scene_file, refuse_existing
    from kissgs.pipeline.scene_files import scene_root

    if "-" in scenes or str(output) == "-":
        raise UnsupportedError("kissgs remote reads and writes files only; '-' is not possible")
    kind, settings = named_container(encoding.container, output), encoding.settings()
    with _service(server) as remote, tempfile.TemporaryDirectory() as folder:

        @functools.cache
        def packed(capture: Path, within: Path) -> Path:
            try:
                remote.jobs(1)  # here, as packing may take minutes
            except RemoteError as error:
                if error.retry_after is None:  # else it is overloaded for a while
                    raise
            archive = Path(tempfile.mkdtemp(dir=folder)) / "capture.zip"
            with progress_bar(quiet or as_json) as progress:
                pack_capture(capture, archive, progress, scene=within / "scene")
            return archive

        def work(scene: str, target: Path) -> Result:
            refuse_existing(target, overwrite=force)  # here, as packing may take minutes
            file = scene_root(Path(scene)) if is_folder(Path(scene)) else Path(scene)
            with open_scene_file(file):
                capture = None if views is None else packed(capture_of(views, Path(scene)), file.absolute().parent)
            with progress_bar(quiet or as_json) as progress:
                status = remote.compress(
                    file,
                    target,
                    settings=settings,
                    container=kind,
                    evaluate=encoding.evaluate,
                    origin=encoding.origin,
                    capture=capture,
                    overwrite=force,
                    progress=announcing(progress, WAIT, quiet, f"{server}: "),
                )
            return status, status_table(status, str(target))

        for_each_input(scenes, output, ending_of(kind), work, as_json=as_json, quiet=quiet)


@app.command(name="list")
def list_jobs(server: ServerOption = DEFAULT_SERVER, as_json: ServiceJsonOption = False) -> None:
    """List the latest jobs on a server."""
    with _service(server) as remote:
        jobs = remote.jobs()
    if as_json:
        print_json(jobs)
        return
    for job in jobs:
        ratio = f"{job['sizes']['ratio']:6.1f}x" if "sizes" in job else " " * 7
        show(f"{job['id']}  {job['state']:9}  {ratio}  {job['timings']['created_at'][:19]}  {job['name']}")


@app.command()
def get(
    job: JobArgument,
    output: Annotated[
        Path | None, output_option("Output file, with the ending of the job's format. Default: the name of the scene.")
    ] = None,
    server: ServerOption = DEFAULT_SERVER,
    force: ForceOption = False,
) -> None:
    """Wait for a job to finish, and download its container."""
    from kissgs.cli.tables import status_table
    from kissgs.client import WAIT, Share
    from kissgs.io.files import refuse_existing

    with _service(server) as remote, progress_bar(False) as bar:
        progress = announcing(bar, WAIT, False, f"{server}: ")
        known = remote.status(job)
        kind = known["options"].get("format") or named_container(None, output)  # a server may state none
        ending = f".{kind}" if kind in OUTPUT_FORMATS else ending_of(kind)
        target = output or Path(f"{known['name']}{ending}")
        if not target.name.lower().endswith(ending):
            raise OutputError(f"{target!s:.100} is not the name of this job's result; end it in {ending}")
        refuse_existing(target, overwrite=force)
        status = remote.follow(job, Share(progress, 0.0, 0.95))
        remote.download(status, target, overwrite=force, progress=Share(progress, 0.95, 1.0))
    show(status_table(status, str(target)))


@app.command()
def cancel(job: JobArgument, server: ServerOption = DEFAULT_SERVER) -> None:
    """Cancel a job."""
    with _service(server) as remote:
        show(f"{job} {remote.cancel(job)['state']}")


def _service(server: str) -> Remote:
    from kissgs.client import Remote

    return Remote(server, key=os.environ.get("KISSGS_KEY"))
