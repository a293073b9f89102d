"""Compression of scenes: here, into levels of detail, or on a cluster."""

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
from concurrent.futures import Future
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any, Literal

from pydantic import BaseModel, ConfigDict
from rich.console import Console
from rich.text import Text

from kissgs.cameras.views import Views
from kissgs.cli import files
from kissgs.cli.files import CHECKPOINT, Result, progress_bar, say_notes, sibling, source, stoppable, write_stdout
from kissgs.cli.interrupts import NOTHING_LEFT, say_when_interrupted
from kissgs.cli.options import open_views
from kissgs.cli.tables import report_table, streamed_table
from kissgs.core.context import Progress, silent
from kissgs.core.errors import KissgsError, OutputError, UnsupportedError
from kissgs.formats import ContainerName
from kissgs.io.containers import check_destination
from kissgs.io.files import move_into_place, open_scene_file, reason_of
from kissgs.io.scene_format import ReadOptions
from kissgs.pipeline.encoding import FILES
from kissgs.pipeline.limited_time import resolved
from kissgs.pipeline.pipeline import Compressed, compress
from kissgs.pipeline.scene_files import scene_root
from kissgs.runners import INTERNAL, PROCESS_BYTES, Outcome, Resources, Runner, WorkItem, error_of
from kissgs.runners.ray_runner import RayRunner
from kissgs.settings import Settings
from kissgs.training.checkpoint import delete_checkpoints


class SceneCompression(BaseModel):
    """How one ``kissgs compress`` compresses each scene: its options, checked; other machines get them as JSON."""

    model_config = ConfigDict(frozen=True)

    settings: Settings
    reading: ReadOptions
    container: ContainerName
    cache: bool
    evaluate: bool
    views: Path | None
    force_views: bool
    checkpoint: bool
    force: bool
    threads: int
    device: Literal["cpu", "cuda"]
    quiet: bool

    def run(self, scene: str, target: Path | None, capture: Views | None, progress: Progress) -> Compressed:
        """Compress a scene; ``capture`` are the ``views``, loaded."""
        return compress(
            source(scene),
            target,
            settings=self.settings,
            reading=self.reading,
            container=self.container,
            cache=sibling(scene, ".sensitivity.npz") if self.cache else None,
            evaluate=self.evaluate,
            views=capture,
            force_views=self.force_views,
            checkpoint=sibling(scene, CHECKPOINT) if self.checkpoint else None,
            overwrite=self.force,
            threads=self.threads,
            device=self.device,
            progress=progress,
        )


# ``kissgs compress`` of one scene, in this process.


def compress_here(options: SceneCompression, scene: str, target: Path) -> Result:
    """Compress a scene."""
    piped, capture = str(target) == "-", open_views(options.views, scene)
    searches = resolved(options.settings, capture).searches
    with progress_bar(options.quiet) as bar, stoppable(bar, searches) as progress:
        made = options.run(scene, None if piped else target, capture, progress)
    if piped:
        say_notes(scene, (made.report.note, *made.report.cleaned.notes), options.quiet)
        write_stdout(made.to_zip())
        delete_checkpoints(*made.checkpoints)
    return made.report.as_dict(), report_table(made.report, str(target))


# ``kissgs compress -o FOLDER/lod-meta.json`` of one scene, into levels of detail.


def refuse_options(manifest: Path, options: SceneCompression, *, container: str | None, unpacked: bool) -> None:
    """Raise UnsupportedError for options that levels of detail do not have."""
    unused: dict[str, object] = {"--views": options.views, "--evaluate": options.evaluate, "--cache": options.cache}
    unused |= {"--container": container, "--unpacked": unpacked}
    if wrong := next((name for name, value in unused.items() if value), None):
        raise UnsupportedError(f"levels of detail ({manifest.name}) are made without {wrong}")


def compress_streamed(options: SceneCompression, ray: str | None, scene: str, target: Path) -> Result:
    """Compress a scene into a streamed scene; ``ray`` is the address of a cluster, or None."""
    if scene == "-":
        raise UnsupportedError("levels of detail need a file: it is read more than once")
    with progress_bar(options.quiet) as bar, contextlib.ExitStack() as ending:
        from kissgs.streaming.work_folder import continuation, work_folder

        work = work_folder(target)
        say_when_interrupted(lambda: continuation(work) if work.exists() else NOTHING_LEFT)
        bar("kernels", 0.0)
        from kissgs.streaming.compress import compress_streamed as run

        runner = None
        if ray is not None:
            bar("cluster", 0.0)
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
            progress=files.announcing(bar, "scratch", options.quiet),
        )
    return asdict(report), streamed_table(report, str(target))


# ``kissgs compress --ray``: scenes as work items on the nodes of a Ray cluster.

MEMORY_RATIO, TRAINING_RATIO, PACKED_RATIO = 4, 12, 10
"""Memory that a scene needs for each byte of its ``.ply``: without and with training; and by how much the files of
compressed formats are smaller than that. Measured: docs/benchmarks.md, "Time and memory by the number of Gaussians"."""


def compress_scene(arguments: dict[str, Any], progress: Progress) -> dict[str, Any]:
    """Compress a scene into a new folder within the work folder, from where whoever submitted it moves the result."""
    scene, work = Path(arguments["scene"]), Path(arguments["work"])
    problem = None
    if not scene.exists():
        problem = f"does not see {scene}"
    elif scene.is_file() and scene.stat().st_size != arguments["bytes"]:
        problem = f"sees another file as {scene}"
    elif not work.is_dir():
        problem = f"does not see what this machine writes to {work.parent}"
    if problem:
        remedy = "--ray needs storage that all machines see at the same path"
        raise UnsupportedError(f"the machine {socket.gethostname()} {problem}; {remedy}")
    try:
        attempt = tempfile.mkdtemp(dir=work)  # of its own: a node that was given up may go on for a while
    except OSError as error:
        raise OutputError(
            f"the machine {socket.gethostname()} cannot write to {work}: {reason_of(error)}; Ray must run there as the "
            "same user as this command, on storage with room"
        ) from error
    written = Path(attempt) / Path(arguments["target"]).name
    options = SceneCompression.model_validate(arguments["options"])
    capture = open_views(options.views, scene)
    report = options.run(str(scene), written, capture, progress).report
    table = io.StringIO()
    terminal = {"width": arguments["width"], "force_terminal": arguments["color"]}
    Console(file=table, highlight=False, markup=False, **terminal).print(report_table(report, arguments["target"]))
    return {"written": str(written), "report": report.as_dict(), "table": table.getvalue()}


@dataclass
class ClusterCompression:
    """Compression of several scenes, submitted at once; their results are awaited in order. An item writes below a work
    folder beside its output, and the result is moved from there when its outcome has arrived: a node may be lost at any
    moment, and nothing is written twice or in part."""

    address: str
    options: SceneCompression
    _outcomes: dict[Path, Future[Outcome]] = field(default_factory=dict)
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
                    self._outcomes[target] = self._submit(runner, name, target, requested)
                except (KissgsError, OSError) as error:  # the command itself reports inputs that cannot be read
                    self._outcomes[target] = Future()
                    self._outcomes[target].set_exception(
                        error if isinstance(error, KissgsError) else OutputError(str(error))
                    )
            yield
        finally:
            try:
                runner.close()
            finally:
                for work in self._work.values():
                    shutil.rmtree(work, ignore_errors=True)

    def result(self, name: str, target: Path) -> Result:
        """Wait for the result of one scene, and move it to its place."""
        with progress_bar(self.options.quiet) as self._bar:
            outcome = self._outcomes[target].result()
        self._bar = silent
        if outcome.kind != "done":
            raise self._error(outcome, target)
        check_destination(target, overwrite=self.options.force, names=FILES)
        move_into_place(Path(outcome.result["written"]), target)
        return outcome.result["report"], Text.from_ansi(outcome.result["table"].removesuffix("\n"))

    def _request(self, runner: Runner, count: int) -> Resources:
        """Return the processors and GPUs of each of ``count`` scenes, which share all without ``--threads``."""
        processors = [node.cpus for node in runner.nodes] or [0]
        cpus = self.options.threads or max(1, int(min(*processors, sum(processors) // count)))
        requested = Resources(cpus, gpus=1 if self.options.device == "cuda" else 0)
        if refusal := runner.refusal(requested):
            raise UnsupportedError(f"{refusal}; choose another number with --threads, or --device cpu")
        return requested

    def _submit(self, runner: Runner, name: str, target: Path, requested: Resources) -> Future[Outcome]:
        options = self.options
        check_destination(target, overwrite=options.force, names=FILES)
        scene = Path(name).absolute()
        if not scene.is_dir():  # here, because a node would say of a missing file that it does not see it
            with open_scene_file(Path(name)):
                pass
        # The name of an output's work folder is always the same: a former command that was killed may have left one.
        digest = hashlib.sha256(os.fsencode(target.name)).hexdigest()
        work = self._work[target] = target.parent / f".kissgs.{digest[:16]}.part"
        shutil.rmtree(work, ignore_errors=True)
        work.mkdir(mode=0o700)
        file = scene_root(scene)
        size = file.stat().st_size if file.is_file() else 0
        resources = with_memory(runner, requested, self._memory(file, size))
        console = files.output()
        arguments = {
            "scene": str(scene),
            "bytes": size,
            "work": str(work.absolute()),
            "target": str(target),
            "options": options.model_copy(update={"threads": int(requested.cpus)}).model_dump(mode="json"),
            "width": console.width,
            "color": console.is_terminal,
        }

        def progress(stage: str, fraction: float, note: str = "") -> None:
            ended = sum(each.done() for each in list(self._outcomes.values()))
            details = f"{ended} of {len(self._outcomes)} scenes; {Path(name).name}: {stage}{note and f'; {note}'}"
            self._bar("scenes", ended / max(len(self._outcomes), 1), details)

        return runner.submit(WorkItem("kissgs.cli.compress_scenes:compress_scene", arguments, resources), progress)

    def _memory(self, scene: Path, size: int) -> int:
        """Return an estimate of the memory that a scene needs, bytes."""
        settings = self.options.settings
        goal_trains = settings.encode.has_goal and (self.options.views or settings.finetune.enabled is not False)
        trains = settings.compact.enabled or settings.finetune.enabled or goal_trains or settings.time_only
        plain = size if scene.suffix.lower() == ".ply" else PACKED_RATIO * size
        return PROCESS_BYTES + (TRAINING_RATIO if trains else MEMORY_RATIO) * plain

    def _error(self, outcome: Outcome, target: Path) -> KissgsError:
        """Return the exception of a scene that was not compressed, about its output and not about the work folder."""
        if outcome.code == INTERNAL:  # a bug, which should look like one
            sys.stderr.write(outcome.log)
        attempt = re.escape(str(self._work[target].absolute())) + r"/[^/]*/"
        message = re.sub(attempt, lambda found: f"{target.parent}/", outcome.message)
        return error_of(replace(outcome, message=message))


def with_memory(runner: Runner, requested: Resources, memory: int) -> Resources:
    """Return a request with memory, at most that of the largest node that has the rest of it."""
    nodes = [node.memory for node in runner.nodes if requested.fits(node)]
    resources = Resources(requested.cpus, min(memory, max(nodes, default=0)), requested.gpus)
    if refusal := runner.refusal(resources):
        raise UnsupportedError(refusal)
    return resources
