"""Scenes of SOG in the table of formats: single containers, and streamed ones of ``lod-meta.json`` and folders."""

from __future__ import annotations

from pathlib import Path

from kissgs.core.positions import recorded
from kissgs.core.progress import Progress
from kissgs.core.resources import Workers
from kissgs.core.splats import Splats
from kissgs.formats import LOD_NAME
from kissgs.io.containers import META_NAME, Source, open_source, stored_size
from kissgs.io.scene_format import Codec, Facts, ReadOptions, SceneSource, titled
from kissgs.io.streamed import Container, StreamedFormat
from kissgs.sog.metadata import read_layout


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
        ranges=layout.value_ranges(),
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


def _read(source: SceneSource, reading: ReadOptions, threads: int, progress: Progress) -> Splats:
    from kissgs.sog.decode import decode  # which the description does not need

    return decode(source, max_gaussians=reading.max_compressed, threads=threads, progress=progress)


FORMAT = Codec(info=describe, read=_read)


def _opened(files: Source, name: str) -> Container:
    """Read the container of a metadata file."""
    layout, folder = read_layout(files, name), name[: name.rfind("/") + 1]

    def stored() -> tuple[str, int]:
        return folder or META_NAME, sum(stored_size(files, folder + each) for each in (META_NAME, *layout.images))

    def decode(out: Splats, pool: Workers) -> None:
        from kissgs.sog.decode import decode_files

        decode_files(files, layout, out, pool, folder)

    return Container(
        count=layout.count,
        sh_degree=layout.sh_degree,
        antialiased=layout.antialiased,
        notes=layout.notes,
        ranges=layout.value_ranges,
        stored=stored,
        decode=decode,
    )


STREAMED = StreamedFormat("streamed SOG scene", LOD_NAME, None, _opened)
