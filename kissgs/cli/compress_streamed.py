"""``compress_streamed``: ``kissgs compress -o FOLDER/lod-meta.json`` of one scene, into levels of detail."""

from __future__ import annotations

import contextlib
import sys
from dataclasses import asdict
from typing import TYPE_CHECKING, Any

from kissgs.cli.console import progress_bar
from kissgs.cli.files import show
from kissgs.cli.interrupts import NOTHING_LEFT, say_when_interrupted
from kissgs.core.errors import UnsupportedError
from kissgs.core.progress import Progress

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

    from kissgs.cli.options import CompressOptions


def refuse_options(manifest: Path, options: CompressOptions, *, container: str | None, unpacked: bool) -> None:
    """Raise UnsupportedError for options that levels of detail do not have."""
    unused = {
        "--views": options.views,
        "--evaluate": options.evaluate,
        "--cache": options.cache,
        "--container": container,
        "--unpacked": unpacked,
    }
    if wrong := next((name for name, value in unused.items() if value), None):
        raise UnsupportedError(f"levels of detail ({manifest.name}) are made without {wrong}")


def compress_streamed(options: CompressOptions, ray: str | None, scene: str, target: Path) -> dict[str, Any]:
    """Compress a scene into a streamed scene, show a table and return its report; ``ray`` is an address or None."""
    if scene == "-":
        raise UnsupportedError("levels of detail need a file: it is read more than once")
    with _stages(options.quiet) as progress, contextlib.ExitStack() as ending:
        from kissgs.streaming.layout import continuation, work_folder

        work = work_folder(target)
        say_when_interrupted(continuation(work))  # a second signal may stop the removal of what was made
        ending.callback(_say_what_is_left, work)
        progress("kernels", 0.0)
        from kissgs.streaming.compress import compress_streamed as run

        runner = None
        if ray is not None:
            from kissgs.runners import RayRunner

            progress("cluster", 0.0)
            runner = RayRunner(ray)
            ending.callback(runner.close)
        report = run(
            scene,
            target,
            settings=options.settings,
            reading=options.reading,
            overwrite=options.force,
            runner=runner,
            threads=options.threads,
            progress=progress,
        )
    if not options.quiet:
        from kissgs.cli.tables import streamed_table

        show(streamed_table(report, str(target)))
    return asdict(report)


@contextlib.contextmanager
def _stages(quiet: bool) -> Iterator[Progress]:
    """Yield a receiver of progress that announces the scratch folder, and says when an interruption leaves it."""
    with progress_bar(quiet) as bar:

        def receive(stage: str, fraction: float, note: str = "") -> None:
            if stage == "scratch" and not quiet:
                sys.stderr.write(f"kissgs: {note}\n")
            if stage in ("merge", "cameras", "images"):  # what is interrupted earlier begins anew
                say_when_interrupted("the same command goes on where it was")
            bar(stage, fraction, note)

        yield receive


def _say_what_is_left(work: Path) -> None:
    """Let the message of an interruption say whether something is left, and what the same command does with it."""
    from kissgs.streaming.layout import continuation

    say_when_interrupted(continuation(work) if work.exists() else NOTHING_LEFT)
