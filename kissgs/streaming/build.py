"""Work items that turn a scene into a streamed scene: partition, levels of a chunk, one file, the manifest.

Every item reads and writes files of the work folder, and the last file that it writes marks it as done. So interrupted
work goes on where it was, and items may run in any process that sees the folder.
"""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from kissgs.core.progress import Progress, silent
from kissgs.core.splats import Splats, clean
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
from kissgs.streaming.rows import append_rows, from_rows, read_rows, to_rows

Blocks = Callable[[], Iterable[Splats]]
"""Function that reads the scene from its beginning, some Gaussians at a time."""

CHUNK = 400_000
"""Largest number of Gaussians in a chunk, but for the scatter of estimated medians."""

LEAF, MOST_LEAVES = 32_768, 1024
"""Largest number of Gaussians in a leaf; and of leaves, so that large scenes have larger leaves."""

COARSEST = 70_000
"""Largest number of Gaussians in the coarsest level."""

PARTITION, OUT = "partition.json", "out"
"""Names in the work folder: the marker of the partition, and the folder of the result."""


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
    _write_json(work / PARTITION, asdict(layout))
    return layout


def has_levels(work: Path, chunk: int) -> bool:
    """Return whether a chunk's levels are complete."""
    return _leaves_file(work, chunk).exists()


def make_levels(work: Path, layout: Layout, chunk: int, threads: int) -> None:
    """Merge a chunk into its levels, one file of rows each."""
    made = chunk_levels(
        from_rows(read_rows(_chunk_file(work, chunk), layout.sh_degree)), layout.levels, layout.leaf, threads
    )
    for level, splats in enumerate(made.levels):
        path = _level_file(work, chunk, level)
        path.unlink(missing_ok=True)
        append_rows(path, to_rows(splats))
    _write_json(
        _leaves_file(work, chunk), {"counts": made.counts, "bounds": made.bounds.tolist(), "errors": made.errors}
    )
    _chunk_file(work, chunk).unlink()


def has_file(work: Path, level: int, file: int) -> bool:
    """Return whether a file is complete."""
    return _rows_file(work, level, file).exists()


def make_file(work: Path, layout: Layout, settings: EncodeSettings, level: int, file: int, threads: int) -> None:
    """Encode the Gaussians of one level of some chunks."""
    members = [chunk for chunk in layout.members(level, file) if layout.counts[chunk]]
    rows = np.concatenate([read_rows(_level_file(work, chunk, level), layout.sh_degree) for chunk in members])
    counts = [count for chunk in members for count in _leaves(work, chunk)["counts"][level]]
    groups = np.repeat(np.arange(len(counts)), counts).astype(np.uint16)
    splats = from_rows(rows)
    del rows
    settings = settings if level == 0 else coarse_settings(settings)
    stored = [0] * len(counts)
    if len(visible_gaussians(splats, settings)):  # merging may have made all of them invisible
        plan = plan_encoding(splats, settings, container=SOG, groups=groups, keep_costs=False, threads=threads)
        encoded = write_files(plan, settings, threads=threads)
        write_container(encoded.files, work / OUT / f"{level}_{file}", overwrite=True)
        stored = np.bincount(groups[encoded.order], minlength=len(counts)).tolist()
    _write_json(_rows_file(work, level, file), {"counts": stored})
    for chunk in members:
        _level_file(work, chunk, level).unlink()


def coarse_settings(settings: EncodeSettings) -> EncodeSettings:
    """Return settings for merged Gaussians: the error of merging is larger than that of the finest level's encoding.

    Levels of 1/2 and 1/4, seen from 2 and 4 times the distance, take 10 and 13 % fewer bytes for it on the captures
    of docs/method/streaming.md, and lose 0.1 to 0.4 dB to the original.
    """
    return settings.model_copy(
        update={
            "gaussians_per_codebook_entry": min(4096.0, 2 * settings.gaussians_per_codebook_entry),
            "means_tolerance": min(1.0, 2 * settings.means_tolerance),
        }
    )


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
    for chunk in (chunk for chunk, size in enumerate(layout.counts) if size):
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
