"""Streamed SOG: ``lod-meta.json`` and folders of SOG."""

from __future__ import annotations

from dataclasses import dataclass

from kissgs.core.resources import Workers
from kissgs.core.splats import Splats
from kissgs.io.containers import LOD_NAME, Source
from kissgs.io.streamed import StreamedFormat
from kissgs.sog.decode import decode_files
from kissgs.sog.metadata import SogLayout, read_layout


@dataclass(frozen=True, slots=True)
class SogContainer:
    """Container among the files of a streamed scene; ``folder`` is its path, or empty."""

    files: Source
    layout: SogLayout
    folder: str

    @classmethod
    def opened(cls, files: Source, name: str) -> SogContainer:
        """Read the container of a metadata file.

        Raises:
            InvalidContainerError: the metadata is missing or invalid.
            UnsupportedError: another version.
        """
        return cls(files, read_layout(files, name), name[: name.rfind("/") + 1])

    @property
    def count(self) -> int:
        """See :class:`kissgs.io.streamed.Container`."""
        return self.layout.count

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
        return self.layout.notes

    def decode(self, out: Splats, pool: Workers) -> None:
        """See :class:`kissgs.io.streamed.Container`."""
        decode_files(self.files, self.layout, out, pool, self.folder)


STREAMED = StreamedFormat(LOD_NAME, None, SogContainer.opened)

decode = STREAMED.decode
