"""Files: scenes opened with a check of name and size, JSON from elsewhere, atomic output."""

from __future__ import annotations

import contextlib
import io
import json
import os
import shutil
import tempfile
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, BinaryIO, NoReturn, Protocol, runtime_checkable

import numpy as np

from kissgs.core.array_types import Shaped
from kissgs.core.errors import InvalidContainerError, InvalidSceneError, KissgsError, OutputError, UnsupportedError
from kissgs.core.splats import Splats, blocks

# JSON of files from elsewhere.

MAX_VALUES = 1 << 18
"""Largest number of values in a document: each takes up to 240 bytes of memory. A primitive of glTF has some 400, the
metadata of a container a thousand."""

MAX_DEPTH = 200
"""Largest nesting of lists and objects, also of ``web_decoder/container.js``: parsers end at different depths. The tree
of a streamed scene has two levels for each of its own."""


def parse_json(
    data: bytes,
    name: str,
    *,
    most: int = MAX_VALUES,
    parse_int: Callable[[str], Any] = int,
    error: type[KissgsError] = InvalidContainerError,
) -> Any:  # noqa: ANN401
    """Parse JSON; NaN and Infinity are refused, as browsers refuse them. The number of values is bounded before any is
    built, so commas and brackets in texts count as well."""
    if 1 + data.count(b",") + data.count(b"[") + data.count(b"{") > most:
        raise error(f"{name} has more than {most:,} values, which is the limit; export the scene again")
    try:
        document = json.loads(data.decode("utf-8-sig"), parse_int=parse_int, parse_constant=_refuse_constant)
        level = [document]
        for _ in range(MAX_DEPTH + 1):
            nested = [
                each.values() if isinstance(each, dict) else each for each in level if isinstance(each, dict | list)
            ]
            level = [value for values in nested for value in values]
        if any(isinstance(each, dict | list) for each in level):
            raise ValueError(f"nested more than {MAX_DEPTH} deep")
    except (ValueError, RecursionError) as problem:
        raise error(f"{name} is not readable JSON; export the scene again") from problem
    return document


def whole_number(value: object, least: int, most: int) -> int | None:
    """Return a whole number of JSON, which may be written 8.0, within bounds; None for anything else."""
    if isinstance(value, float) and value.is_integer():
        value = int(value)
    return value if isinstance(value, int) and not isinstance(value, bool) and least <= value <= most else None


def is_number(value: object, limit: float) -> bool:
    """Whether a value of JSON is a number, not true or false, that is nearer to zero than ``limit``."""
    return isinstance(value, int | float) and not isinstance(value, bool) and abs(value) < limit


def _refuse_constant(name: str) -> NoReturn:
    raise ValueError(f"{name} is not JSON")


# Atomic output: a temporary file beside the destination, renamed when it is complete.

BLOCK = 4096  # bytes that check_writable writes: at least one block of the file system


@contextlib.contextmanager
def atomic_file(path: Path, *, overwrite: bool = False) -> Iterator[BinaryIO]:
    """Open a binary file that replaces ``path`` when the block succeeds, and is deleted when it fails."""
    refuse_existing(path, overwrite=overwrite)
    temporary: Path | None = None
    try:
        descriptor, name = tempfile.mkstemp(dir=path.parent, prefix=".kissgs.", suffix=".part")
        temporary = Path(name)
        with os.fdopen(descriptor, "wb") as file:
            yield file
            file.flush()
            os.fsync(file.fileno())
        temporary.chmod(0o666 & ~umask())
        temporary.replace(path)
    except OSError as error:
        raise OutputError(f"cannot write {path}: {reason_of(error)}") from error
    finally:
        if temporary is not None:
            temporary.unlink(missing_ok=True)


def move_into_place(made: Path, path: Path) -> None:
    """Rename a complete file or folder to ``path`` on the same file system, replacing what is there: all or nothing."""
    old: Path | None = None
    try:
        if path.is_dir():
            old = path.rename(made.with_suffix(".old"))
        made.replace(path)
    except OSError as error:
        raise OutputError(f"cannot write {path}: {reason_of(error)}") from error
    finally:
        # After any end of the block, also an interrupt: the old folder is removed only if the new one is there.
        if old is not None and not path.exists():
            old.rename(path)
        elif old is not None:
            shutil.rmtree(old, ignore_errors=True)


def refuse_existing(path: Path, *, overwrite: bool) -> None:
    """Raise OutputError if no file can be written to ``path``; called before the work starts."""
    present, folder = path_state(path)
    if folder:
        raise OutputError(f"{path} is a folder; name a file")
    if present and not overwrite:
        raise OutputError(f"{path} exists already; choose another name or allow overwriting (--force)")
    check_writable(path)


def check_writable(path: Path) -> None:
    """Raise OutputError if no file can be written beside ``path``; called before the work starts."""
    try:
        with tempfile.TemporaryFile(dir=path.parent, prefix=".kissgs.", suffix=".part") as file:
            file.write(bytes(BLOCK))  # on a full disk, creating a file succeeds, but writing fails
    except OSError as error:
        raise OutputError(f"cannot write {path}: {reason_of(error)}") from error


def path_state(path: Path) -> tuple[bool, bool]:
    """Return whether ``path`` exists, and whether it is a folder."""
    try:
        present, folder, above = False, path.is_dir(), path.absolute().parent.is_dir()
        with contextlib.suppress(FileNotFoundError):
            path.lstat()
            present = True  # also for a broken link
    except (OSError, ValueError) as error:
        raise OutputError(f"cannot write {path!s:.100}: {reason_of(error)}") from error
    if not above:
        raise OutputError(f"cannot write {path}: there is no folder {path.parent}; make it first")
    return present, folder


def umask() -> int:
    """Return the umask: the permission bits that new files of this process do not get."""
    try:
        status = Path("/proc/self/status").read_text(encoding="ascii", errors="replace")
        return int(status.split("Umask:", 1)[1].split(maxsplit=1)[0], 8)
    except (OSError, IndexError, ValueError):
        current = os.umask(0o022)  # other systems can only return it while setting it, briefly for all threads
        os.umask(current)
        return current


def reason_of(error: OSError | ValueError) -> str:
    """Return the system's reason, as the end of a sentence; ValueError is an invalid name, such as one with NUL."""
    reason = error.strerror if isinstance(error, OSError) and error.strerror else str(error)
    return reason.lower()


# Opening of a scene file: a path or bytes, its name for messages, its size, reading with a check of both; writing.


@dataclass(frozen=True, slots=True)
class SceneFile:
    """Open file: ``name`` for messages, the seekable ``file``, and its ``size`` in bytes."""

    name: str
    file: io.BufferedIOBase
    size: int

    def read(self, offset: int, count: int) -> bytes:
        """Return ``count`` bytes at ``offset``."""
        if offset + count > self.size:
            raise self.cut_short(offset + count)
        self.file.seek(offset)
        data = self.file.read(count)
        if len(data) < count:
            raise self.cut_short(offset + count)
        return data

    def rows(self, offset: int, dtype: np.dtype, count: int) -> Iterator[tuple[slice, Shaped[np.ndarray, " B"]]]:
        """Yield ``count`` records at ``offset``, some thousand at a time, and which they are; they are overwritten."""
        parts = blocks(count)
        block = np.empty(parts[0].stop if parts else 0, dtype)
        self.file.seek(offset)
        for part in parts:
            rows = block[: part.stop - part.start]
            if self.file.readinto(rows.view(np.uint8).data) < rows.nbytes:
                raise self.cut_short(offset + part.stop * dtype.itemsize)
            yield part, rows

    def cut_short(self, needed: int) -> InvalidSceneError:
        """Return the error of a file that should have ``needed`` bytes or more."""
        return self.invalid(f"is cut short: it needs {needed:,} bytes but has {self.size:,}")

    def invalid(self, problem: str) -> InvalidSceneError:
        """Return the error of a file with a problem, which is the predicate of a sentence."""
        return InvalidSceneError(f"{self.name} {problem}; export or download it again")


@runtime_checkable
class BinaryWriter(Protocol):
    """Binary stream; only its ``write`` is called."""

    def write(self, data: bytes | memoryview, /) -> object:
        """Write all of ``data``."""


@contextlib.contextmanager
def open_scene_file(
    source: Path | bytes, remedy: str = "; name a scene file", error_class: type[KissgsError] = InvalidSceneError
) -> Iterator[SceneFile]:
    """Open a file, or the bytes of one; ``remedy`` is what to do where there is no file, for messages."""
    if isinstance(source, bytes):
        yield SceneFile("the data", io.BytesIO(source), len(source))
        return
    try:
        if not source.is_file():  # before opening, because opening a named pipe would wait for its writer
            reason = "it is a folder or a device" if source.exists() else "there is no such file"
            raise error_class(f"cannot read {source}: {reason}{remedy}")
        with source.open("rb") as file:
            yield SceneFile(source.name, file, os.fstat(file.fileno()).st_size)
    except OSError as error:
        raise error_class(f"cannot read {source}: {reason_of(error)}") from error


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


def refuse_degree(degree: int, name: str) -> None:
    """Raise UnsupportedError if an SH degree is above 3."""
    if degree > 3:
        raise UnsupportedError(f"{name} has SH degree {degree}; export it with degree 3 or lower")


def marked(splats: Splats, marks: Sequence[bool]) -> Splats:
    """Return a scene of several parts as antialiased if all of them are; a note says if only some are."""
    if any(marks) and not all(marks):
        note = "some parts are marked as trained with antialiasing and others are not: all are drawn without"
        return replace(splats, notes=(*splats.notes, note))
    return replace(splats, antialiased=any(marks))
