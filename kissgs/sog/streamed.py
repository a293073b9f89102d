"""Streamed SOG: ``lod-meta.json`` and folders of SOG."""

from __future__ import annotations

from kissgs.formats import LOD_NAME
from kissgs.io.containers import META_NAME, Source, stored_size
from kissgs.io.streamed import Container, StreamedFormat
from kissgs.sog.decode import decode_files
from kissgs.sog.info import ranges_of
from kissgs.sog.metadata import SogLayout, read_layout


def _opened(files: Source, name: str) -> Container[SogLayout]:
    """Read the container of a metadata file."""
    layout, folder = read_layout(files, name), name[: name.rfind("/") + 1]

    def stored() -> tuple[str, int]:
        return folder or META_NAME, sum(stored_size(files, folder + each) for each in (META_NAME, *layout.images))

    return Container(layout, layout.count, stored, lambda out, pool: decode_files(files, layout, out, pool, folder))


STREAMED = StreamedFormat("streamed SOG scene", LOD_NAME, None, _opened, ranges_of)

FORMAT = STREAMED.codec
