"""Streamed SOG: ``lod-meta.json`` with a tree whose leaves name rows of SOG containers, level by level.

Level 0 is the finest. The environment, if there is one, belongs to every level.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from kissgs.core.errors import InvalidContainerError, UnsupportedError
from kissgs.core.limits import MAX_GAUSSIANS
from kissgs.core.progress import Progress, silent
from kissgs.core.splats import ATTRIBUTES, SH_REST_COUNTS, Splats, empty_splats
from kissgs.core.threads import Workers
from kissgs.io.packed_files import Source, open_source
from kissgs.io.scene_file import refuse_more_than
from kissgs.sog.decode import decode_files
from kissgs.sog.metadata import SogLayout, is_file_name, parse_json, read_layout
from kissgs.sog.names import LOD_NAME

MAX_TREE_BYTES = 1 << 25
"""Largest size of ``lod-meta.json``, bytes; one of a thousand leaves and five levels takes 330 kB."""

MAX_LEVELS = 64
"""Largest number of levels; each has a fraction of the Gaussians of the one before."""


@dataclass(frozen=True, slots=True)
class Tree:
    """Contents of ``lod-meta.json``.

    Attributes:
        levels: number of levels.
        filenames: metadata files of the containers.
        rows: per level, the row ranges ``(file, offset, count)`` of the leaves, by file and offset, without overlap.
        environment: metadata file of the environment; None without one.
    """

    levels: int
    filenames: tuple[str, ...]
    rows: tuple[tuple[tuple[int, int, int], ...], ...]
    environment: str | None

    def count(self, level: int) -> int:
        """Return the number of Gaussians of a level, without the environment."""
        return sum(count for _, _, count in self.rows[level])


@dataclass(frozen=True, slots=True)
class Chunk:
    """Container of which a level needs the row ranges ``rows``, offset and count; ``folder`` is its path or empty."""

    layout: SogLayout
    folder: str
    rows: tuple[tuple[int, int], ...]

    @property
    def count(self) -> int:
        """Number of Gaussians that the level needs."""
        return sum(count for _, count in self.rows)


def read_tree(files: Source) -> Tree:
    """Read and check ``lod-meta.json``.

    Raises:
        InvalidContainerError: it is missing, damaged or invalid.
        UnsupportedError: another version, or files elsewhere on the web.
    """
    document = parse_json(files.read(LOD_NAME, MAX_TREE_BYTES), LOD_NAME)
    if not isinstance(document, dict):
        raise _invalid("it is no JSON object")
    if document.get("version", 1) != 1:
        raise UnsupportedError(f"{LOD_NAME} is of version {str(document['version'])[:40]!r}; version 1 is read")
    levels, names = document.get("lodLevels"), document.get("filenames")
    if not isinstance(levels, int) or isinstance(levels, bool) or not 1 <= levels <= MAX_LEVELS:
        raise _invalid(f"lodLevels is not a whole number from 1 to {MAX_LEVELS}")
    if not isinstance(names, list):
        raise _invalid("it lacks the list 'filenames'")
    environment = document.get("environment")
    for name in (*names, *([] if environment is None else [environment])):
        if isinstance(name, str) and "://" in name:
            raise UnsupportedError(f"{LOD_NAME} names files on the web; download them beside it and name them there")
        if not is_file_name(name):
            raise _invalid("it names a file that is not below its folder")
    rows: list[list[tuple[int, int, int]]] = [[] for _ in range(levels)]
    for level, row in _leaf_rows(document.get("tree"), levels, len(names)):
        rows[level].append(row)
    for found in rows:
        found.sort()
        for (file, offset, count), (next_file, next_offset, _) in itertools.pairwise(found):
            if file == next_file and offset + count > next_offset:
                raise _invalid(f"two leaves share rows of {names[file]}")
    return Tree(levels, tuple(names), tuple(map(tuple, rows)), environment)


def decode(
    source: Path | bytes | Mapping[str, bytes],
    *,
    level: int = 0,
    max_gaussians: int = MAX_GAUSSIANS,
    threads: int = 0,
    progress: Progress = silent,
) -> Splats:
    """Decode one level of a streamed scene, the environment included.

    Args:
        source: the folder of ``lod-meta.json``, a zip of it, the bytes of one, or files in memory.
        level: level of detail; 0 is the finest.
        max_gaussians: largest number of Gaussians; more are refused before memory is allocated.
        threads: number of threads; 0 means one per processor.
        progress: receives "decode" events.

    Returns:
        The Gaussians in the order of the files and their rows, then those of the environment. Containers of a lower SH
        degree have zeros for the coefficients above it.

    Raises:
        InvalidContainerError: a part is missing, damaged or invalid.
        UnsupportedError: there is no such level, another version, or more Gaussians than ``max_gaussians``.
    """
    with open_source(source, LOD_NAME) as files, Workers(threads) as pool:
        tree = read_tree(files)
        chunks = list(level_chunks(files, tree, level))
        count = sum(chunk.count for chunk in chunks)
        refuse_more_than(max_gaussians, count, f"level {level}")
        splats = empty_splats(count, max((SH_REST_COUNTS[c.layout.sh_degree] for c in chunks), default=0))
        start = 0
        for chunk in chunks:
            refuse_more_than(max_gaussians, chunk.layout.count, f"the file {chunk.folder}meta.json")
            progress("decode", start / max(count, 1))
            start = _decode_chunk(files, chunk, splats, start, pool)
        progress("decode", 1.0)
        return splats


def _decode_chunk(files: Source, chunk: Chunk, out: Splats, start: int, pool: Workers) -> int:
    """Decode a container and write its rows to ``out`` from ``start``; return where they end."""
    stop = start + chunk.count
    if chunk.rows == ((0, chunk.layout.count),):
        decode_files(files, chunk.layout, out.select(slice(start, stop)), pool, chunk.folder)
        return stop
    whole = empty_splats(chunk.layout.count, out.shN.shape[1])
    decode_files(files, chunk.layout, whole, pool, chunk.folder)
    for offset, count in chunk.rows:
        for name in ATTRIBUTES:
            getattr(out, name)[start : start + count] = getattr(whole, name)[offset : offset + count]
        start += count
    return stop


def level_chunks(files: Source, tree: Tree, level: int) -> Iterator[Chunk]:
    """Yield the containers of a level, then the environment; their metadata is read and checked.

    Raises:
        InvalidContainerError: a container's metadata is missing or invalid, or has too few rows.
        UnsupportedError: there is no such level, or a container is of another version.
    """
    if not 0 <= level < tree.levels:
        raise UnsupportedError(f"there is no level {level}; this scene has levels 0 (the finest) to {tree.levels - 1}")
    rows: dict[int, list[tuple[int, int]]] = {}
    for file, offset, count in tree.rows[level]:
        merged = rows.setdefault(file, [])
        if merged and sum(merged[-1]) == offset:  # leaves stand one after another
            offset, count = merged[-1][0], merged.pop()[1] + count
        merged.append((offset, count))
    for file, found in rows.items():
        name = tree.filenames[file]
        layout = read_layout(files, name)
        if sum(found[-1]) > layout.count:
            raise _invalid(f"a leaf names rows up to {sum(found[-1]):,} of {name}, which has {layout.count:,}")
        yield Chunk(layout, _folder(name), tuple(found))
    if tree.environment is not None:
        layout = read_layout(files, tree.environment)
        yield Chunk(layout, _folder(tree.environment), ((0, layout.count),))


def _folder(name: str) -> str:
    return name[: name.rfind("/") + 1]


def _leaf_rows(tree: Any, levels: int, files: int) -> Iterator[tuple[int, tuple[int, int, int]]]:  # noqa: ANN401
    """Yield level, file, offset and count of every leaf and level that has Gaussians."""
    waiting = [tree]
    while waiting:
        node = waiting.pop()
        if not isinstance(node, dict):
            raise _invalid("its tree has a node that is no JSON object")
        lods, children = node.get("lods"), node.get("children")
        if isinstance(lods, dict):
            for key, lod in lods.items():
                level = int(key) if key.isascii() and key.isdigit() and len(key) < 4 else levels
                if level >= levels or not isinstance(lod, dict):
                    raise _invalid(f"a leaf has a level that is not 0 to {levels - 1}")
                file, offset, count = (_whole(lod.get(part)) for part in ("file", "offset", "count"))
                if file is None or offset is None or count is None or file >= files:
                    raise _invalid("a leaf does not name a file, an offset and a count")
                if count:
                    yield level, (file, offset, count)
        elif isinstance(children, list):
            waiting.extend(children)
        elif lods is not None or children is not None:
            raise _invalid("its tree has a node whose levels or children are of the wrong kind")


def _whole(value: object) -> int | None:
    return value if isinstance(value, int) and not isinstance(value, bool) and 0 <= value < 1 << 40 else None


def _invalid(problem: str) -> InvalidContainerError:
    return InvalidContainerError(f"{LOD_NAME}: {problem}; export the scene again")
