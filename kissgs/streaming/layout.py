"""``Layout``: sizes of a streamed scene; and the files of its work folder."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from kissgs.core.positions import Origin
from kissgs.formats import MANIFESTS, ContainerName
from kissgs.io.containers import META_NAME
from kissgs.io.files import atomic_file

CONTEXT = 280_000  # largest number of Gaussians of the level that stands for other chunks where sensitivity is measured
# The partition's marker; cameras; the first view; the result.
PARTITION, CAMERAS, VIEW, OUT = "partition.json", "cameras.json", "view.json", "out"
ENVIRONMENT = "environment"  # name of the environment's container


@dataclass(frozen=True, slots=True)
class ContainerFile:
    """A container of the result: one level of some chunks, or the environment, which has no chunks."""

    name: str
    level: int = 0
    chunks: tuple[int, ...] = ()  # those that have Gaussians


@dataclass(frozen=True, slots=True, kw_only=True)
class Layout:
    """Sizes of a streamed scene: numbers of Gaussians, but for ``depth`` and ``levels``."""

    container: ContainerName
    source_count: int  # before cleaning
    sh_degree: int
    counts: tuple[int, ...]  # in each chunk
    depth: int  # number of cuts one after another; there are 2^depth chunks
    levels: int
    leaf: int  # at most, in a leaf
    environment: int
    changed: dict[str, int]  # by cleaning, by kind; and "invisible"
    notes: tuple[str, ...]  # what reading the scene left out or changed, and where its positions are
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

    def path(self, name: str) -> str:
        """Return the path of a container in the folder of the result: that of a folder for SOG, else of a zip."""
        return name if self.container == "sog" else f"{name}.zip"

    def entry(self, name: str) -> str:
        """Return how the manifest names a container."""
        return f"{name}/{META_NAME}" if self.container == "sog" else self.path(name)

    def files(self) -> list[ContainerFile]:
        """Return the containers of all levels, the coarsest first: each has twice the chunks of one a level finer."""
        found = []
        for level in reversed(range(self.levels)):
            size = 1 << min(level, self.depth)
            for number in range((1 << self.depth) // size):
                chunks = [chunk for chunk in range(number * size, (number + 1) * size) if self.counts[chunk]]
                if chunks:
                    found.append(ContainerFile(f"{level}_{number}", level, tuple(chunks)))
        return found

    def all_files(self) -> list[ContainerFile]:
        """Return all containers, the environment first if there is one."""
        return [ContainerFile(ENVIRONMENT), *self.files()] if self.environment else self.files()


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


def level_file(work: Path, chunk: int, level: int) -> Path:
    """Return the file of the Gaussians of one level of a chunk."""
    return work / f"chunk_{chunk}_level_{level}.f32"


def leaves_file(work: Path, chunk: int) -> Path:
    """Return the file of a chunk's leaves, which marks its levels as done."""
    return work / f"chunk_{chunk}.json"


def rows_file(work: Path, name: str) -> Path:
    """Return the file of the number of rows of each leaf in a container, which marks the container as done."""
    return work / f"file_{name}.json"


def read_counts(work: Path, name: str) -> dict[str, Any]:
    """Return the number of rows of each leaf in a container, and the note of its encoding."""
    return json.loads(rows_file(work, name).read_bytes())


def write_json(path: Path, values: object) -> None:
    """Write JSON atomically."""
    with atomic_file(path, overwrite=True) as file:
        file.write(json.dumps(values, separators=(",", ":")).encode())
