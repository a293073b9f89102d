"""Scenes of SOG-XT in the table of formats: single containers, and streamed ones of ``levels.json`` and zips."""

from __future__ import annotations

import io
from pathlib import Path

import numpy as np

from kissgs.core.errors import InvalidContainerError
from kissgs.core.positions import recorded
from kissgs.core.progress import Progress
from kissgs.core.resources import Workers
from kissgs.core.splats import Splats
from kissgs.formats import LEVELS_NAME
from kissgs.io.containers import Source, ZipSource, open_source, stored_size
from kissgs.io.scene_format import Codec, Facts, ReadOptions, SceneSource, titled
from kissgs.io.streamed import Container, StreamedFormat
from kissgs.sogxt import container
from kissgs.sogxt.container import FILES, PLANES
from kissgs.sogxt.metadata import Layout, read_layout, read_provenance

MAX_PLANE_BYTES = 1 << 30

MAX_FILE_BYTES = 1 << 28
"""Largest size of a zip in a streamed scene, bytes; one of 400,000 Gaussians takes about 5 MB."""


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
        ranges=layout.value_ranges(),
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


def _count_mask(files: Source, layout: Layout) -> int:
    from kissgs.io.images import decode_plane

    side, name = layout.grid_side, "active_mask.webp"
    mask = decode_plane(files.read(name, MAX_PLANE_BYTES), name, width=side, height=side, channels=1)
    return int(np.count_nonzero(mask))


def _read(source: SceneSource, reading: ReadOptions, threads: int, progress: Progress) -> Splats:
    from kissgs.sogxt.decode import decode  # which the description does not need

    return decode(source, max_gaussians=reading.max_compressed, threads=threads, progress=progress)


FORMAT = Codec(info=describe, read=_read)


def _opened(files: Source, name: str) -> Container:
    """Read the metadata of a zip, whose bytes are not kept until its images are decoded."""

    def opened() -> Source:
        return ZipSource(io.BytesIO(files.read(name, MAX_FILE_BYTES)), name)

    def decode(out: Splats, pool: Workers) -> None:
        from kissgs.sogxt.decode import decode_files

        decode_files(opened(), layout, out, pool)

    layout = read_layout(opened())
    if layout.count is None:
        raise InvalidContainerError(f"{name} does not state its number of Gaussians; compress the scene again")
    return Container(
        count=layout.count,
        sh_degree=layout.sh_degree,
        antialiased=layout.antialiased,
        ranges=layout.value_ranges,
        stored=lambda: (name, stored_size(files, name)),
        decode=decode,
    )


STREAMED = StreamedFormat("streamed SOG-XT scene", LEVELS_NAME, container.FORMAT, _opened)
