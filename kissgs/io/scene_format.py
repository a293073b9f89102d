"""Interface of the modules of scene formats, for ``kissgs.formats``: recognise, describe, read, write."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from enum import IntEnum
from pathlib import Path
from typing import Any, Literal

from kissgs.core.context import Progress
from kissgs.core.splats import MAX_GAUSSIANS, Splats
from kissgs.io.files import BinaryWriter

SceneSource = Path | bytes | Mapping[str, bytes]  # a file or folder, the bytes of a file, or a container's files


@dataclass(frozen=True, slots=True, kw_only=True)
class ReadOptions:
    """Options for reading a scene, of which each format heeds those that concern it.

    Attributes:
        max_gaussians: largest number of Gaussians; more are refused before memory is allocated. By default 20 million
            for formats whose scene can take far more memory than the file; no limit for ``.ply``, ``.splat`` and
            ``.ksplat``, whose scene takes at most four times the bytes of the file.
        level: level of detail of a streamed scene; 0 is the finest.
        raw_axes: read ``.spz`` that stores the axes of a ``.ply`` without saying so, as some tools write it.
        origin: "auto" makes positions relative to the whole numbers nearest to the middle of the scene
            (:attr:`kissgs.Splats.origin`), where containers have the finest steps. By default the origin is that of the
            file, or the middle of the scene where float32 cannot hold its positions.
        antialiased: whether the scene was trained with antialiasing (:class:`kissgs.Splats`); None: as the file says.
    """

    max_gaussians: int | None = None
    level: int = 0
    raw_axes: bool = False
    origin: Literal["auto"] | None = None
    antialiased: bool | None = None

    @classmethod
    def allowing(cls, count: int) -> ReadOptions:
        """Return options that read a scene of ``count`` Gaussians, or of any number that is read by default."""
        return cls(max_gaussians=max(count, MAX_GAUSSIANS))

    @property
    def max_compressed(self) -> int:
        """Largest number of Gaussians of formats whose scene can take far more memory than the file."""
        return MAX_GAUSSIANS if self.max_gaussians is None else self.max_gaussians

    def marked(self, splats: Splats) -> Splats:
        """Return a scene that was read, antialiased or not as these options say."""
        return splats if self.antialiased is None else replace(splats, antialiased=self.antialiased)


DEFAULT_READ_OPTIONS = ReadOptions()


class Match(IntEnum):
    """How surely the beginning of a file is of a format."""

    NO = 0
    POSSIBLE = 1  # text that counts unless the ending is that of a format with a mark
    LIKELY = 2  # plausible numbers without a mark, which count unless the ending is that of another format without one
    SURE = 3  # a mark, whatever the ending


@dataclass(frozen=True, slots=True, kw_only=True)
class Facts:
    """Statements of a header or of the metadata of a container, for ``kissgs info``."""

    title: str  # name of the format, with what is special about the file
    count: int  # Gaussians; of a streamed scene, those of one level and the environment
    sh_degree: int
    details: dict[str, Any] = field(default_factory=dict)
    parts: dict[str, int] = field(default_factory=dict)  # bytes of each file of a container, or of each container
    ranges: dict[str, tuple[float, float]] = field(default_factory=dict)  # values of the lowest and highest level
    changed: dict[str, int] = field(default_factory=dict)  # Gaussians that the encoder removed or corrected, by reason
    notes: tuple[str, ...] = ()  # phrases for what reading leaves out or changes
    lines: tuple[str, ...] = ()  # sentences about details, for the terminal


def titled(name: str, *special: str | None) -> str:
    """Return the title of :class:`Facts`; what is special may be empty."""
    words = ", ".join(filter(None, special))
    return f"{name} ({words})" if words else name


Read = Callable[[Any, ReadOptions, int, Progress], Splats]
"""Read a :data:`SceneSource` without cleaning it, with a number of threads (0: one per processor)."""

Notes = tuple[str, ...]
Write = Callable[[BinaryWriter, Splats, bool, Progress], Notes]
"""Write a scene, with the axes of a ``.ply`` if true; return a phrase for each loss beyond the format's steps."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Codec:
    """Code of one format."""

    info: Callable[[Any, int], Facts]  # describe a file or its bytes, or a level of detail of a streamed scene
    read: Read
    sniff: Callable[[bytes, int], Match] = lambda head, size: Match.NO  # from a file's first bytes and its size
    write: Mapping[str, Write] = field(default_factory=dict)  # writers by ending; all but .ply get a clean scene
    records_origin: bool = False
    """Whether files of other endings than ``.ply`` record the origin of a scene, as the translation of a node."""
