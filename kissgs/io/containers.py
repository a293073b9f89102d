"""Files of a container: reading them from a folder, a zip or memory, and writing a folder or a zip."""

from __future__ import annotations

import contextlib
import io
import os
import shutil
import struct
import tempfile
import threading
import zipfile
import zlib
from collections.abc import Collection, Iterator, Mapping
from pathlib import Path
from typing import Literal, NamedTuple, Protocol, runtime_checkable

from kissgs.core.errors import InvalidContainerError, OutputError
from kissgs.io.files import atomic_file, check_writable, move_into_place, path_state, reason_of, refuse_existing, umask

MAX_ZIP_ENTRIES = 1000  # largest number of entries: a container has 12 files, to which users may add notes and previews
MAX_TREE_ENTRIES = 20_000  # largest number of entries of a zip of many containers, each of which has up to eight files
MAX_DIRECTORY_BYTES = 1 << 21  # largest list of entries in a zip, which is read whole

META_NAME = "meta.json"

MAX_METADATA_BYTES = 1 << 20  # largest metadata file, bytes; kissgs writes 4 kB for SOG-XT, 15 kB for SOG

_END, _END64 = b"PK\x05\x06", b"PK\x06\x07"
_END_SIZE, _MAX_COMMENT = 22, 0xFFFF
_ENTRY = struct.Struct("<4s4xHH4xIIIHHH8xI")
_LOCAL = struct.Struct("<4s22xHH")
_STORED, _DEFLATED = 0, 8
_BLOCK = 1 << 20

ZIP_MAGICS = (b"PK\x03\x04", _END)  # first bytes of a zip file, and of an empty one


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
        if name not in self._files:
            raise _missing(name)
        _refuse_larger(name, self.size(name), limit)
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
            if not is_below(name) or not (self._folder / name).is_file():
                raise _missing(name)
            _refuse_larger(name, self.size(name), limit)
            return (self._folder / name).read_bytes()
        except (OSError, ValueError) as error:
            raise InvalidContainerError(f"cannot read {self._folder / name}: {reason_of(error)}") from error


class ZipSource:
    """Files in a zip. Nothing is extracted to disk. Without ``root`` they are known by their names alone, wherever in
    the zip they are. With ``root``, the name of a file that must be there once, they are known by their paths from its
    folder."""

    def __init__(self, file: io.BufferedIOBase, label: str, root: str | None = None) -> None:
        if sniff_format(file) == "ply":
            raise InvalidContainerError(f"{label} is a .ply, not a container; kissgs convert reads both")
        entries = _read_directory(file, label, MAX_TREE_ENTRIES if root else MAX_ZIP_ENTRIES)
        self._file, self._lock = file, threading.Lock()
        self._flat = root is None
        folder = ""
        if root is not None:
            above = [entry.path[: -len(root)] for entry in entries if entry.path.rsplit("/", 1)[-1] == root]
            if len(above) != 1:
                raise InvalidContainerError(f"{label} holds {len(above)} files named {root!r}; one is needed")
            folder = above[0]
        self._entries: dict[str, _Entry] = {}
        for entry in entries:
            if not entry.path.startswith(folder) or entry.path.endswith("/"):
                continue
            name = self._key(entry.path) if self._flat else entry.path[len(folder) :]
            if name in self._entries:
                raise InvalidContainerError(f"{label} holds two files named {name!r}")
            if name:
                self._entries[name] = entry

    def names(self) -> frozenset[str]:
        """See :class:`Source`."""
        return frozenset(self._entries)

    def size(self, name: str) -> int:
        """See :class:`Source`."""
        return self._entries[self._key(name)].packed

    def read(self, name: str, limit: int) -> bytes:
        """See :class:`Source`."""
        entry = self._entries.get(self._key(name))
        if entry is None:
            raise _missing(name)
        _refuse_larger(name, entry.size, limit)
        if entry.method not in (_STORED, _DEFLATED):
            raise InvalidContainerError(f"{name} has zip compression method {entry.method}; store or deflate it")
        try:
            return self._content(entry)
        except (OSError, ValueError, zlib.error) as error:
            raise InvalidContainerError(f"{name} cannot be read from the zip: it is damaged or encrypted") from error

    def _content(self, entry: _Entry) -> bytes:
        magic, name_length, extra_length = _LOCAL.unpack(self._bytes(entry.local, _LOCAL.size))
        if magic != ZIP_MAGICS[0] or self._bytes(entry.local + _LOCAL.size, name_length) != entry.raw_name:
            raise ValueError("no such entry there")
        start = entry.local + _LOCAL.size + name_length + extra_length
        if entry.method == _DEFLATED:
            data = self._inflated(start, entry.packed, entry.size)
        else:
            data = self._bytes(start, min(entry.packed, entry.size + 1))
        if entry.flags & 1 or len(data) != entry.size or zlib.crc32(data) != entry.crc:
            raise ValueError("encrypted, or other bytes than were stored")
        return data

    def _inflated(self, start: int, packed: int, size: int) -> bytes:
        """Unpack ``packed`` bytes; stop after ``size`` bytes and one more, since the declared size may be a lie."""
        inflater, data = zlib.decompressobj(-zlib.MAX_WBITS), bytearray()
        for at in range(start, start + packed, _BLOCK):
            data += inflater.decompress(self._bytes(at, min(_BLOCK, start + packed - at)), size + 1 - len(data))
            if len(data) > size or inflater.unused_data:
                break
        if not inflater.eof or inflater.unused_data:
            raise ValueError("the compressed data ends elsewhere")
        return bytes(data)

    def _bytes(self, offset: int, count: int) -> bytes:
        with self._lock:  # several threads read
            self._file.seek(offset)
            data = self._file.read(count)
        if len(data) < count:
            raise ValueError("the file ends before")
        return data

    def _key(self, name: str) -> str:
        return name.rsplit("/", 1)[-1] if self._flat else name


class _Entry(NamedTuple):
    """Entry of a zip's directory: its path with slashes, and its fields; ``local`` is the offset in the file."""

    path: str
    raw_name: bytes
    flags: int
    method: int
    crc: int
    packed: int
    size: int
    local: int


def _read_directory(file: io.BufferedIOBase, label: str, most: int) -> list[_Entry]:
    """Return the entries of a zip, by the rule of docs/reference/format.md, which web_decoder/zip.js follows too."""
    damaged = InvalidContainerError(f"{label} is not a readable zip file; export or download it again")
    try:
        length = file.seek(0, io.SEEK_END)
        file.seek(max(0, length - _END_SIZE - _MAX_COMMENT))
        tail = file.read()
        at = tail.rfind(_END, 0, max(0, len(tail) - _END_SIZE + len(_END)))
        if at < 0:
            raise damaged
        count, size, offset = struct.unpack_from("<HII", tail, at + 10)
        if count == 0xFFFF or offset == 0xFFFFFFFF or tail[max(0, at - 20) : at].startswith(_END64):
            raise InvalidContainerError(f"{label} is a zip64 file; pack it as an ordinary zip")
        if count > most:
            raise InvalidContainerError(f"{label} has {count} entries; a container has 12 files")
        if size > MAX_DIRECTORY_BYTES:
            raise InvalidContainerError(
                f"{label} has a list of entries above {MAX_DIRECTORY_BYTES} bytes; pack it again"
            )
        start = length - len(tail) + at - size
        if start < offset:
            raise damaged
        file.seek(start)
        directory = file.read(size)
    except (OSError, ValueError) as error:
        raise damaged from error
    entries, at = [], 0
    for _ in range(count):
        if at + _ENTRY.size > size:
            raise damaged
        magic, flags, method, crc, packed, unpacked, name, extra, comment, local = _ENTRY.unpack_from(directory, at)
        raw_name = directory[at + _ENTRY.size : at + _ENTRY.size + name]
        at += _ENTRY.size + name + extra + comment
        if magic != b"PK\x01\x02" or at > size:
            raise damaged
        path = raw_name.decode("utf-8", "replace").replace("\\", "/")
        # Data before the zip, such as a self-extractor, moves all entries.
        entries.append(_Entry(path, raw_name, flags, method, crc, packed, unpacked, start - offset + local))
    if at != size:
        raise damaged
    return entries


def zip_names(file: io.BufferedIOBase) -> list[str]:
    """Return the names of all entries of a zip, folders included; none of a file that is none."""
    try:
        return [entry.path for entry in _read_directory(file, "the file", MAX_TREE_ENTRIES)]
    except InvalidContainerError:
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
    return "zip" if head in ZIP_MAGICS or zip_names(file) else None


@contextlib.contextmanager
def open_source(source: Path | bytes | Mapping[str, bytes], root: str | None = None) -> Iterator[Source]:
    """Open a container for reading: a folder, a zip file, the bytes of one, or files in memory. ``root`` is that of
    :class:`ZipSource`."""
    if isinstance(source, bytes):
        yield ZipSource(io.BytesIO(source), "the input", root)
        return
    if not isinstance(source, Path):
        yield MemorySource(source)
        return
    try:
        if source.exists() and not (source.is_file() or source.is_dir()):
            raise InvalidContainerError(f"{source} is neither a file nor a folder")
        file = None if source.is_dir() else source.open("rb")
    except (OSError, ValueError) as error:
        raise InvalidContainerError(f"cannot read {source}: {reason_of(error)}") from error
    with file or contextlib.nullcontext():
        yield DirectorySource(source) if file is None else ZipSource(file, str(source), root)


def _refuse_larger(name: str, size: int, limit: int) -> None:
    if size > limit:
        raise InvalidContainerError(f"{name} has {size} bytes; the limit for this file is {limit}")


def _missing(name: str) -> InvalidContainerError:
    return InvalidContainerError(f"the container has no file {name!r}; export or download it again")


def stored_size(files: Source, name: str) -> int:
    """Return the size of a file, bytes."""
    try:
        return files.size(name)
    except (KeyError, OSError, ValueError) as error:
        raise _missing(name) from error


def stated_text(value: object) -> str | None:
    """Return a text of the metadata, fit for a message."""
    return value[:100] if isinstance(value, str) else None


def is_antialiased(model: str | None) -> bool:
    """Whether a variant of the renderer, which metadata may name, compensates opacities."""
    return model is not None and model.lower() == "antialiased"


# Writing of a container: a folder or a zip, atomically and with the same bytes every time.

PACKED = (".zip", ".sog")  # endings of containers in one file; all others are folders


def zip_bytes(files: Mapping[str, bytes]) -> bytes:
    """Return a zip of the files, images stored and text deflated; equal files give equal bytes (no time, no system)."""
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w") as archive:
        for name, data in files.items():
            entry = zipfile.ZipInfo(name, date_time=(1980, 1, 1, 0, 0, 0))
            entry.compress_type = zipfile.ZIP_STORED if name.endswith(".webp") else zipfile.ZIP_DEFLATED
            entry.create_system = 3
            entry.external_attr = 0o644 << 16
            archive.writestr(entry, data, compresslevel=9)
    return buffer.getvalue()


def stored_sizes(files: Mapping[str, bytes], *, packed: bool) -> tuple[int, dict[str, int]]:
    """Return the total size in bytes, and that of each file: as a zip if ``packed``, else as a folder."""
    if not packed:
        sizes = {name: len(data) for name, data in files.items()}
        return sum(sizes.values()), sizes
    archive = zip_bytes(files)
    with open_source(archive) as stored:
        return len(archive), {name: stored.size(name) for name in files}


def is_packed(path: Path) -> bool:
    """Whether a container of that name is a zip, not a folder."""
    return path.suffix.lower() in PACKED


def write_container(
    files: Mapping[str, bytes], path: Path, *, overwrite: bool = False, names: Collection[str] = ()
) -> int:
    """Write a container atomically: a zip if the name ends in ``.zip`` or ``.sog``, else a folder; return its bytes. A
    folder is replaced only if it holds the files of a container, or those of ``names``, and nothing else."""
    check_destination(path, overwrite=overwrite, names={*files, *names})
    if not is_packed(path):
        _write_directory(files, path)
        return sum(map(len, files.values()))
    data = zip_bytes(files)
    with atomic_file(path, overwrite=overwrite) as file:
        file.write(data)
    return len(data)


def check_destination(path: Path, *, overwrite: bool, names: Collection[str]) -> None:
    """Raise OutputError if a container may not be written to ``path``; called before the work starts. ``names`` are the
    only files that a folder may hold to be replaced."""
    if is_packed(path):
        refuse_existing(path, overwrite=overwrite)
        return
    present, folder = path_state(path)
    if present and not overwrite:
        raise OutputError(f"{path} exists already; choose another name or allow overwriting (--force)")
    try:
        found = {entry.name for entry in path.iterdir()} if folder else set()
    except OSError as error:
        raise OutputError(f"cannot list {path}: {reason_of(error)}") from error
    if present and (not folder or found - set(names)):
        raise OutputError(f"{path} holds more than a container; name an empty or a new folder, or a .zip file")
    check_writable(path)


def _write_directory(files: Mapping[str, bytes], path: Path) -> None:
    temporary: Path | None = None
    try:
        temporary = Path(tempfile.mkdtemp(dir=path.parent, prefix=".kissgs.", suffix=".part"))
        for name, data in files.items():
            with (temporary / name).open("wb") as file:
                file.write(data)
                file.flush()
                os.fsync(file.fileno())
        temporary.chmod(0o777 & ~umask())
        move_into_place(temporary, path)
    except OSError as error:
        raise OutputError(f"cannot write {path}: {reason_of(error)}") from error
    finally:
        if temporary is not None and temporary.exists():
            shutil.rmtree(temporary)
