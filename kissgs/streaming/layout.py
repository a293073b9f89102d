"""``Layout``: sizes of a streamed scene, the files of its work folder, and its manifest."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from kissgs._version import __version__
from kissgs.core.array_types import Float64
from kissgs.core.positions import WORLD, Origin, recorded
from kissgs.formats import MANIFESTS, ContainerName
from kissgs.io.containers import META_NAME
from kissgs.io.files import atomic_file

# ``Layout``: sizes of a streamed scene; and the files of its work folder.

CONTEXT = 280_000
"""Largest number of Gaussians of the level that stands for other chunks where sensitivity is measured."""

PARTITION, CAMERAS, OUT = "partition.json", "cameras.json", "out"
"""Names in the work folder: the marker of the partition, the cameras, and the folder of the result."""


ENVIRONMENT = "environment"
"""Name of the environment's container."""


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


def write_json(path: Path, values: object) -> None:
    """Write JSON atomically."""
    with atomic_file(path, overwrite=True) as file:
        file.write(json.dumps(values, separators=(",", ":")).encode())


# The manifest of a streamed scene: a tree whose leaves name rows of containers.


@dataclass(frozen=True, slots=True, eq=False)
class Leaf:
    """A leaf of the tree."""

    bounds: Float64[np.ndarray, "2 3"]
    lods: Mapping[int, tuple[int, int, int]]
    errors: Sequence[float]


def manifest(
    leaves: Sequence[Leaf],
    levels: int,
    filenames: Sequence[str],
    environment: str | None,
    containers: str | None,
    origin: Origin,
) -> bytes:
    """Return the manifest."""
    counts = [sum(leaf.lods[level][2] for leaf in leaves if level in leaf.lods) for level in range(levels)]
    document = {
        "version": 1,
        **({} if containers is None else {"format": containers}),
        "asset": {"generator": f"kissgs {__version__}"},
        **({} if origin == WORLD else {"kissgs": recorded(origin)}),
        "count": counts[0],
        "counts": counts,
        "lodLevels": levels,
        "lodErrors": True,
        **({} if environment is None else {"environment": environment}),
        "filenames": list(filenames),
        "tree": _node(leaves),
    }
    return json.dumps(document, separators=(",", ":")).encode()


def _node(leaves: Sequence[Leaf]) -> dict[str, Any]:
    """Return a leaf, or a node with two halves of the leaves."""
    if len(leaves) == 1:
        lods = {
            str(level): dict(zip(("file", "offset", "count"), rows, strict=True))
            for level, rows in leaves[0].lods.items()
        }
        return {"bound": _bound(leaves[0].bounds), "lods": lods, "errors": list(leaves[0].errors)}
    middle = len(leaves) // 2
    corners = np.stack([leaf.bounds for leaf in leaves])
    bounds = np.stack([corners[:, 0].min(axis=0), corners[:, 1].max(axis=0)])
    return {"bound": _bound(bounds), "children": [_node(leaves[:middle]), _node(leaves[middle:])]}


def _bound(bounds: Float64[np.ndarray, "2 3"]) -> dict[str, list[float]]:
    low, high = ([float(f"{value:.7g}") for value in corner] for corner in bounds)
    return {"min": low, "max": high}
