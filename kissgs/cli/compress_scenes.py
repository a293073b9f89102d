"""Compression of one scene, of many on a cluster, or of one as a streamed scene, as the command line shows it."""

from __future__ import annotations

import contextlib
import hashlib
import io
import os
import re
import shutil
import socket
import sys
import tempfile
from collections.abc import Iterator
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from kissgs.cli.files import output, progress_bar, say_notes, show, sibling, source, write_stdout
from kissgs.cli.interrupts import NOTHING_LEFT, say_when_interrupted
from kissgs.cli.options import CHECKPOINT
from kissgs.cli.signals import stoppable
from kissgs.core.errors import KissgsError, OutputError, UnsupportedError
from kissgs.core.progress import Progress, silent
from kissgs.io.files import move_into_place, open_scene_file, reason_of
from kissgs.pipeline.pipeline import compress
from kissgs.pipeline.training_choice import decided
from kissgs.runners import INTERNAL, Outcome, RayRunner, Resources, RunHandle, Runner, WorkItem, error_of
from kissgs.sogxt.container import check_destination
from kissgs.training.checkpoint import delete_checkpoints

if TYPE_CHECKING:
    from kissgs.cameras.views import Views
    from kissgs.cli.options import CompressOptions


# ``compress_here``: ``kissgs compress`` of one scene, in this process.


def compress_here(options: CompressOptions, capture: Views | None, scene: str, target: Path) -> dict[str, Any]:
    """Compress a scene, show a table of the result and return its report; ``capture`` are the ``options.views``."""
    piped = str(target) == "-"
    searches = decided(options.settings, capture).searches
    with progress_bar(options.quiet) as bar, stoppable(bar, searches) as progress:
        if options.evaluate:  # reported here, because evaluation reports only one stage
            from kissgs.core.progress import load_kernels

            load_kernels(progress)
        result = compress(
            source(scene),
            None if piped else target,
            settings=options.settings,
            reading=options.reading,
            container=options.container,
            cache=sibling(scene, ".sensitivity.npz") if options.cache else None,
            evaluate=options.evaluate,
            views=capture,
            force_views=options.force_views,
            checkpoint=sibling(scene, CHECKPOINT) if options.checkpoint else None,
            overwrite=options.force,
            threads=options.threads,
            device=options.device,
            progress=progress,
        )
    if piped:
        say_notes(scene, (result.report.note, *result.report.cleaned.notes), options.quiet)
        write_stdout(result.to_zip())
        delete_checkpoints(*result.checkpoints)
    elif not options.quiet:
        from kissgs.cli.tables import report_table

        show(report_table(result.report, str(target)))
    return result.report.as_dict()


# ``compress_streamed``: ``kissgs compress -o FOLDER/lod-meta.json`` of one scene, into levels of detail.


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


# ``compress_scene``: compression of one scene as a work item, for ``kissgs compress --ray``.


def compress_scene(arguments: dict[str, Any], progress: Progress) -> dict[str, Any]:
    """Compress a scene into a new folder within the work folder, from where whoever submitted it moves the result.

    Returns:
        "written", the path of the output; "report" for JSON; "table", the report as text for the terminal.
    """
    from kissgs.cli.options import open_views
    from kissgs.io.scene_format import ReadOptions
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
        from kissgs.core.progress import load_kernels

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


# ``ClusterCompression``: ``kissgs compress --ray``, scenes as work items on the nodes of a Ray cluster.

PROCESS_BYTES = 500_000_000
"""Memory that a scene of any size needs, bytes: mostly the libraries."""

MEMORY_RATIO, TRAINING_RATIO, PACKED_RATIO = 4, 12, 10
"""Memory that a scene needs for each byte of its ``.ply``: without and with training; and by how much the files of
compressed formats are smaller than that. Measured: docs/benchmarks.md, "Time and memory by the number of Gaussians"."""


@dataclass
class ClusterCompression:
    """Compression of several scenes: :meth:`submitted` begins it, and :meth:`result` awaits each scene.

    All scenes are submitted at once, and their results are awaited in order. An item writes below a work folder beside
    its output, and the result is moved from there when its outcome has arrived: a node may be lost at any moment, and
    nothing is written twice or in part.
    """

    address: str
    options: CompressOptions
    _handles: dict[Path, RunHandle | KissgsError] = field(default_factory=dict)
    _work: dict[Path, Path] = field(default_factory=dict)
    _bar: Progress = silent

    @contextlib.contextmanager
    def submitted(self, inputs: list[tuple[str, Path]]) -> Iterator[None]:
        """Connect to the cluster and submit all scenes; the end of the context cancels what has not ended."""
        if any("-" in (name, str(target)) for name, target in inputs):
            raise UnsupportedError("--ray needs files that all machines see, not standard input or output")
        with progress_bar(self.options.quiet) as bar:
            bar("cluster", 0.0)
            runner = RayRunner(self.address)
        try:
            requested = self._request(runner, len(inputs))
            for name, target in inputs:
                try:
                    self._handles[target] = self._submit(runner, name, target, requested)
                except (KissgsError, OSError) as error:  # the command itself reports inputs that cannot be read
                    self._handles[target] = error if isinstance(error, KissgsError) else OutputError(str(error))
            yield
        finally:
            try:
                runner.close()
            finally:
                for work in self._work.values():
                    shutil.rmtree(work, ignore_errors=True)

    def result(self, name: str, target: Path) -> dict[str, Any]:
        """Wait for the result of one scene, move it to its place, show its table and return its report."""
        handle = self._handles[target]
        if isinstance(handle, KissgsError):
            raise handle
        with progress_bar(self.options.quiet) as self._bar:
            outcome = handle.outcome.result()
        self._bar = silent
        if outcome.kind != "done":
            raise self._error(outcome, target)
        check_destination(target, overwrite=self.options.force)
        move_into_place(Path(outcome.result["written"]), target)
        if not self.options.quiet:
            from rich.text import Text

            show(Text.from_ansi(outcome.result["table"].removesuffix("\n")))
        report: dict[str, Any] = outcome.result["report"]
        return report

    def _request(self, runner: Runner, count: int) -> Resources:
        """Return the processors and GPUs of each of ``count`` scenes, which share all without ``--threads``."""
        processors = [node.cpus for node in runner.nodes]
        share = min(*processors, sum(processors) // count) if processors else 0
        cpus = self.options.threads or max(1, int(share))
        requested = Resources(cpus, gpus=1 if self.options.device == "cuda" else 0)
        if refusal := runner.refusal(requested):
            raise UnsupportedError(f"{refusal}; choose another number with --threads, or --device cpu")
        return requested

    def _submit(self, runner: Runner, name: str, target: Path, requested: Resources) -> RunHandle:
        options = self.options
        check_destination(target, overwrite=options.force)
        scene = Path(name).absolute()
        if not scene.is_dir():  # here, because a node would say of a missing file that it does not see it
            with open_scene_file(Path(name)):
                pass
        work = self._work[target] = _new_work(target)
        size = scene.stat().st_size if scene.is_file() else 0
        resources = self._with_memory(runner, requested, self._memory(scene, size))
        console = output()
        arguments = {
            "scene": str(scene),
            "bytes": size,
            "work": str(work.absolute()),
            "target": str(target),
            "settings": options.settings.model_dump(mode="json"),
            "reading": asdict(options.reading),
            "container": options.container,
            "cache": str(sibling(name, ".sensitivity.npz")) if options.cache else None,
            "evaluate": options.evaluate,
            "views": None if options.views is None else str(options.views.absolute()),
            "force_views": options.force_views,
            "checkpoint": str(sibling(name, CHECKPOINT)) if options.checkpoint else None,
            "threads": int(requested.cpus),
            "device": options.device,
            "width": console.width,
            "color": console.is_terminal,
        }

        def progress(stage: str, fraction: float, note: str = "") -> None:
            ended = sum(isinstance(each, KissgsError) or each.outcome.done() for each in list(self._handles.values()))
            details = "; ".join(
                filter(None, [f"{ended} of {len(self._handles)} scenes; {Path(name).name}: {stage}", note])
            )
            self._bar("scenes", ended / max(len(self._handles), 1), details)

        return runner.submit(WorkItem("kissgs.cli.compress_scenes:compress_scene", arguments, resources), progress)

    def _with_memory(self, runner: Runner, requested: Resources, memory: int) -> Resources:
        """Return a request with memory, at most that of the largest node that has the rest of it."""
        nodes = [node.memory for node in runner.nodes if requested.fits(node)]
        resources = Resources(requested.cpus, min(memory, max(nodes, default=0)), requested.gpus)
        if refusal := runner.refusal(resources):
            raise UnsupportedError(refusal)
        return resources

    def _memory(self, scene: Path, size: int) -> int:
        """Return an estimate of the memory that a scene needs, bytes."""
        settings = self.options.settings
        goal_trains = settings.encode.has_goal and (self.options.views or settings.finetune.enabled is not False)
        trains = settings.compact.enabled or settings.finetune.enabled or goal_trains or settings.aims
        plain = size if scene.suffix.lower() == ".ply" else PACKED_RATIO * size
        return PROCESS_BYTES + (TRAINING_RATIO if trains else MEMORY_RATIO) * plain

    def _error(self, outcome: Outcome, target: Path) -> KissgsError:
        """Return the exception of a scene that was not compressed, about its output and not about the work folder."""
        if outcome.code == INTERNAL:  # a bug, which should look like one
            sys.stderr.write(outcome.log)
        attempt = re.escape(str(self._work[target].absolute())) + r"/[^/]*/"
        message = re.sub(attempt, lambda found: f"{target.parent}/", outcome.message)
        return error_of(replace(outcome, message=message))


def _new_work(target: Path) -> Path:
    """Make the work folder of an output; a former command that was killed may have left one, with the same name."""
    digest = hashlib.sha256(os.fsencode(target.name)).hexdigest()
    work = target.parent / f".kissgs.{digest[:16]}.part"
    shutil.rmtree(work, ignore_errors=True)
    work.mkdir(mode=0o700)
    return work
