"""Streamed SOG-XT: ``levels.json`` and zips of SOG-XT."""

from __future__ import annotations

import io
from dataclasses import dataclass

from kissgs.core.errors import InvalidContainerError
from kissgs.core.resources import Workers
from kissgs.core.splats import Splats
from kissgs.io.containers import LEVELS_NAME, Source, ZipSource
from kissgs.io.streamed import StreamedFormat
from kissgs.sogxt.decode import decode_files
from kissgs.sogxt.metadata import Layout
from kissgs.sogxt.metadata_reader import read_layout
from kissgs.sogxt.names import FORMAT

MAX_FILE_BYTES = 1 << 28
"""Largest size of a zip, bytes; one of 400,000 Gaussians takes about 5 MB."""


@dataclass(frozen=True, slots=True)
class SogxtContainer:
    """Zip among the files of a streamed scene. Between metadata and images, its bytes are not kept."""

    files: Source
    layout: Layout
    name: str
    count: int

    @classmethod
    def opened(cls, files: Source, name: str) -> SogxtContainer:
        """Read the metadata of a zip.

        Raises:
            InvalidContainerError: the zip or the metadata is missing or invalid.
            UnsupportedError: another version, or other images than WebP.
        """
        layout = read_layout(_zip(files, name))
        if layout.count is None:
            raise InvalidContainerError(f"{name} does not state its number of Gaussians; compress the scene again")
        return cls(files, layout, name, layout.count)

    @property
    def sh_degree(self) -> int:
        """See :class:`kissgs.io.streamed.Container`."""
        return self.layout.sh_degree

    @property
    def antialiased(self) -> bool:
        """See :class:`kissgs.io.streamed.Container`."""
        return self.layout.antialiased

    @property
    def notes(self) -> tuple[str, ...]:
        """See :class:`kissgs.io.streamed.Container`."""
        return ()

    def decode(self, out: Splats, pool: Workers) -> None:
        """See :class:`kissgs.io.streamed.Container`."""
        decode_files(_zip(self.files, self.name), self.layout, out, pool)


def _zip(files: Source, name: str) -> Source:
    return ZipSource(io.BytesIO(files.read(name, MAX_FILE_BYTES)), name)


STREAMED = StreamedFormat(LEVELS_NAME, FORMAT, SogxtContainer.opened)

decode = STREAMED.decode
