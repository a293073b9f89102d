"""Work items that turn a scene into a streamed scene: partition, levels of a chunk, one file, the manifest.

Every item reads and writes files of the work folder, and the last file that it writes marks it as done. So interrupted
work goes on where it was, and items may run in any process that sees the folder.
"""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from kissgs.core.progress import Progress, silent
from kissgs.core.splats import SH_REST_COUNTS, Splats, clean, empty_splats
from kissgs.io.atomic import atomic_file
from kissgs.planning.planner import plan_encoding, visible_gaussians
from kissgs.settings import EncodeSettings
from kissgs.sog.container_model import SOG
from kissgs.sog.encode import write_files
from kissgs.sog.names import LOD_NAME, META_NAME
from kissgs.sogxt.container import write_container
from kissgs.streaming.levels import chunk_levels, level_count
from kissgs.streaming.manifest import Leaf, lod_meta
from kissgs.streaming.partition import Cuts, chunk_depth, sampled_positions
from kissgs.streaming.rows import append_rows, from_rows, read_rows, sync, to_rows, write_rows
from kissgs.streaming.sensitivities import cameras_json, cameras_of, choose_cameras, measure_file

Blocks = Callable[[], Iterable[Splats]]
"""Function that reads the scene from its beginning, some Gaussians at a time."""

CHUNK = 400_000
"""Largest number of Gaussians in a chunk, but for the scatter of estimated medians."""

LEAF, MOST_LEAVES = 32_768, 512
"""Largest number of Gaussians in a leaf; and about that of leaves, because the manifest takes up to 700 bytes for each:
large scenes have larger leaves."""

COARSEST = 50_000
"""Largest number of Gaussians in the coarsest level, which with the manifest makes a viewer's first image."""

CONTEXT = 280_000
"""Largest number of Gaussians of the level that stands for other chunks where sensitivity is measured."""

COARSER_DB = 6.0
"""Decibels by which coarser levels are encoded less accurately, with rate-distortion planning."""

COARSER_STEPS = 1.5
"""Steps of coarser levels of SH degree 0 in units of the finest level's, without rate-distortion planning."""

PARTITION, CAMERAS, OUT = "partition.json", "cameras.json", "out"
"""Names in the work folder: the marker of the partition, the cameras, and the folder of the result."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Layout:
    """Sizes of a streamed scene.

    Attributes:
        source_count: number of Gaussians before cleaning.
        sh_degree: 0 to 3.
        counts: number of Gaussians in each chunk.
        depth: number of cuts one after another; there are 2^depth chunks.
        levels: number of levels.
        leaf: largest number of Gaussians in a leaf.
        changed: number of Gaussians that cleaning removed or changed, by kind, and of those that are invisible.
    """

    source_count: int
    sh_degree: int
    counts: tuple[int, ...]
    depth: int
    levels: int
    leaf: int
    changed: dict[str, int]

    @property
    def filled(self) -> list[int]:
        """Chunks that have Gaussians."""
        return [chunk for chunk, count in enumerate(self.counts) if count]

    @property
    def context(self) -> int:
        """Level that stands for other chunks where sensitivity is measured: the finest of few Gaussians."""
        total = sum(self.counts)
        return next((level for level in range(self.levels) if total >> level <= CONTEXT), self.levels - 1)

    def members(self, level: int, file: int) -> range:
        """Return the chunks in a file of a level: twice as many as in one of the level before, up to all."""
        size = 1 << min(level, self.depth)
        return range(file * size, (file + 1) * size)

    def files(self) -> list[tuple[int, int]]:
        """Return level and number of every file, the coarsest level first."""
        return [
            (level, file)
            for level in reversed(range(self.levels))
            for file in range(1 << (self.depth - min(level, self.depth)))
            if any(self.counts[chunk] for chunk in self.members(level, file))
        ]


def read_layout(work: Path) -> Layout:
    """Return the layout of a scene that is partitioned."""
    found = json.loads((work / PARTITION).read_bytes())
    return Layout(**{**found, "counts": tuple(found["counts"])})


def partition(work: Path, blocks: Blocks, count: int, settings: EncodeSettings, progress: Progress = silent) -> Layout:
    """Split a scene into chunks, one file of rows each, in two passes; return the layout.

    Args:
        work: the work folder.
        blocks: reads the scene.
        count: number of Gaussians in it before cleaning.
        settings: settings of the encoder, which say whether invisible Gaussians are left out.
        progress: receives "partition".
    """
    depth, done = chunk_depth(count, CHUNK), 0

    def counted() -> Iterator[Splats]:
        nonlocal done
        for block in blocks():
            yield block
            done += len(block)
            progress("partition", done / (2 * count))

    cuts = Cuts.of(sampled_positions((clean(block)[0].means for block in counted()), count), depth)
    for chunk in range(cuts.chunks):
        _chunk_file(work, chunk).unlink(missing_ok=True)
    counts, sh_degree, changed = np.zeros(cuts.chunks, np.int64), 0, Counter[str]()
    for block in counted():
        splats, cleaned = clean(block)
        visible = visible_gaussians(splats, settings)
        changed.update({**cleaned.as_dict(), "invisible": len(splats) - len(visible)})
        splats, sh_degree = splats.select(visible), splats.sh_degree
        chunks = cuts.chunk_of(splats.means)
        rows = to_rows(splats)
        for chunk in np.unique(chunks):
            some = rows[chunks == chunk]
            append_rows(_chunk_file(work, int(chunk)), some)
            counts[chunk] += len(some)
    total = int(counts.sum())
    layout = Layout(
        source_count=count,
        sh_degree=sh_degree,
        counts=tuple(map(int, counts)),
        depth=depth,
        levels=level_count(total, COARSEST),
        leaf=max(LEAF, -(-total // MOST_LEAVES)),
        changed=dict(changed),
    )
    for chunk in layout.filled:
        sync(_chunk_file(work, chunk))
    return layout


def keep_layout(work: Path, layout: Layout) -> None:
    """Write the layout, which marks the partition as done."""
    _write_json(work / PARTITION, asdict(layout))


def has_levels(work: Path, chunk: int) -> bool:
    """Return whether a chunk's levels are complete."""
    return _leaves_file(work, chunk).exists()


def make_levels(work: Path, layout: Layout, chunk: int, threads: int) -> None:
    """Merge a chunk into its levels, one file of rows each."""
    rows = read_rows(_chunk_file(work, chunk), layout.sh_degree, layout.counts[chunk])
    made = chunk_levels(from_rows(rows), layout.levels, layout.leaf, threads)
    for level, splats in enumerate(made.levels):
        write_rows(_level_file(work, chunk, level), to_rows(splats))
    _write_json(
        _leaves_file(work, chunk), {"counts": made.counts, "bounds": made.bounds.tolist(), "errors": made.errors}
    )
    _chunk_file(work, chunk).unlink(missing_ok=True)


def has_file(work: Path, level: int, file: int) -> bool:
    """Return whether a file is complete."""
    return _rows_file(work, level, file).exists()


def make_cameras(work: Path, layout: Layout, settings: EncodeSettings, threads: int) -> None:
    """Choose the cameras that sensitivity is measured with, and write them to a file."""
    coarsest = _read_level(work, layout, layout.levels - 1, layout.filled)
    total = sum(layout.counts)
    cameras = choose_cameras(coarsest, len(layout.filled), total, settings, threads)
    _write_json(work / CAMERAS, cameras_json(cameras))


def has_cameras(work: Path) -> bool:
    """Return whether the cameras are chosen."""
    return (work / CAMERAS).exists()


def make_file(work: Path, layout: Layout, settings: EncodeSettings, level: int, file: int, threads: int) -> None:
    """Encode the Gaussians of one level of some chunks."""
    members = [chunk for chunk in layout.members(level, file) if layout.counts[chunk]]
    splats = _read_level(work, layout, level, members)
    counts = [count for chunk in members for count in _leaves(work, chunk)["counts"][level]]
    groups = np.repeat(np.arange(len(counts)), counts).astype(np.uint16)
    settings = file_settings(settings, level, layout.sh_degree)
    stored = [0] * len(counts)
    if len(visible_gaussians(splats, settings)):  # merging may have made all of them invisible
        sensitivity = None
        if settings.rate_distortion:
            others = _read_level(work, layout, layout.context, sorted({*layout.filled} - {*members}))
            cameras = cameras_of(json.loads((work / CAMERAS).read_bytes()))
            sensitivity = measure_file(splats, others, cameras, level, settings, threads)
            del others
        plan = plan_encoding(
            splats, settings, sensitivity=sensitivity, container=SOG, groups=groups, keep_costs=False, threads=threads
        )
        del sensitivity, splats
        encoded = write_files(plan, settings, threads=threads)
        write_container(encoded.files, work / OUT / f"{level}_{file}", overwrite=True)
        stored = np.bincount(groups[encoded.order], minlength=len(counts)).tolist()
    _write_json(_rows_file(work, level, file), {"counts": stored})
    if level != layout.context:
        for chunk in members:
            _level_file(work, chunk, level).unlink(missing_ok=True)


def _read_level(work: Path, layout: Layout, level: int, chunks: Sequence[int]) -> Splats:
    """Return the Gaussians of a level of some chunks."""
    rows = [
        read_rows(_level_file(work, chunk, level), layout.sh_degree, sum(_leaves(work, chunk)["counts"][level]))
        for chunk in chunks
    ]
    return from_rows(np.concatenate(rows)) if rows else empty_splats(0, SH_REST_COUNTS[layout.sh_degree])


def file_settings(settings: EncodeSettings, level: int, sh_degree: int) -> EncodeSettings:
    """Return the settings of the files of a level.

    There is one class of steps: within each leaf, classes would have an order of their own, which costs 5 % of the
    bytes. Coarser levels are encoded less accurately, because the error of merging is larger than that of the finest
    level's encoding; where there is no codebook that could be smaller, the steps are larger. docs/method/streaming.md
    has what it saves and costs.
    """
    settings = settings.model_copy(update={"step_classes": 1})
    if level == 0:
        return settings
    if settings.rate_distortion:
        return settings.model_copy(update={"quality_offset_db": settings.quality_offset_db - COARSER_DB})
    changes = {"means_tolerance": min(1.0, 2 * settings.means_tolerance)}
    if sh_degree > 0:
        changes["gaussians_per_codebook_entry"] = min(4096.0, 2 * settings.gaussians_per_codebook_entry)
    else:
        steps = ("opacity_step", "scale_step", "quat_step", "sh0_step")
        changes |= {name: COARSER_STEPS * getattr(settings, name) for name in steps}
    return settings.model_copy(update=changes)


def make_manifest(work: Path, layout: Layout) -> None:
    """Write the manifest of all files."""
    lods: dict[tuple[int, int], dict[int, tuple[int, int, int]]] = {}
    filenames: list[str] = []
    for level, file in layout.files():
        counts = json.loads(_rows_file(work, level, file).read_bytes())["counts"]
        offset, at = 0, 0
        for chunk in layout.members(level, file):
            for leaf in range(len(_leaves(work, chunk)["bounds"]) if layout.counts[chunk] else 0):
                if counts[at]:
                    lods.setdefault((chunk, leaf), {})[level] = (len(filenames), offset, counts[at])
                offset, at = offset + counts[at], at + 1
        if any(counts):
            filenames.append(f"{level}_{file}/{META_NAME}")
    leaves = []
    for chunk in layout.filled:
        own = _leaves(work, chunk)
        for leaf, (bounds, errors) in enumerate(zip(own["bounds"], own["errors"], strict=True)):
            if (chunk, leaf) in lods:  # some Gaussian of it is visible
                leaves.append(Leaf(np.array(bounds), dict(sorted(lods[chunk, leaf].items())), errors))
    with atomic_file(work / OUT / LOD_NAME, overwrite=True) as out:
        out.write(lod_meta(leaves, layout.levels, filenames))


def _leaves(work: Path, chunk: int) -> dict[str, Any]:
    """Return the bounds and errors of a chunk's leaves, and their counts by level."""
    return json.loads(_leaves_file(work, chunk).read_bytes())


def _chunk_file(work: Path, chunk: int) -> Path:
    return work / f"chunk_{chunk}.f32"


def _level_file(work: Path, chunk: int, level: int) -> Path:
    return work / f"chunk_{chunk}_level_{level}.f32"


def _leaves_file(work: Path, chunk: int) -> Path:
    return work / f"chunk_{chunk}.json"


def _rows_file(work: Path, level: int, file: int) -> Path:
    return work / f"file_{level}_{file}.json"


def _write_json(path: Path, values: object) -> None:
    with atomic_file(path, overwrite=True) as file:
        file.write(json.dumps(values, separators=(",", ":")).encode())
