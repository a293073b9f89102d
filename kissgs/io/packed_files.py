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

MAX_TREE_ENTRIES = 20_000
"""Largest number of entries of a zip of many containers, each of which has up to eight files."""

MAX_DIRECTORY_BYTES = 1 << 21
"""Largest list of entries in a zip, which is read whole."""

_ENTRY, _END, _END64 = b"PK\x01\x02", b"PK\x05\x06", b"PK\x06\x07"

ZIP_MAGICS = (b"PK\x03\x04", _END)
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
    """Files in a folder. :meth:`names` lists those directly in it; :meth:`read` also takes paths below it."""

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
            present = is_below(name) and (self._folder / name).is_file()
            _check(name, present, self.size(name) if present else 0, limit)
            return (self._folder / name).read_bytes()
        except (OSError, ValueError) as error:
            raise InvalidContainerError(f"cannot read {self._folder / name}: {reason_of(error)}") from error


class ZipSource:
    """Files in a zip. Nothing is extracted to disk.

    Without ``root`` they are known by their names alone, wherever in the zip they are. With ``root``, the name of a
    file that must be there once, they are known by their paths from its folder.
    """

    def __init__(self, file: io.BufferedIOBase, label: str, root: str | None = None) -> None:
        if sniff_format(file) == "ply":
            raise InvalidContainerError(f"{label} is a .ply, not a container; kissgs convert reads both")
        self._zip, entries = _open_zip(file, label, MAX_TREE_ENTRIES if root else MAX_ZIP_ENTRIES)
        self._flat = root is None
        paths = [(entry.filename.replace("\\", "/"), entry) for entry in entries]
        folder = ""
        if root is not None:
            above = [path[: -len(root)] for path, _ in paths if path.rsplit("/", 1)[-1] == root]
            if len(above) != 1:
                raise InvalidContainerError(f"{label} holds {len(above)} files named {root!r}; one is needed")
            folder = above[0]
        self._entries: dict[str, zipfile.ZipInfo] = {}
        for path, entry in paths:
            if not path.startswith(folder):
                continue
            name = path.rsplit("/", 1)[-1] if self._flat else path[len(folder) :]
            if name in self._entries:
                raise InvalidContainerError(f"{label} holds two files named {name!r}")
            self._entries[name] = entry

    def names(self) -> frozenset[str]:
        """See :class:`Source`."""
        return frozenset(self._entries)

    def size(self, name: str) -> int:
        """See :class:`Source`."""
        return self._entries[self._key(name)].compress_size

    def read(self, name: str, limit: int) -> bytes:
        """See :class:`Source`."""
        entry = self._entries.get(self._key(name))
        _check(name, entry is not None, entry.file_size if entry else 0, limit)
        try:
            with self._zip.open(entry or name) as file:
                data = file.read(limit + 1)  # never trust the declared size of a deflated entry
        except Exception as error:
            raise InvalidContainerError(f"{name} cannot be read from the zip: it is damaged or encrypted") from error
        _check(name, True, len(data), limit)
        return data

    def _key(self, name: str) -> str:
        return name.rsplit("/", 1)[-1] if self._flat else name


def _open_zip(file: io.BufferedIOBase, label: str, most: int) -> tuple[zipfile.ZipFile, list[zipfile.ZipInfo]]:
    """Open a zip; return it and its files."""
    try:
        _check_directory(file, label, most)
        archive = zipfile.ZipFile(file)
        entries = archive.infolist()
    except (zipfile.BadZipFile, OSError, ValueError, NotImplementedError, EOFError) as error:
        raise InvalidContainerError(f"{label} is not a readable zip file; export or download it again") from error
    return archive, [entry for entry in entries if entry.filename and not entry.is_dir()]


def _check_directory(file: io.BufferedIOBase, label: str, most: int) -> None:
    """Refuse zips of more than ``most`` entries before any is read, and those of a kind that no reader of SOG knows."""
    begin = max(0, file.seek(0, io.SEEK_END) - (1 << 16) - 42)
    file.seek(begin)
    tail = file.read()
    at = len(tail) - 22
    if not (at >= 0 and tail[at:].startswith(_END) and tail.endswith(b"\0\0")):  # with a comment, as zipfile finds it
        at = tail.rfind(_END)
    if at >= 0 and len(tail) >= at + 22:
        size = int.from_bytes(tail[at + 12 : at + 16], "little")
        if size > MAX_DIRECTORY_BYTES:
            raise InvalidContainerError(
                f"{label} has a list of entries above {MAX_DIRECTORY_BYTES} bytes; pack it again"
            )
        if tail[max(0, at - 20) : at].startswith(_END64):
            raise InvalidContainerError(f"{label} is a zip64 file; pack it as an ordinary zip")
        file.seek(max(0, begin + at - size))
        if (count := file.read(size).count(_ENTRY)) > most:
            raise InvalidContainerError(f"{label} has {count} entries; a container has 12 files")
    file.seek(0)


def zip_names(file: io.BufferedIOBase) -> list[str]:
    """Return the names of all entries of a zip, folders included; none if it cannot be read."""
    try:
        _check_directory(file, "the file", MAX_TREE_ENTRIES)
        return zipfile.ZipFile(file).namelist()
    except (InvalidContainerError, zipfile.BadZipFile, OSError, ValueError, NotImplementedError, EOFError):
        return []


def is_below(name: str) -> bool:
    """Whether a file name from inside a file is a relative path that does not leave its folder."""
    parts = name.replace("\\", "/").split("/")
    return bool(name) and ".." not in parts and parts[0] != "" and ":" not in parts[0] and "\0" not in name


def is_file_name(name: object) -> bool:
    """Whether a value is the relative path of a file below its folder, fit for a message."""
    return isinstance(name, str) and len(name) <= 255 and name.isprintable() and is_below(name)


def sniff_format(file: io.BufferedIOBase) -> Literal["ply", "zip"] | None:
    """Return the format of a file, None for an unknown one; a zip may have data before it, a ``.ply`` may not."""
    file.seek(0)
    head = file.read(4)
    file.seek(0)
    if head[:3] == b"ply" and head[3:].isspace():
        return "ply"
    return "zip" if head in ZIP_MAGICS or zipfile.is_zipfile(file) else None


@contextlib.contextmanager
def open_source(source: Path | bytes | Mapping[str, bytes], root: str | None = None) -> Iterator[Source]:
    """Open a container for reading: a folder, a zip file, the bytes of one, or files in memory.

    ``root`` is that of :class:`ZipSource`.

    Raises:
        InvalidContainerError: ``source`` cannot be read or is not a zip file.
    """
    if isinstance(source, bytes):
        yield ZipSource(io.BytesIO(source), "the input", root)
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
            yield ZipSource(file, str(source), root)


def _check(name: str, present: bool, size: int, limit: int) -> None:
    if not present:
        raise InvalidContainerError(f"the container has no file {name!r}; export or download it again")
    if size > limit:
        raise InvalidContainerError(f"{name} has {size} bytes; the limit for this file is {limit}")
