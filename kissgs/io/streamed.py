"""Streamed scenes: a manifest with a tree whose leaves name rows of containers, level by level. Level 0 is the finest.
The environment, if there is one, belongs to every level. The package of a container's format says how its files are
opened and decoded."""

from __future__ import annotations

import contextlib
import itertools
import os
import posixpath
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path

from kissgs.core.context import Progress, Workers, silent
from kissgs.core.errors import InvalidContainerError, UnsupportedError
from kissgs.core.positions import Origin, read_origin, recorded
from kissgs.core.splats import ATTRIBUTES, SH_REST_COUNTS, Splats, empty_splats
from kissgs.io.containers import Source, is_file_name, open_source, stored_size
from kissgs.io.files import marked, parse_json, refuse_more_than, whole_number
from kissgs.io.scene_format import DEFAULT_READ_OPTIONS, Codec, Facts, ReadOptions, SceneSource, titled

MAX_TREE_BYTES = 1 << 25  # largest size of a manifest, bytes; one of a thousand leaves and five levels takes 330 kB
MAX_TREE_VALUES = 1 << 22  # largest number of values in a manifest; one of a thousand leaves and five levels has 30,000
MAX_ROWS = 1 << 40  # largest number of a row that a manifest may name
MAX_LEVELS = 64  # largest number of levels; each has a fraction of the Gaussians of the one before


@dataclass(frozen=True, slots=True, kw_only=True)
class Container:
    """Container among the files of a streamed scene, whose metadata is read and checked."""

    count: int
    sh_degree: int
    antialiased: bool
    notes: tuple[str, ...] = ()  # phrases for what reading leaves out
    ranges: Callable[[], dict[str, tuple[float, float]]]  # values of the lowest and the highest level, by attribute
    stored: Callable[[], tuple[str, int]]  # returns the name of the container and the bytes of all its files
    decode: Callable[[Splats, Workers], None]  # into a scene, whose SH coefficients above its own degree are zero


@dataclass(frozen=True, slots=True)
class Manifest:
    """Contents of a manifest."""

    levels: int
    filenames: tuple[str, ...]  # files of the containers: their metadata, or they themselves
    rows: tuple[tuple[tuple[int, int, int], ...], ...]  # by level: (file, offset, count), in order, without overlap
    environment: str | None  # file of the environment
    origin: Origin

    def count(self, level: int) -> int:
        """Return the number of Gaussians of a level, without the environment."""
        return sum(count for _, _, count in self.rows[level])


@dataclass(frozen=True, slots=True)
class Part:
    """Container of which a level needs the row ranges ``rows``, offset and count; ``name`` is that of its file."""

    name: str
    container: Container
    rows: tuple[tuple[int, int], ...]

    @property
    def count(self) -> int:
        """Number of Gaussians that the level needs."""
        return sum(count for _, count in self.rows)

    def decode(self, out: Splats, start: int, pool: Workers) -> int:
        """Decode the container and write the rows to ``out`` from ``start``; return where they end."""
        stop = start + self.count
        if self.rows == ((0, self.container.count),):
            self.container.decode(out.select(slice(start, stop)), pool)
            return stop
        whole = empty_splats(self.container.count, out.shN.shape[1])
        self.container.decode(whole, pool)
        for offset, count in self.rows:
            for name in ATTRIBUTES:
                getattr(out, name)[start : start + count] = getattr(whole, name)[offset : offset + count]
            start += count
        return stop


@dataclass(frozen=True, slots=True)
class StreamedFormat:
    """Format of streamed scenes."""

    title: str
    manifest: str  # file name of the manifest
    containers: str | None  # value of the manifest's key "format", which it may lack; None: any value is valid
    opened: Callable[[Source, str], Container]  # reads and checks the metadata of the container of a file

    @property
    def codec(self) -> Codec:
        """Code of the format."""
        return Codec(info=self.describe, read=self.decode)

    def describe(self, path: Path | bytes, level: int) -> Facts:
        """Return the facts of one level and the environment; no image is decoded."""
        with self.open(path) as files:
            manifest = self.read_manifest(files)
            parts = list(self.parts(files, manifest, level))
            containers = [part.container for part in parts]
            sizes = {self.manifest: stored_size(files, self.manifest), **dict(each.stored() for each in containers)}
        antialiased = bool(parts) and all(each.antialiased for each in containers)
        levels = [manifest.count(one) for one in range(manifest.levels)]
        environment = parts[-1].count if manifest.environment is not None else 0
        beside = f"; in the environment, which belongs to every level: {environment:,}" if environment else ""
        described = f"level {level} of 0 to {manifest.levels - 1}"
        return Facts(
            title=titled(self.title, described, "antialiased" if antialiased else ""),
            count=sum(part.count for part in parts),
            sh_degree=max((each.sh_degree for each in containers), default=0),
            parts=sizes,
            ranges=_widest([each.ranges() for each in containers]),
            notes=_all_notes(parts),
            details={
                **recorded(manifest.origin),
                "level": level,
                "levels": levels,
                "environment": environment,
                "files": len(manifest.filenames),
                "antialiased": antialiased,
            },
            lines=(f"Gaussians by level, finest first: {', '.join(f'{count:,}' for count in levels)}{beside}",),
        )

    @contextlib.contextmanager
    def open(self, source: SceneSource) -> Iterator[Source]:
        """Open a streamed scene for reading; errors about its files name the scene."""
        with open_source(source, self.manifest) as files:
            try:
                yield files
            except (InvalidContainerError, UnsupportedError) as error:
                if not isinstance(source, Path):
                    raise
                raise type(error)(self._located(source, str(error))) from error

    def _located(self, source: Path, message: str) -> str:
        """Return a message about a file of a streamed scene with the path of the scene."""
        if not source.is_dir():
            return f"{source}: {message}"
        if source.name and f"{source}{os.sep}" in message:
            return message
        if message.startswith(self.manifest):
            return f"{source / self.manifest}{message.removeprefix(self.manifest)}"
        return f"{source / self.manifest}: {message}"

    def decode(
        self,
        source: SceneSource,
        reading: ReadOptions = DEFAULT_READ_OPTIONS,
        threads: int = 0,
        progress: Progress = silent,
    ) -> Splats:
        """Decode one level of a streamed scene: the rows in the order of the files, then the environment. Containers of
        a lower SH degree get zeros for the coefficients above it."""
        with self.open(source) as files, Workers(threads) as pool:
            manifest = self.read_manifest(files)
            parts = list(self.parts(files, manifest, reading.level))
            count = sum(part.count for part in parts)
            refuse_more_than(reading.max_compressed, count, f"level {reading.level}")
            splats = empty_splats(count, SH_REST_COUNTS[max((part.container.sh_degree for part in parts), default=0)])
            start = 0
            for part in parts:
                refuse_more_than(reading.max_compressed, part.container.count, f"the file {part.name}")
                progress("decode", start / max(count, 1))
                start = part.decode(splats, start, pool)
            progress("decode", 1.0)
            splats = replace(splats, origin=manifest.origin, notes=_all_notes(parts))
            return marked(splats, [part.container.antialiased for part in parts])

    def read_manifest(self, files: Source) -> Manifest:
        """Read and check the manifest."""
        name = self.manifest
        document = parse_json(files.read(name, MAX_TREE_BYTES), name, most=MAX_TREE_VALUES)
        if not isinstance(document, dict):
            raise _invalid(name, "it is no JSON object")
        for key, known in (("version", 1), ("format", self.containers)):
            if known is not None and (found := document.get(key, known)) != known:
                raise UnsupportedError(f"{name} is of {key} {str(found)[:40]!r}; {key} {known} is read")
        levels, names = whole_number(document.get("lodLevels"), 1, MAX_LEVELS), document.get("filenames")
        if levels is None:
            raise _invalid(name, f"lodLevels is not a whole number from 1 to {MAX_LEVELS}")
        if not isinstance(names, list):
            raise _invalid(name, "it lacks the list 'filenames'")
        environment = document.get("environment")
        paths: set[str] = set()
        for each in (*names, *([] if environment is None else [environment])):
            if isinstance(each, str) and "://" in each:
                raise UnsupportedError(f"{name} names files on the web; download them beside it and name them there")
            if not is_file_name(each):
                raise _invalid(name, "it names a file that is not below its folder")
            if (path := posixpath.normpath(each.replace("\\", "/"))) in paths:
                raise _invalid(name, f"it names the file {each} twice")
            paths.add(path)
        rows: list[list[tuple[int, int, int]]] = [[] for _ in range(levels)]
        for level, row in _leaf_rows(name, document.get("tree"), levels, len(names)):
            rows[level].append(row)
        for own in rows:
            own.sort()
            for (file, offset, count), (next_file, next_offset, _) in itertools.pairwise(own):
                if file == next_file and offset + count > next_offset:
                    raise _invalid(name, f"two leaves share rows of {names[file]}")
        return Manifest(levels, tuple(names), tuple(map(tuple, rows)), environment, read_origin(document, name))

    def parts(self, files: Source, manifest: Manifest, level: int) -> Iterator[Part]:
        """Yield the containers of a level, then the environment; their metadata is read and checked."""
        last = manifest.levels - 1
        if not 0 <= level <= last:
            raise UnsupportedError(f"there is no level {level}; this scene has levels 0 (the finest) to {last}")
        rows: dict[int, list[tuple[int, int]]] = {}
        for file, offset, count in manifest.rows[level]:
            merged = rows.setdefault(file, [])
            if merged and sum(merged[-1]) == offset:  # leaves stand one after another
                offset, count = merged[-1][0], merged.pop()[1] + count
            merged.append((offset, count))
        for file, found in rows.items():
            name = manifest.filenames[file]
            container, end = self.opened(files, name), sum(found[-1])
            if end > container.count:
                problem = f"a leaf names rows up to {end:,} of {name}, which has {container.count:,}"
                raise _invalid(self.manifest, problem)
            yield Part(name, container, tuple(found))
        if manifest.environment is not None:
            container = self.opened(files, manifest.environment)
            yield Part(manifest.environment, container, ((0, container.count),))


def _all_notes(parts: list[Part]) -> tuple[str, ...]:
    return tuple(dict.fromkeys(note for part in parts for note in part.container.notes))


def _widest(ranges: list[dict[str, tuple[float, float]]]) -> dict[str, tuple[float, float]]:
    """Return the range of each attribute over all containers that have it."""
    found: dict[str, tuple[float, float]] = {}
    for name, (low, high) in (item for each in ranges for item in each.items()):
        lowest, highest = found.get(name, (low, high))
        found[name] = min(low, lowest), max(high, highest)
    return found


def _leaf_rows(name: str, tree: object, levels: int, files: int) -> Iterator[tuple[int, tuple[int, int, int]]]:
    """Yield level, file, offset and count of every leaf and level that has Gaussians."""
    waiting = [tree]
    while waiting:
        node = waiting.pop()
        if not isinstance(node, dict):
            raise _invalid(name, "its tree has a node that is no JSON object")
        lods, children = node.get("lods"), node.get("children")
        if isinstance(lods, dict):
            for key, lod in lods.items():
                level = int(key) if key.isascii() and key.isdigit() and len(key) < 4 else levels
                if level >= levels or not isinstance(lod, dict):
                    raise _invalid(name, f"a leaf has a level that is not 0 to {levels - 1}")
                file = whole_number(lod.get("file"), 0, files - 1)
                offset, count = (whole_number(lod.get(part), 0, MAX_ROWS) for part in ("offset", "count"))
                if file is None or offset is None or count is None:
                    raise _invalid(name, "a leaf does not name a file, an offset and a count")
                if count:
                    yield level, (file, offset, count)
        elif isinstance(children, list):
            waiting.extend(children)
        elif lods is not None or children is not None:
            raise _invalid(name, "its tree has a node whose levels or children are of the wrong kind")


def _invalid(name: str, problem: str) -> InvalidContainerError:
    return InvalidContainerError(f"{name}: {problem}; export the scene again")
