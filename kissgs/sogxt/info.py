"""Facts of a SOG-XT container from its metadata, for ``kissgs info``."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from kissgs.core.errors import InvalidContainerError
from kissgs.core.positions import recorded, signed_exp
from kissgs.core.progress import Progress
from kissgs.core.splats import Splats
from kissgs.io.containers import Source, open_source
from kissgs.io.scene_format import Codec, Facts, ReadOptions, SceneSource, titled
from kissgs.sogxt.container import FILES, PLANES
from kissgs.sogxt.metadata import CHANNELS, Layout, read_layout, read_provenance

NAMES = {"quaternions": "quats", "f_dc": "sh0", "f_rest_centroids": "shN"}
MAX_PLANE_BYTES = 1 << 30


def describe(path: Path | bytes, level: int) -> Facts:
    """Return the facts of a SOG-XT container; the mask is decoded if the metadata does not state the count."""
    with open_source(path) as files:
        layout, made = read_layout(files), read_provenance(files)
        present = files.names()
        missing = [name for name in PLANES if name not in present]
        if missing:
            name = "the container" if isinstance(path, bytes) else path
            raise InvalidContainerError(f"{name} is incomplete: missing {', '.join(missing)}")
        parts = {name: files.size(name) for name in FILES if name in present}
        count = layout.count if layout.count is not None else _count_mask(files, layout)
    origin = f"kissgs {made.version} from {made.source_count:,} Gaussians" if made else "unknown"
    grid, codebook = layout.grid_side, layout.codebook_side
    return Facts(
        title=titled("SOG-XT container", "antialiased" if layout.antialiased else ""),
        count=count,
        sh_degree=layout.sh_degree,
        parts=parts,
        ranges=ranges_of([layout]),
        changed=made.changed if made else {},
        details={
            **recorded(layout.origin),
            "grid_side": grid,
            "codebook_side": codebook,
            "version": made.version if made else None,
            "source_count": made.source_count if made else None,
            "antialiased": layout.antialiased,
            "settings": made.settings if made else {},
        },
        lines=(f"grid {grid} x {grid}, codebook {codebook} x {codebook}; encoder: {origin}",),
    )


def ranges_of(layouts: list[Layout]) -> dict[str, tuple[float, float]]:
    """Return the values of the lowest and the highest level of every attribute, over all containers."""
    ranges = {}
    for field in CHANNELS:
        having = [layout for layout in layouts if field != "f_rest_centroids" or layout.sh_degree > 0]
        if having:
            ends = np.concatenate([end for layout in having for end in layout.limits(field)])
            ends = signed_exp(ends) if field == "means" else ends
            ranges[NAMES.get(field, field)] = float(ends.min()), float(ends.max())
    return ranges


def _count_mask(files: Source, layout: Layout) -> int:
    from kissgs.io.images import decode_plane

    side, name = layout.grid_side, "active_mask.webp"
    mask = decode_plane(files.read(name, MAX_PLANE_BYTES), name, width=side, height=side, channels=1)
    return int(np.count_nonzero(mask))


def _read(source: SceneSource, reading: ReadOptions, threads: int, progress: Progress) -> Splats:
    from kissgs.sogxt.decode import decode  # which the description does not need

    return decode(source, max_gaussians=reading.max_compressed, threads=threads, progress=progress)


FORMAT = Codec(info=describe, read=_read)
