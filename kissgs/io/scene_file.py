"""Opening of a scene file: a path or bytes, its name for messages, its size, reading with a check of both; writing."""

from __future__ import annotations

import contextlib
import io
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Protocol, runtime_checkable

import numpy as np

from kissgs.core.array_types import UInt8
from kissgs.core.errors import InvalidSceneError, UnsupportedError
from kissgs.core.splats import Splats


@dataclass(frozen=True, slots=True)
class SceneFile:
    """Open file: ``name`` for messages, the seekable ``file``, and its ``size`` in bytes."""

    name: str
    file: io.BufferedIOBase
    size: int

    def read(self, offset: int, count: int) -> bytes:
        """Return ``count`` bytes at ``offset``.

        Raises:
            InvalidSceneError: the file ends before.
        """
        if offset + count > self.size:
            raise self.cut_short(offset + count)
        self.file.seek(offset)
        data = self.file.read(count)
        if len(data) < count:
            raise self.cut_short(offset + count)
        return data

    def read_into(self, offset: int, array: np.ndarray) -> None:
        """Fill ``array``, which is contiguous, with the bytes at ``offset``.

        Raises:
            InvalidSceneError: the file ends before.
        """
        target: UInt8[np.ndarray, " bytes"] = array.view(np.uint8).reshape(-1)
        self.file.seek(offset)
        if self.file.readinto(target.data) < target.size:
            raise self.cut_short(offset + target.size)

    def cut_short(self, needed: int) -> InvalidSceneError:
        """Return the error of a file that should have ``needed`` bytes or more."""
        return InvalidSceneError(
            f"{self.name} is cut short: it needs {needed:,} bytes but has {self.size:,}; export or download it again"
        )


@runtime_checkable
class BinaryWriter(Protocol):
    """Binary stream; only its ``write`` is called."""

    def write(self, data: bytes | memoryview, /) -> object:
        """Write all of ``data``."""


@contextlib.contextmanager
def open_scene_file(source: Path | bytes, remedy: str = "name a scene file") -> Iterator[SceneFile]:
    """Open a file, or the bytes of one; ``remedy`` is what to do where there is no file, for messages.

    Raises:
        InvalidSceneError: the file cannot be read.
    """
    if isinstance(source, bytes):
        yield SceneFile("the data", io.BytesIO(source), len(source))
        return
    try:
        if not source.is_file():  # before opening, because opening a named pipe would wait for its writer
            reason = "it is a folder or a device" if source.exists() else "there is no such file"
            raise InvalidSceneError(f"cannot read {source}: {reason}; {remedy}")
        with source.open("rb") as file:
            size = file.seek(0, io.SEEK_END)
            file.seek(0)
            yield SceneFile(source.name, file, size)
    except OSError as error:
        raise InvalidSceneError(f"cannot read {source}: {(error.strerror or str(error)).lower()}") from error


def listed(names: Sequence[str]) -> str:
    """Return names from a file for a message, of bounded length: the first six, and how many more there are."""
    shown = [name if len(name) <= 100 and name.isprintable() else repr(name[:100]) for name in names[:6]]
    more = f" and {len(names) - 6:,} more" if len(names) > 6 else ""
    return ", ".join(shown) + more


def refuse_more_than(limit: int | None, count: int, name: str) -> None:
    """Raise UnsupportedError if ``count`` Gaussians are more than ``limit``; None: no limit."""
    if limit is not None and count > limit:
        raise UnsupportedError(
            f"{name} has {count:,} Gaussians; the limit is {limit:,}: raise it (--max-gaussians) if you trust the file"
        )


def marked(splats: Splats, marks: Sequence[bool]) -> Splats:
    """Return a scene of several parts as antialiased if all of them are; a note says if only some are."""
    if any(marks) and not all(marks):
        note = "some parts are marked as trained with antialiasing and others are not: all are drawn without"
        return replace(splats, notes=(*splats.notes, note))
    return replace(splats, antialiased=any(marks))
