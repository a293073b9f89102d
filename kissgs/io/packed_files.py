"""The files of a container: in a folder, a zip or memory. Names and sizes are checked before reading."""

from __future__ import annotations

import contextlib
import io
import zipfile
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Literal, Protocol, runtime_checkable

from kissgs.core.errors import InvalidContainerError
from kissgs.io.atomic import reason_of

MAX_ZIP_ENTRIES = 1000
"""Largest number of entries: a container has 12 files, to which users may add notes and previews."""


ZIP_MAGICS = (b"PK\x03\x04", b"PK\x05\x06")
"""First bytes of a zip file, and of an empty one."""


@runtime_checkable
class Source(Protocol):
    """Source that a container's files are read from."""

    def names(self) -> frozenset[str]:
        """Return the names of all files."""

    def size(self, name: str) -> int:
        """Return the size of one file of :meth:`names`, bytes; in a zip, the compressed size."""

    def read(self, name: str, limit: int) -> bytes:
        """Return the bytes of one file; raise InvalidContainerError if it is missing or has more than ``limit``."""


class MemorySource:
    """Files in memory."""

    def __init__(self, files: Mapping[str, bytes]) -> None:
        self._files = files

    def names(self) -> frozenset[str]:
        """See :class:`Source`."""
        return frozenset(self._files)

    def size(self, name: str) -> int:
        """See :class:`Source`."""
        return len(self._files[name])

    def read(self, name: str, limit: int) -> bytes:
        """See :class:`Source`."""
        _check(name, name in self._files, len(self._files.get(name, b"")), limit)
        return self._files[name]


class DirectorySource:
    """Files in a folder."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        try:
            self._names = frozenset(entry.name for entry in folder.iterdir() if entry.is_file())
        except OSError as error:
            raise InvalidContainerError(f"cannot read {folder}: {reason_of(error)}") from error

    def names(self) -> frozenset[str]:
        """See :class:`Source`."""
        return self._names

    def size(self, name: str) -> int:
        """See :class:`Source`."""
        return (self._folder / name).stat().st_size

    def read(self, name: str, limit: int) -> bytes:
        """See :class:`Source`."""
        try:
            _check(name, name in self._names, self.size(name) if name in self._names else 0, limit)
            return (self._folder / name).read_bytes()
        except OSError as error:
            raise InvalidContainerError(f"cannot read {self._folder / name}: {reason_of(error)}") from error


class ZipSource:
    """Files in a zip, at its top or together in a folder. Nothing is extracted to disk."""

    def __init__(self, file: io.BufferedIOBase, label: str) -> None:
        if sniff_format(file) == "ply":
            raise InvalidContainerError(f"{label} is a .ply, not a container; compress it first")
        try:
            self._zip = zipfile.ZipFile(file)
            entries = self._zip.infolist()
        except (zipfile.BadZipFile, OSError, ValueError, NotImplementedError, EOFError) as error:
            raise InvalidContainerError(f"{label} is not a readable zip file") from error
        if len(entries) > MAX_ZIP_ENTRIES:
            raise InvalidContainerError(f"{label} has {len(entries)} entries; a container has 12 files")
        self._entries: dict[str, zipfile.ZipInfo] = {}
        for entry in entries:
            if not entry.filename or entry.is_dir():
                continue
            name = entry.filename.replace("\\", "/").rsplit("/", 1)[-1]
            if name in self._entries:
                raise InvalidContainerError(f"{label} holds two files named {name!r}")
            self._entries[name] = entry

    def names(self) -> frozenset[str]:
        """See :class:`Source`."""
        return frozenset(self._entries)

    def size(self, name: str) -> int:
        """See :class:`Source`."""
        return self._entries[name].compress_size

    def read(self, name: str, limit: int) -> bytes:
        """See :class:`Source`."""
        entry = self._entries.get(name)
        _check(name, entry is not None, entry.file_size if entry else 0, limit)
        try:
            with self._zip.open(entry or name) as file:
                data = file.read(limit + 1)  # never trust the declared size of a deflated entry
        except Exception as error:
            raise InvalidContainerError(f"{name} cannot be read from the zip: it is damaged or encrypted") from error
        _check(name, True, len(data), limit)
        return data


def sniff_format(file: io.BufferedIOBase) -> Literal["ply", "zip"] | None:
    """Return the format of a file, None for an unknown one; a zip may have data before it, a ``.ply`` may not."""
    file.seek(0)
    head = file.read(4)
    file.seek(0)
    if head[:3] == b"ply" and head[3:].isspace():
        return "ply"
    return "zip" if head in ZIP_MAGICS or zipfile.is_zipfile(file) else None


@contextlib.contextmanager
def open_source(source: Path | bytes | Mapping[str, bytes]) -> Iterator[Source]:
    """Open a container for reading: a folder, a zip file, the bytes of one, or files in memory.

    Raises:
        InvalidContainerError: ``source`` cannot be read or is not a zip file.
    """
    if isinstance(source, bytes):
        yield ZipSource(io.BytesIO(source), "the input")
    elif not isinstance(source, Path):
        yield MemorySource(source)
    else:
        try:
            if source.exists() and not (source.is_file() or source.is_dir()):
                raise InvalidContainerError(f"{source} is neither a file nor a folder")
            file = None if source.is_dir() else source.open("rb")
        except (OSError, ValueError) as error:
            raise InvalidContainerError(f"cannot read {source}: {reason_of(error)}") from error
        if file is None:
            yield DirectorySource(source)
            return
        with file:
            yield ZipSource(file, str(source))


def _check(name: str, present: bool, size: int, limit: int) -> None:
    if not present:
        raise InvalidContainerError(f"the container has no file {name!r}")
    if size > limit:
        raise InvalidContainerError(f"{name} has {size} bytes; the limit for this file is {limit}")
