"""The manifest of a streamed scene: a tree whose leaves name rows of containers."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from kissgs._version import __version__
from kissgs.core.array_types import Float64
from kissgs.core.origin import WORLD, Origin, recorded


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
