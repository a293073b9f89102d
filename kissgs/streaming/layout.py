"""``Layout``: sizes of a streamed scene; and the files of its work folder."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from kissgs.core.origin import Origin
from kissgs.formats import MANIFESTS, ContainerName
from kissgs.io.containers import META_NAME
from kissgs.io.files import atomic_file

CONTEXT = 280_000
"""Largest number of Gaussians of the level that stands for other chunks where sensitivity is measured."""

PARTITION, CAMERAS, OUT = "partition.json", "cameras.json", "out"
"""Names in the work folder: the marker of the partition, the cameras, and the folder of the result."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Layout:
    """Sizes of a streamed scene.

    Attributes:
        container: container of the files.
        source_count: number of Gaussians before cleaning.
        sh_degree: 0 to 3.
        counts: number of Gaussians in each chunk.
        depth: number of cuts one after another; there are 2^depth chunks.
        levels: number of levels.
        leaf: largest number of Gaussians in a leaf.
        environment: number of Gaussians in the environment; 0 without one.
        changed: number of Gaussians that cleaning removed or changed, by kind, and of those that are invisible.
        notes: what reading the scene left out or changed, and where its positions are.
        origin: see :class:`kissgs.Splats`.
        antialiased: see :class:`kissgs.Splats`.
    """

    container: ContainerName
    source_count: int
    sh_degree: int
    counts: tuple[int, ...]
    depth: int
    levels: int
    leaf: int
    environment: int
    changed: dict[str, int]
    notes: tuple[str, ...]
    origin: Origin
    antialiased: bool = False

    @property
    def filled(self) -> list[int]:
        """Chunks that have Gaussians."""
        return [chunk for chunk, count in enumerate(self.counts) if count]

    @property
    def manifest(self) -> str:
        """File name of the manifest."""
        return next(name for name, container in MANIFESTS.items() if container == self.container)

    @property
    def context(self) -> int:
        """Level that stands for other chunks where sensitivity is measured: the finest of few Gaussians."""
        total = sum(self.counts)
        return next((level for level in range(self.levels) if total >> level <= CONTEXT), self.levels - 1)

    def path(self, level: int, file: int) -> str:
        """Return the name of a container in the folder of the result: that of a folder for SOG, else of a zip."""
        return f"{level}_{file}" if self.container == "sog" else f"{level}_{file}.zip"

    def entry(self, path: str) -> str:
        """Return how the manifest names a container of this name."""
        return f"{path}/{META_NAME}" if self.container == "sog" else path

    @property
    def environment_path(self) -> str:
        """Name of the environment's container in the folder of the result, see :meth:`path`."""
        return "environment" if self.container == "sog" else "environment.zip"

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


def work_folder(manifest: Path) -> Path:
    """Return the work folder of a streamed scene, given its manifest."""
    folder = manifest.parent if manifest.parent.name not in ("", "..") else manifest.parent.resolve()
    return folder.parent / f"{folder.name}.partial"


def continuation(work: Path) -> str:
    """Return what the same command does after the work has ended early: all that follows the partition is kept."""
    return f"the same command {'goes on where it was' if (work / PARTITION).exists() else 'begins anew'}"


def read_layout(work: Path) -> Layout:
    """Return the layout of a scene that is partitioned."""
    found = json.loads((work / PARTITION).read_bytes())
    return Layout(**{**found, **{name: tuple(found[name]) for name in ("counts", "notes", "origin")}})


def keep_layout(work: Path, layout: Layout) -> None:
    """Write the layout, which marks the partition as done."""
    write_json(work / PARTITION, asdict(layout))


def read_leaves(work: Path, chunk: int) -> dict[str, Any]:
    """Return the bounds and errors of a chunk's leaves, and their counts by level."""
    return json.loads(leaves_file(work, chunk).read_bytes())


def chunk_file(work: Path, chunk: int) -> Path:
    """Return the file of the Gaussians of a chunk, until its levels are made."""
    return work / f"chunk_{chunk}.f32"


def environment_file(work: Path) -> Path:
    """Return the file of the Gaussians of the environment."""
    return work / "environment.f32"


def environment_marker(work: Path) -> Path:
    """Return the file of the number of Gaussians in the environment's container, which marks that as done."""
    return work / "environment.json"


def level_file(work: Path, chunk: int, level: int) -> Path:
    """Return the file of the Gaussians of one level of a chunk."""
    return work / f"chunk_{chunk}_level_{level}.f32"


def leaves_file(work: Path, chunk: int) -> Path:
    """Return the file of a chunk's leaves, which marks its levels as done."""
    return work / f"chunk_{chunk}.json"


def rows_file(work: Path, level: int, file: int) -> Path:
    """Return the file of the number of rows of each leaf in a container, which marks the container as done."""
    return work / f"file_{level}_{file}.json"


def write_json(path: Path, values: object) -> None:
    """Write JSON atomically."""
    with atomic_file(path, overwrite=True) as file:
        file.write(json.dumps(values, separators=(",", ":")).encode())
