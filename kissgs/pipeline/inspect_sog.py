"""Describe SOG containers and streamed SOG scenes without decoding an image, for ``kissgs info``."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from kissgs.core.errors import InvalidContainerError
from kissgs.core.signed_log import signed_exp
from kissgs.io.packed_files import Source, open_source
from kissgs.sog.metadata import SogLayout, read_layout
from kissgs.sog.names import LOD_NAME, META_NAME
from kissgs.sog.streamed import level_chunks, read_tree


@dataclass(frozen=True, slots=True, kw_only=True)
class SogFacts:
    """Facts of a container, as the fields of :class:`kissgs.pipeline.inspect.Info` of the same names."""

    count: int
    sh_degree: int
    parts: dict[str, int]
    ranges: dict[str, tuple[float, float]]
    details: dict[str, Any]


def sog_facts(path: Path) -> SogFacts:
    """Return the facts of a SOG container.

    Raises:
        KissgsError: the container is damaged or incomplete.
    """
    with open_source(path) as files:
        layout = read_layout(files)
        parts = {name: _size(files, name) for name in (META_NAME, *_images(layout))}
    return SogFacts(
        count=layout.count,
        sh_degree=layout.sh_degree,
        parts=parts,
        ranges=_ranges([layout]),
        details={
            "version": layout.version,
            "antialiased": layout.model == "antialiased",
            "model": layout.model,
            "generator": layout.generator,
            "codebook_entries": layout.rest.entries if layout.rest else 0,
        },
    )


def streamed_facts(path: Path, level: int = 0) -> SogFacts:
    """Return the facts of one level of a streamed scene and its environment; ``parts`` are the level's containers.

    Raises:
        KissgsError: the index or a container's metadata is damaged, a file of the level is missing, or there is no such
            level.
    """
    with open_source(path, LOD_NAME) as files:
        tree = read_tree(files)
        chunks = list(level_chunks(files, tree, level))
        parts = {LOD_NAME: _size(files, LOD_NAME)}
        for chunk in chunks:
            names = (META_NAME, *_images(chunk.layout))
            parts[chunk.folder or META_NAME] = sum(_size(files, chunk.folder + name) for name in names)
        environment = chunks[-1].count if tree.environment is not None else 0
    return SogFacts(
        count=sum(chunk.count for chunk in chunks),
        sh_degree=max((chunk.layout.sh_degree for chunk in chunks), default=0),
        parts=parts,
        ranges=_ranges([chunk.layout for chunk in chunks]),
        details={
            "level": level,
            "levels": [tree.count(one) for one in range(tree.levels)],
            "environment": environment,
            "files": len(tree.filenames),
        },
    )


def _images(layout: SogLayout) -> list[str]:
    rest = [layout.rest.centroids, layout.rest.labels] if layout.rest else []
    return [*layout.files.values(), *rest]


def _size(files: Source, name: str) -> int:
    try:
        return files.size(name)
    except (KeyError, OSError, ValueError) as error:
        raise InvalidContainerError(f"the container has no file {name!r}; export or download it again") from error


def _ranges(layouts: list[SogLayout]) -> dict[str, tuple[float, float]]:
    """Return the values of the lowest and the highest level of every attribute, over all containers."""
    rest = [layout.rest.table for layout in layouts if layout.rest]
    values: dict[str, Iterable[np.ndarray]] = {
        "means": [signed_exp(end) for layout in layouts for end in (layout.low, layout.high)],
        "scales": [layout.scales for layout in layouts],
        "opacities": [layout.opacities for layout in layouts],
        "sh0": [layout.sh0 for layout in layouts],
        "shN": rest,
    }
    found = {}
    for name, arrays in values.items():
        finite = [array[np.isfinite(array)] for array in arrays]
        if any(array.size for array in finite):
            together = np.concatenate(finite)
            found[name] = float(together.min()), float(together.max())
    return found
