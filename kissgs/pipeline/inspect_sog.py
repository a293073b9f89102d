"""Describe SOG containers, for ``kissgs info``."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

import numpy as np

from kissgs.core.origin import recorded
from kissgs.core.signed_log import signed_exp
from kissgs.io.containers import open_source
from kissgs.pipeline.container_facts import Facts, stored_size
from kissgs.sog.metadata import META_NAME, SogLayout, read_layout


def sog_facts(path: Path) -> Facts:
    """Return the facts of a SOG container.

    Raises:
        KissgsError: the container is damaged or incomplete.
    """
    with open_source(path) as files:
        layout = read_layout(files)
        parts = {name: stored_size(files, name) for name in (META_NAME, *sog_images(layout))}
    return Facts(
        count=layout.count,
        sh_degree=layout.sh_degree,
        parts=parts,
        ranges=sog_ranges([layout]),
        notes=layout.notes,
        details={
            **recorded(layout.origin),
            "version": layout.version,
            "antialiased": layout.antialiased,
            "model": layout.model,
            "generator": layout.generator,
            "codebook_entries": layout.rest.entries if layout.rest else 0,
        },
    )


def sog_images(layout: SogLayout) -> list[str]:
    """Return the names of a container's images."""
    rest = [layout.rest.centroids, layout.rest.labels] if layout.rest else []
    return [*layout.files.values(), *rest]


def sog_ranges(layouts: list[SogLayout]) -> dict[str, tuple[float, float]]:
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
