"""``compress_streamed``: a scene of any size becomes a streamed scene, within the memory of one chunk."""

from __future__ import annotations

import json
import shutil
import socket
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, wait
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from pydantic import TypeAdapter

from kissgs._version import __version__
from kissgs.core.context import Context, JobProgress, Progress, silent
from kissgs.core.errors import InvalidSceneError, OutputError, UnsupportedError
from kissgs.core.positions import middle_of, with_origin, world_positions
from kissgs.core.splats import Splats, blocks
from kissgs.formats import LEVELS_ENDING, LOD_NAME, MANIFESTS, ContainerName, named_manifest
from kissgs.io.files import reason_of
from kissgs.io.ply import read_ply_blocks, read_ply_info
from kissgs.io.scene_format import DEFAULT_READ_OPTIONS, ReadOptions
from kissgs.pipeline.limited_time import speed
from kissgs.pipeline.scene_files import AnyPath, read_scene, recognise, refuse_level, scene_root, stored_bytes
from kissgs.runners import PROCESS_BYTES, Resources, Runner, WorkItem, error_of
from kissgs.settings import EncodeSettings, Settings
from kissgs.streaming import build
from kissgs.streaming import work_folder as scratch
from kissgs.streaming.build import Blocks
from kissgs.streaming.work_folder import Layout

SECONDS = {
    False: {"partition": (0.0, 1.0), "merge": (0.0, 6.4), "images": (0.0, 8.6)},
    True: {"partition": (0.0, 1.0), "merge": (0.2, 6.4), "cameras": (1.2, 0.7), "images": (2.0, 27.0)},
}
"""Seconds of each stage on two processors, fixed and for each million Gaussians of degree 3, without and with
rate-distortion planning, that is, with the presets ``fast`` and ``balanced``."""


REPORT = "report.json"  # file of the work folder: the report, once everything is made
ENCODED_BYTES = 30  # upper estimate of the encoded bytes of a Gaussian with all its levels


@dataclass(frozen=True, slots=True, kw_only=True)
class StreamedReport:
    """Result of a streamed compression.

    Attributes:
        source_count: number of Gaussians of the input.
        changed: number of Gaussians that were removed or changed, by kind, as in :class:`kissgs.core.splats.Cleaned`,
            "invisible", those that no renderer draws, and "pruned_by_rd", those whose bits are worth more than their
            removal costs; the finest level has neither.
        counts: number of Gaussians of each level, the finest first.
        level_bytes: bytes of the files of each level.
        environment_count, environment_bytes: number of Gaussians in the environment, and bytes of its files; 0 without
            one. It belongs to every level, but is not counted there.
        chunks: number of chunks of the finest level.
        total_bytes: bytes of all files, the manifest included.
        note: what the user may not expect: what reading left out, coarse positions; empty if there is nothing to say.
    """

    source_count: int
    changed: dict[str, int]
    counts: tuple[int, ...]
    level_bytes: tuple[int, ...]
    environment_count: int
    environment_bytes: int
    chunks: int
    total_bytes: int
    note: str = ""


def compress_streamed(
    source: AnyPath,
    destination: AnyPath,
    *,
    settings: Settings | None = None,
    reading: ReadOptions = DEFAULT_READ_OPTIONS,
    overwrite: bool = False,
    runner: Runner | None = None,
    threads: int = 0,
    progress: Progress = silent,
) -> StreamedReport:
    """Compress a scene into a folder with a manifest, chunks and levels of detail.

    A ``.ply`` is read in blocks; other formats are decoded whole. Intermediate results are in a folder beside the
    destination that ends in ``.partial``; interrupted work goes on from there. It takes up to about twice the
    bytes of the scene as float32 numbers, and those of the result.

    Args:
        source: a scene of any format.
        destination: ``lod-meta.json`` in the folder to write, for SOG; or a folder whose name ends in ``.sogxt``, or
            ``levels.json`` in any folder, for SOG-XT.
        settings: settings of the encoder, without goal, compaction and fine-tuning; by default the preset "balanced".
        reading: options of reading.
        overwrite: replace the folder if it holds a streamed scene and nothing else.
        runner: engine for chunks and files, on machines that all see the folder; None to make one after another here.
            The bytes do not depend on it.
        threads: number of threads; 0 means one per processor, and one for each item of a runner. The bytes do not
            depend on it.
        progress: receives "scratch", whose note is the size of the work folder, and the stages "partition", "merge",
            "cameras" and "images" with the time left; raise :class:`kissgs.Cancelled` from it to stop.

    Raises:
        InvalidSceneError: the scene cannot be read, or has no Gaussians.
        OutputError: the folder cannot be written, holds something else, the disk has too little room, or the work
            folder belongs to other work or is in use.
        UnsupportedError: a setting does not fit.
    """
    source, manifest = Path(source), named_manifest(Path(destination))
    settings = Settings() if settings is None else settings
    if manifest is None:
        raise OutputError(
            f"{destination} is no name of a streamed scene; viewers look for {LOD_NAME} in a folder, and SOG-XT goes "
            f"into a folder that ends in {LEVELS_ENDING}"
        )
    if manifest.parent.name in ("", ".."):
        manifest = manifest.parent.resolve() / manifest.name
    container, work = MANIFESTS[manifest.name], scratch.work_folder(manifest)
    limited = settings.encode.has_goal or settings.time_limit is not None
    if settings.compact.enabled or settings.finetune.enabled or limited:
        raise UnsupportedError(
            "levels of detail are made without goals, time limits, compaction and fine-tuning; leave these out, or "
            "write a .sog"
        )
    if settings.encode.order == "plas":
        raise UnsupportedError("levels of detail need order=hilbert or order=refined, not plas")
    if scratch.read_json(work / REPORT) is None:
        scratch.check_destination(manifest, source, overwrite=overwrite)
    with scratch.claimed(work, {"container": container, **_identity(source, settings, reading)}):
        job = JobProgress(progress)
        if (found := scratch.read_json(work / REPORT)) is None:
            layout = _partition(work, source, container, settings, reading, threads, job)
            found = asdict(_make(work, layout, settings, runner, threads, job))
            scratch.write_json(work / REPORT, found)
        scratch.finish(work, manifest, source, overwrite=overwrite)
    job.stop()
    return TypeAdapter(StreamedReport).validate_python(found)


def _make(
    work: Path, layout: Layout, settings: Settings, runner: Runner | None, threads: int, progress: Progress
) -> StreamedReport:
    """Make all levels and files that are not in the work folder yet."""
    encode = settings.encode

    def run(stage: str, key: str, values: Sequence[int | str]) -> None:
        own_threads = threads if runner is None else max(1, threads)
        shared = {"work": str(work.absolute()), "settings": encode.model_dump(mode="json"), "threads": own_threads}
        items = [item for value in values if not _is_made(item := {**shared, key: value})]
        done = 1 - len(items) / len(values)

        def part(fraction: float) -> None:
            progress(stage, done + fraction * (1 - done))

        if runner is not None and items:
            _run_all(runner, items, layout, part)
            return
        for at, item in enumerate(items):
            part(at / len(items))
            context = Context(progress=lambda _, now, note="", at=at: part((at + now) / len(items)))
            run_item(item, context.stage(stage).progress)

    run("merge", "chunk", layout.filled)
    if encode.rate_distortion and not (work / scratch.CAMERAS).exists():
        progress("cameras", 0.0)
        build.make_cameras(work, layout, encode, threads)
    run("images", "file", [file.name for file in layout.all_files()])
    progress("images", 1.0)
    build.make_manifest(work, layout)
    return _report(work, layout)


# Work items: the levels of a chunk ("chunk"), or a container of the result ("file"). Those of a step do not depend on
# each other. One that is run twice, because its node was given up, writes the same bytes again.

MEMORY_RATIO = 5  # memory of an item for each byte of the Gaussians of its file as float32
POLL_SECONDS = 0.5  # seconds between reports of progress, which may also stop the work


def _is_made(item: dict[str, Any]) -> bool:
    file, of = (scratch.leaves_file, "chunk") if "chunk" in item else (scratch.rows_file, "file")
    return file(Path(item["work"]), item[of]).exists()


def run_item(item: dict[str, Any], progress: Progress) -> dict[str, Any]:
    """Run an item, here or on a node, unless it is made. A node that was given up may still be at work: what it
    completes meanwhile, it takes the input of."""
    work, threads = Path(item["work"]), item["threads"]
    if (layout := scratch.read_layout(work)) is None:
        raise UnsupportedError(
            f"the machine {socket.gethostname()} does not see {work}; "
            "--ray needs storage that all machines see at the same path"
        )
    if _is_made(item):
        return {}
    settings = EncodeSettings.model_validate(item["settings"])
    try:
        if "chunk" in item:
            build.make_levels(work, layout, item["chunk"], threads, progress)
        else:
            file = next(each for each in layout.all_files() if each.name == item["file"])
            build.make_file(work, layout, settings, file, threads, progress)
    except OutputError:
        if not _is_made(item):
            raise
    return {}


def _run_all(runner: Runner, items: list[dict[str, Any]], layout: Layout, report: Callable[[float], None]) -> None:
    """Run items and wait for them; if one fails, or the caller is stopped, the others are cancelled."""
    memory = PROCESS_BYTES + MEMORY_RATIO * max(layout.counts) * scratch.row_bytes(layout.sh_degree)
    requested = Resources(cpus=items[0]["threads"], memory=memory)
    if refusal := runner.refusal(requested):
        raise UnsupportedError(f"{refusal}; choose another number with --threads")
    outcomes = [runner.submit(WorkItem(f"{__name__}:run_item", item, requested)) for item in items]
    waiting = set(outcomes)
    try:
        while waiting:
            report(1 - len(waiting) / len(items))
            done, waiting = wait(waiting, POLL_SECONDS, FIRST_COMPLETED)
            for each in done:
                if each.result().kind != "done":
                    raise error_of(each.result())
    except BaseException:
        for outcome in outcomes:
            runner.cancel(outcome)
        wait(outcomes)
        raise


def _reader(source: Path, reading: ReadOptions, threads: int) -> tuple[Blocks, int, int]:
    """Return a function that reads the scene in blocks, the number of its Gaussians, and their SH degree."""
    if recognise(source) == "ply":
        source = scene_root(source)
        refuse_level("ply", source, reading.level)
        info = read_ply_info(source)
        if not info.compressed:
            origin = None
            if reading.origin == "auto":
                origin = middle_of(map(world_positions, read_ply_blocks(source)), info.count)

            def read() -> Iterator[Splats]:
                return (with_origin(reading.marked(block), origin) for block in read_ply_blocks(source))

            return read, info.count, info.sh_degree
    scene = read_scene(source, reading, threads=threads)
    return lambda: (scene.select(rows) for rows in blocks(len(scene))), len(scene), scene.sh_degree


def _identity(source: Path, settings: Settings, reading: ReadOptions) -> dict[str, Any]:
    """Return what the work depends on."""
    try:
        status = source.stat()
        path = str(source.resolve())
    except OSError as error:
        raise InvalidSceneError(f"cannot read {source}: {reason_of(error)}") from error
    return {
        "version": __version__,
        "source": path,
        "bytes": status.st_size,
        "modified_ns": status.st_mtime_ns,
        "reading": str(reading),
        "settings": settings.model_dump(mode="json"),
    }


def _partition(
    work: Path,
    source: Path,
    container: ContainerName,
    settings: Settings,
    reading: ReadOptions,
    threads: int,
    job: JobProgress,
) -> Layout:
    """Partition the scene, unless that has been done, and set the steps of the job."""
    if (layout := scratch.read_layout(work)) is not None:
        _announce(job, work, layout.source_count, layout.sh_degree, settings, threads)
        return layout
    before = _identity(source, settings, reading)
    try:
        (work / scratch.OUT).mkdir(exist_ok=True)
        blocks, count, sh_degree = _reader(source, reading, threads)
        needed, free = _needed_bytes(count, sh_degree), shutil.disk_usage(work).free
        if needed - sum(path.stat().st_size for path in work.rglob("*") if path.is_file()) > free:
            # Here only: later, files are deleted as others are written, so that the folder hardly grows.
            raise OutputError(
                f"{work} will take up to {megabytes(needed)}, but its disk has {megabytes(free)} free; "
                "free some, or write to another disk"
            )
        _announce(job, work, count, sh_degree, settings, threads)
        layout = build.partition(work, blocks, count, container, settings.encode, job)
        if not any(layout.counts):
            raise InvalidSceneError(f"{source} has no Gaussian that is finite and visible; there is nothing to write")
        if _identity(source, settings, reading) != before:
            raise InvalidSceneError(f"{source} was changed while it was read; run the same command again")
    except BaseException:
        scratch.remove(work)  # a partition that is not complete is of no use
        raise
    scratch.write_json(work / scratch.PARTITION, asdict(layout))  # which marks it as done
    return layout


def _announce(job: JobProgress, work: Path, count: int, sh_degree: int, settings: Settings, threads: int) -> None:
    """Set the steps of the job, and report the size of the work folder."""
    millions, stages = count / 1e6, SECONDS[settings.encode.rate_distortion]
    job.expect([(stage, (fixed + each * millions) / speed(threads)) for stage, (fixed, each) in stages.items()])
    needed = _needed_bytes(count, sh_degree)
    job("scratch", 1.0, f"{work} takes up to {megabytes(needed)} until the work is done")


def _needed_bytes(count: int, sh_degree: int) -> int:
    """Return the most bytes that the work folder takes: all levels as float32, a chunk once more, and the result."""
    return (2 * count + min(count, build.CHUNK)) * scratch.row_bytes(sh_degree) + count * ENCODED_BYTES


def megabytes(count: float) -> str:
    """Format bytes: "10,622 MB", and below one megabyte "34 kB"."""
    return f"{count / 1e6:,.0f} MB" if count >= 1e6 else f"{count / 1e3:,.0f} kB"


def _report(work: Path, layout: Layout) -> StreamedReport:
    out = work / scratch.OUT
    document = json.loads((out / layout.manifest).read_bytes())
    sizes = [0] * layout.levels
    for file in layout.files():
        path = out / layout.path(file.name)
        if path.exists():  # files without a visible Gaussian are not written
            sizes[file.level] += stored_bytes(path)
    environment = out / layout.path(scratch.ENVIRONMENT)
    environment_count = sum(scratch.read_counts(work, scratch.ENVIRONMENT)["counts"]) if environment.exists() else 0
    environment_bytes = stored_bytes(environment) if environment.exists() else 0
    pruned = sum(layout.counts) + layout.environment - document["counts"][0] - environment_count
    return StreamedReport(
        source_count=layout.source_count,
        changed={**layout.changed, "pruned_by_rd": pruned},
        counts=tuple(document["counts"]),
        level_bytes=tuple(sizes),
        environment_count=environment_count,
        environment_bytes=environment_bytes,
        chunks=len(layout.filled),
        note="; ".join(filter(None, [*layout.notes, build.coarse_note(work, layout)])),
        total_bytes=sum(sizes) + environment_bytes + (out / layout.manifest).stat().st_size,
    )
