"""``compress_streamed``: a scene of any size becomes a streamed SOG, within the memory of one chunk."""

from __future__ import annotations

import json
import shutil
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from kissgs._version import __version__
from kissgs.core.errors import OutputError, UnsupportedError
from kissgs.core.progress import Progress, silent
from kissgs.core.splats import BLOCK
from kissgs.io.atomic import atomic_file, path_state, reason_of
from kissgs.io.ply import read_ply_blocks, read_ply_info
from kissgs.pipeline.read_options import DEFAULT_READ_OPTIONS, ReadOptions
from kissgs.pipeline.scene_files import read_scene
from kissgs.pipeline.scene_formats import recognise
from kissgs.settings import Settings
from kissgs.sog.names import LOD_NAME
from kissgs.streaming import build
from kissgs.streaming.build import Blocks, Layout

WORK, REPORT = "work.json", "report.json"
"""Files of the work folder: which work it belongs to; the report, once everything is made."""

OUT, REPLACED = build.OUT, "replaced"
"""Folders of the work folder: the result, and what it replaces."""


@dataclass(frozen=True, slots=True, kw_only=True)
class StreamedReport:
    """Result of a streamed compression.

    Attributes:
        source_count: number of Gaussians of the input.
        counts: number of Gaussians of each level, the finest first.
        level_bytes: bytes of the files of each level.
        chunks: number of chunks of the finest level.
        total_bytes: bytes of all files, the manifest included.
    """

    source_count: int
    counts: tuple[int, ...]
    level_bytes: tuple[int, ...]
    chunks: int
    total_bytes: int


def compress_streamed(
    source: Path,
    destination: Path,
    settings: Settings,
    *,
    reading: ReadOptions = DEFAULT_READ_OPTIONS,
    overwrite: bool = False,
    threads: int = 0,
    progress: Progress = silent,
) -> StreamedReport:
    """Compress a scene into a folder with ``lod-meta.json``, chunks and levels of detail.

    A ``.ply`` is read in blocks; other formats are decoded whole. Intermediate results are in a folder beside the
    destination that ends in ``.partial``; interrupted work goes on from there. It takes up to three times the bytes of
    the scene as float32 numbers.

    Args:
        source: a scene of any format.
        destination: ``lod-meta.json`` in the folder to write.
        settings: settings of the encoder, without goal, compaction and fine-tuning.
        reading: options of reading.
        overwrite: replace the folder if it holds a streamed scene.
        threads: number of threads; 0 means one per processor. The bytes do not depend on it.
        progress: receives the stages "partition", "merge" and "images"; raise :class:`kissgs.Cancelled` from it to
            stop.

    Raises:
        OutputError: the folder cannot be written, holds something else, or the work folder belongs to other work.
        UnsupportedError: a setting does not fit.
    """
    folder = destination.parent
    work = folder.with_name(f"{folder.name}.partial")
    _check_settings(settings)
    if not (work / REPORT).exists():
        _check_folder(folder, overwrite)
    _claim(work, source, settings, reading)
    if (found := _read_json(work / REPORT)) is not None:
        _finish(work, folder)
        return StreamedReport(**{**found, "counts": tuple(found["counts"]), "level_bytes": tuple(found["level_bytes"])})
    blocks, count = _reader(source, reading, threads)
    layout = _partition(work, blocks, count, progress)
    chunks = [chunk for chunk, size in enumerate(layout.counts) if size]
    for at, chunk in enumerate(chunks):
        progress("merge", at / len(chunks))
        build.make_levels(work, layout, chunk, threads)
    progress("merge", 1.0)
    files = layout.files()
    for at, (level, file) in enumerate(files):
        progress("images", at / len(files), f"level {level}, file {file}")
        build.make_file(work, layout, settings.encode, level, file, threads)
    progress("images", 1.0)
    build.make_manifest(work, layout)
    report = _report(work, layout, count, len(chunks))
    with atomic_file(work / REPORT) as done:
        done.write(json.dumps(asdict(report)).encode())
    _finish(work, folder)
    return report


def _check_settings(settings: Settings) -> None:
    """Refuse settings that do not fit, before any work."""
    if settings.compact.enabled or settings.finetune.enabled or settings.encode.has_goal:
        raise UnsupportedError(
            "levels of detail are made without goals, compaction and fine-tuning; leave these out, or write a .sog"
        )
    if settings.encode.order != "hilbert":
        raise UnsupportedError(f"levels of detail need order=hilbert, not {settings.encode.order}")


def _check_folder(folder: Path, overwrite: bool) -> None:
    """Refuse to replace anything but a streamed scene, and that only if allowed."""
    present, is_folder = path_state(folder)
    if present and not is_folder:
        raise OutputError(f"{folder} is a file; name {LOD_NAME} in a new folder")
    if present and any(folder.iterdir()):
        if not (folder / LOD_NAME).is_file():
            raise OutputError(f"{folder} holds other files; name {LOD_NAME} in a new folder")
        if not overwrite:
            raise OutputError(f"{folder / LOD_NAME} exists already; choose another name or allow overwriting (--force)")


def _reader(source: Path, reading: ReadOptions, threads: int) -> tuple[Blocks, int]:
    """Return a function that reads the scene in blocks, and the number of its Gaussians."""
    if recognise(source) == "ply":
        info = read_ply_info(source)
        if not info.compressed:
            return lambda: read_ply_blocks(source), info.count
    scene = read_scene(source, reading, threads=threads)
    starts = range(0, len(scene), BLOCK)
    return lambda: (scene.select(slice(start, start + BLOCK)) for start in starts), len(scene)


def _claim(work: Path, source: Path, settings: Settings, reading: ReadOptions) -> None:
    """Make the work folder, or check that the one that is there belongs to the same work.

    Raises:
        OutputError: it belongs to other work, or cannot be written.
    """
    try:
        status = source.stat()
        mine = {
            "version": __version__,
            "source": str(source.resolve()),
            "bytes": status.st_size,
            "modified_ns": status.st_mtime_ns,
            "reading": str(reading),
            "settings": settings.model_dump(mode="json"),
        }
        if work.exists():
            found = _read_json(work / WORK)
            if found != mine:
                raise OutputError(f"{work} belongs to other or older work; delete it, or choose another name")
            for left in (*work.glob(".kissgs.*"), *(work / OUT).glob(".kissgs.*")):  # of a process that was killed
                shutil.rmtree(left) if left.is_dir() else left.unlink()
            return
        (work / OUT).mkdir(parents=True)
    except OSError as error:
        raise OutputError(f"cannot use {work}: {reason_of(error)}") from error
    with atomic_file(work / WORK) as file:
        file.write(json.dumps(mine).encode())


def _read_json(path: Path) -> Any:  # noqa: ANN401  any JSON
    try:
        return json.loads(path.read_bytes())
    except (OSError, ValueError):
        return None


def _partition(work: Path, blocks: Blocks, count: int, progress: Progress) -> Layout:
    """Partition the scene, unless that has been done."""
    found = _read_json(work / build.PARTITION)
    if found is not None:
        return Layout(**{**found, "counts": tuple(found["counts"])})
    progress("partition", 0.0)
    layout = build.partition(work, blocks, count)
    progress("partition", 1.0)
    return layout


def _report(work: Path, layout: Layout, source_count: int, chunks: int) -> StreamedReport:
    out = work / OUT
    document = json.loads((out / LOD_NAME).read_bytes())
    sizes = [0] * layout.levels
    for level, file in layout.files():
        sizes[level] += sum(path.stat().st_size for path in (out / f"{level}_{file}").iterdir())
    return StreamedReport(
        source_count=source_count,
        counts=tuple(document["counts"]),
        level_bytes=tuple(sizes),
        chunks=chunks,
        total_bytes=sum(sizes) + (out / LOD_NAME).stat().st_size,
    )


def _finish(work: Path, folder: Path) -> None:
    """Move the result into place, and delete the work folder; may be repeated after an interruption anywhere.

    What the result replaces is in the work folder until the result is in place.
    """
    out, replaced = work / OUT, work / REPLACED
    try:
        if out.exists():
            if folder.exists():
                folder.rename(replaced)
            out.rename(folder)
        shutil.rmtree(work)
    except OSError as error:
        raise OutputError(f"cannot write {folder}: {reason_of(error)}") from error
