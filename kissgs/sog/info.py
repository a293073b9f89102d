"""Facts of a SOG container from its metadata, for ``kissgs info``."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

import numpy as np

from kissgs.core.positions import recorded, signed_exp
from kissgs.core.progress import Progress
from kissgs.core.splats import Splats
from kissgs.io.containers import META_NAME, open_source, stored_size
from kissgs.io.scene_format import Codec, Facts, ReadOptions, SceneSource, titled
from kissgs.sog.metadata import SogLayout, read_layout


def describe(path: Path | bytes, level: int) -> Facts:
    """Return the facts of a SOG container."""
    with open_source(path) as files:
        layout = read_layout(files)
        parts = {name: stored_size(files, name) for name in (META_NAME, *layout.images)}
    return Facts(
        title=titled("SOG container", f"version {layout.version}", layout.model, layout.generator),
        count=layout.count,
        sh_degree=layout.sh_degree,
        parts=parts,
        ranges=ranges_of([layout]),
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


def ranges_of(layouts: list[SogLayout]) -> dict[str, tuple[float, float]]:
    """Return the values of the lowest and the highest level of every attribute, over all containers."""
    values: dict[str, Iterable[np.ndarray]] = {
        "means": [signed_exp(end) for layout in layouts for end in (layout.low, layout.high)],
        "scales": [layout.scales for layout in layouts],
        "opacities": [layout.opacities for layout in layouts],
        "sh0": [layout.sh0 for layout in layouts],
        "shN": [layout.rest.table for layout in layouts if layout.rest],
    }
    found = {}
    for name, arrays in values.items():
        finite = [array[np.isfinite(array)] for array in arrays]
        if any(array.size for array in finite):
            together = np.concatenate(finite)
            found[name] = float(together.min()), float(together.max())
    return found


def _read(source: SceneSource, reading: ReadOptions, threads: int, progress: Progress) -> Splats:
    from kissgs.sog.decode import decode  # which the description does not need

    return decode(source, max_gaussians=reading.max_compressed, threads=threads, progress=progress)


FORMAT = Codec(info=describe, read=_read)
