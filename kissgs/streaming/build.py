"""Work items that turn a scene into a streamed scene: partition, levels of a chunk, one file, the manifest.

Every item reads and writes files of the work folder, and the last file that it writes marks it as done. So interrupted
work goes on where it was, and items may run in any process that sees the folder.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from kissgs.core.array_types import Float32
from kissgs.core.splats import Splats, clean
from kissgs.io.atomic import atomic_file
from kissgs.planning.planner import plan_encoding
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
        sh_degree: 0 to 3.
        counts: number of Gaussians in each chunk.
        depth: number of cuts one after another; there are 2^depth chunks.
        levels: number of levels.
        leaf: largest number of Gaussians in a leaf.
    """

    sh_degree: int
    counts: tuple[int, ...]
    depth: int
    levels: int
    leaf: int

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


def partition(work: Path, blocks: Blocks, count: int) -> Layout:
    """Split a scene into chunks, one file of rows each, in two passes; return the layout.

    Args:
        work: the work folder.
        blocks: reads the scene.
        count: number of Gaussians in it before cleaning.
    """
    depth = chunk_depth(count, CHUNK)
    cuts = Cuts.of(sampled_positions((_finite(block) for block in blocks()), count), depth)
    for chunk in range(cuts.chunks):
        _chunk_file(work, chunk).unlink(missing_ok=True)
    counts, sh_degree = np.zeros(cuts.chunks, np.int64), 0
    for block in blocks():
        splats, _ = clean(block)
        sh_degree = splats.sh_degree
        chunks = cuts.chunk_of(splats.means)
        rows = to_rows(splats)
        for chunk in np.unique(chunks):
            some = rows[chunks == chunk]
            append_rows(_chunk_file(work, int(chunk)), some)
            counts[chunk] += len(some)
    total = int(counts.sum())
    layout = Layout(
        sh_degree=sh_degree,
        counts=tuple(map(int, counts)),
        depth=depth,
        levels=level_count(total, COARSEST),
        leaf=max(LEAF, -(-total // MOST_LEAVES)),
    )
    _write_json(work / PARTITION, asdict(layout))
    return layout


def _finite(block: Splats) -> Float32[np.ndarray, "n 3"]:
    return clean(block)[0].means


def make_levels(work: Path, layout: Layout, chunk: int, threads: int) -> None:
    """Merge a chunk into its levels, one file of rows each."""
    done = _leaves_file(work, chunk)
    if done.exists() or not layout.counts[chunk]:
        return
    made = chunk_levels(
        from_rows(read_rows(_chunk_file(work, chunk), layout.sh_degree)), layout.levels, layout.leaf, threads
    )
    for level, splats in enumerate(made.levels):
        path = _level_file(work, chunk, level)
        path.unlink(missing_ok=True)
        append_rows(path, to_rows(splats))
    _write_json(done, {"counts": made.counts, "bounds": made.bounds.tolist()})
    _chunk_file(work, chunk).unlink()


def make_file(work: Path, layout: Layout, settings: EncodeSettings, level: int, file: int, threads: int) -> None:
    """Encode the Gaussians of one level of some chunks."""
    done = work / f"file_{level}_{file}.json"
    if done.exists():
        return
    members = [chunk for chunk in layout.members(level, file) if layout.counts[chunk]]
    rows = np.concatenate([read_rows(_level_file(work, chunk, level), layout.sh_degree) for chunk in members])
    counts = [count for chunk in members for count in _leaves(work, chunk)["counts"][level]]
    groups = np.repeat(np.arange(len(counts)), counts).astype(np.uint16)
    plan = plan_encoding(from_rows(rows), settings, container=SOG, groups=groups, keep_costs=False, threads=threads)
    encoded = write_files(plan, settings, threads=threads)
    write_container(encoded.files, work / OUT / f"{level}_{file}", overwrite=True)
    _write_json(done, {"counts": np.bincount(groups[encoded.order], minlength=len(counts)).tolist()})


def make_manifest(work: Path, layout: Layout) -> None:
    """Write the manifest of all files."""
    lods: dict[tuple[int, int], dict[int, tuple[int, int, int]]] = {}
    filenames: list[str] = []
    for level, file in layout.files():
        counts = json.loads((work / f"file_{level}_{file}.json").read_bytes())["counts"]
        offset, at = 0, 0
        for chunk in layout.members(level, file):
            for leaf in range(len(_leaves(work, chunk)["bounds"]) if layout.counts[chunk] else 0):
                if counts[at]:
                    lods.setdefault((chunk, leaf), {})[level] = (len(filenames), offset, counts[at])
                offset, at = offset + counts[at], at + 1
        filenames.append(f"{level}_{file}/{META_NAME}")
    leaves = [
        Leaf(np.array(bounds), dict(sorted(lods.get((chunk, leaf), {}).items())))
        for chunk in range(len(layout.counts))
        if layout.counts[chunk]
        for leaf, bounds in enumerate(_leaves(work, chunk)["bounds"])
    ]
    with atomic_file(work / OUT / LOD_NAME, overwrite=True) as out:
        out.write(lod_meta(leaves, layout.levels, filenames))


def _leaves(work: Path, chunk: int) -> dict[str, Any]:
    """Return the bounds of a chunk's leaves, and their counts by level."""
    return json.loads(_leaves_file(work, chunk).read_bytes())


def _chunk_file(work: Path, chunk: int) -> Path:
    return work / f"chunk_{chunk}.f32"


def _level_file(work: Path, chunk: int, level: int) -> Path:
    return work / f"chunk_{chunk}_level_{level}.f32"


def _leaves_file(work: Path, chunk: int) -> Path:
    return work / f"chunk_{chunk}.json"


def _write_json(path: Path, values: object) -> None:
    with atomic_file(path, overwrite=True) as file:
        file.write(json.dumps(values, separators=(",", ":")).encode())
