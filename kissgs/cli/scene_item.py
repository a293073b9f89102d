"""``compress_scene``: compression of one scene as a work item, for ``kissgs compress --ray``."""

from __future__ import annotations

import io
import socket
import tempfile
from pathlib import Path
from typing import Any

from kissgs.core.errors import OutputError, UnsupportedError
from kissgs.core.progress import Progress
from kissgs.io.atomic import reason_of


def compress_scene(arguments: dict[str, Any], progress: Progress) -> dict[str, Any]:
    """Compress a scene into a new folder within the work folder, from where whoever submitted it moves the result.

    Args:
        arguments: "scene" and its size "bytes", the work folder "work", the path "target" for which the output is
            made, and arguments of :func:`kissgs.compress`; "width" and "color" of the terminal.
        progress: receives the stages.

    Returns:
        "written", the path of the output; "report" for JSON; "table", the report as text for the terminal.

    Raises:
        KissgsError: as :func:`kissgs.compress`, or the files are not on storage that this machine shares.
    """
    from kissgs.cli.options import open_views
    from kissgs.pipeline.pipeline import compress
    from kissgs.pipeline.read_options import ReadOptions
    from kissgs.settings import Settings

    scene, work = Path(arguments["scene"]), Path(arguments["work"])
    _check_shared(scene, arguments["bytes"], work)
    try:
        attempt = tempfile.mkdtemp(dir=work)  # of its own: a node that was given up may go on for a while
    except OSError as error:
        raise OutputError(
            f"the machine {socket.gethostname()} cannot write to {work}: {reason_of(error)}; Ray must run there as the "
            "same user as this command, on storage with room"
        ) from error
    written = Path(attempt) / Path(arguments["target"]).name
    if arguments["evaluate"]:  # reported here, because evaluation reports only one stage
        from kissgs.rendering.rasterizer import load_kernels

        load_kernels(progress)
    result = compress(
        scene,
        written,
        settings=Settings.model_validate(arguments["settings"]),
        reading=ReadOptions(**arguments["reading"]),
        container=arguments["container"],
        cache=arguments["cache"],
        evaluate=arguments["evaluate"],
        views=open_views(None if arguments["views"] is None else Path(arguments["views"])),
        force_views=arguments["force_views"],
        checkpoint=arguments["checkpoint"],
        threads=arguments["threads"],
        device=arguments["device"],
        progress=progress,
    )
    return {
        "written": str(written),
        "report": result.report.as_dict(),
        "table": _table(result.report, arguments),
    }


def _check_shared(scene: Path, size: int, work: Path) -> None:
    """Raise UnsupportedError if this machine does not see the scene or the work folder of another one."""
    if not scene.exists():
        problem = f"does not see {scene}"
    elif scene.is_file() and scene.stat().st_size != size:
        problem = f"sees another file as {scene}"
    elif not work.is_dir():
        problem = f"does not see what this machine writes to {work.parent}"
    else:
        return
    raise UnsupportedError(
        f"the machine {socket.gethostname()} {problem}; --ray needs storage that all machines see at the same path"
    )


def _table(report: Any, arguments: dict[str, Any]) -> str:  # noqa: ANN401  kissgs.Report, imported later
    from rich.console import Console

    from kissgs.cli.tables import report_table

    text = io.StringIO()
    console = Console(
        file=text, width=arguments["width"], force_terminal=arguments["color"], highlight=False, markup=False
    )
    console.print(report_table(report, arguments["target"]))
    return text.getvalue()
