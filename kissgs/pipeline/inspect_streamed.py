"""Describe one level of a streamed scene and its environment without decoding an image, for ``kissgs info``.

The parts are the manifest and the level's containers.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

from kissgs.core.origin import recorded
from kissgs.io.containers import Source
from kissgs.io.streamed import C, Part, StreamedFormat
from kissgs.pipeline.container_facts import Facts, stored_size
from kissgs.pipeline.inspect_sog import sog_images, sog_ranges
from kissgs.pipeline.inspect_sogxt import sogxt_ranges
from kissgs.sog.metadata import META_NAME
from kissgs.sog.streamed import STREAMED as SOG
from kissgs.sog.streamed import SogContainer
from kissgs.sogxt.streamed import STREAMED as SOGXT
from kissgs.sogxt.streamed import SogxtContainer

Ranges = dict[str, tuple[float, float]]


def streamed_sog_facts(path: Path, level: int) -> Facts:
    """Return the facts of a level of a streamed SOG scene.

    Raises:
        KissgsError: the manifest or a container's metadata is damaged, a file of the level is missing, or there is no
            such level.
    """

    def size(files: Source, part: Part[SogContainer]) -> tuple[str, int]:
        folder = part.container.folder
        names = (META_NAME, *sog_images(part.container.layout))
        return folder or META_NAME, sum(stored_size(files, folder + name) for name in names)

    return _facts(path, SOG, level, size, lambda containers: sog_ranges([each.layout for each in containers]))


def streamed_sogxt_facts(path: Path, level: int) -> Facts:
    """Return the facts of a level of a streamed SOG-XT scene.

    Raises:
        KissgsError: as for :func:`streamed_sog_facts`.
    """

    def size(files: Source, part: Part[SogxtContainer]) -> tuple[str, int]:
        return part.name, stored_size(files, part.name)

    return _facts(path, SOGXT, level, size, lambda containers: sogxt_ranges([each.layout for each in containers]))


def _facts(
    path: Path,
    streamed: StreamedFormat[C],
    level: int,
    size: Callable[[Source, Part[C]], tuple[str, int]],
    ranges: Callable[[Sequence[C]], Ranges],
) -> Facts:
    with streamed.open(path) as files:
        manifest = streamed.read_manifest(files)
        parts = list(streamed.parts(files, manifest, level))
        sizes = {streamed.manifest: stored_size(files, streamed.manifest), **dict(size(files, part) for part in parts)}
    return Facts(
        count=sum(part.count for part in parts),
        sh_degree=max((part.container.sh_degree for part in parts), default=0),
        parts=sizes,
        ranges=ranges([part.container for part in parts]),
        notes=tuple(dict.fromkeys(note for part in parts for note in part.container.notes)),
        details={
            **recorded(manifest.origin),
            "level": level,
            "levels": [manifest.count(one) for one in range(manifest.levels)],
            "environment": parts[-1].count if manifest.environment is not None else 0,
            "files": len(manifest.filenames),
            "antialiased": bool(parts) and all(part.container.antialiased for part in parts),
        },
    )
