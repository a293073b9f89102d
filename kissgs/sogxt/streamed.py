"""Streamed SOG-XT: ``levels.json`` and zips of SOG-XT."""

from __future__ import annotations

import io

from kissgs.core.errors import InvalidContainerError
from kissgs.formats import LEVELS_NAME
from kissgs.io.containers import Source, ZipSource, stored_size
from kissgs.io.streamed import Container, StreamedFormat
from kissgs.sogxt import container
from kissgs.sogxt.decode import decode_files
from kissgs.sogxt.info import ranges_of
from kissgs.sogxt.metadata import Layout, read_layout

MAX_FILE_BYTES = 1 << 28
"""Largest size of a zip, bytes; one of 400,000 Gaussians takes about 5 MB."""


def _opened(files: Source, name: str) -> Container[Layout]:
    """Read the metadata of a zip, whose bytes are not kept until its images are decoded."""

    def opened() -> Source:
        return ZipSource(io.BytesIO(files.read(name, MAX_FILE_BYTES)), name)

    layout = read_layout(opened())
    if layout.count is None:
        raise InvalidContainerError(f"{name} does not state its number of Gaussians; compress the scene again")
    return Container(
        layout,
        layout.count,
        lambda: (name, stored_size(files, name)),
        lambda out, pool: decode_files(opened(), layout, out, pool),
    )


STREAMED = StreamedFormat("streamed SOG-XT scene", LEVELS_NAME, container.FORMAT, _opened, ranges_of)

FORMAT = STREAMED.codec
