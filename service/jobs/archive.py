"""Archives of captures, zip or tar: unpacking, and the check that the views can be loaded. It runs in a job process,
whose limits of memory and time end what a hostile archive begins."""

from __future__ import annotations

import errno
import json
import os
import shutil
import stat
import struct
import tarfile
import zipfile
import zlib
from collections.abc import Callable, Iterator
from contextlib import ExitStack, suppress
from functools import partial
from lzma import LZMAError
from pathlib import Path, PurePosixPath
from typing import IO, Any

import kissgs
from kissgs.formats import CAMERA_FILES, PHOTOGRAPHS, is_packable

from ..core.files import sync_folder
from .job_process import Task, write_file

RECORD = "unpacked.json"  # the bytes of each file of a capture, to notice when a later job finds less
ZIP_MAGICS = (b"PK\x03\x04", b"PK\x05\x06", b"PK\x07\x08")

DAMAGED = (
    zipfile.BadZipFile,
    tarfile.TarError,
    zlib.error,
    LZMAError,
    EOFError,
    ValueError,
    OverflowError,  # of sizes and offsets
    struct.error,
    RuntimeError,  # of encrypted files
    NotImplementedError,  # of unknown compression
    OSError,  # of bz2 and gzip, of offsets, and of names that occur twice; except for DISK_ERRORS
)
"""Errors of the readers, and of the file system, for damaged and odd archives."""

DISK_ERRORS = (errno.ENOSPC, errno.EDQUOT, errno.EIO)

Opener = Callable[[], IO[bytes] | None]


def unpack(task: Task, progress: kissgs.Progress) -> dict[str, Any]:
    """Unpack what a capture needs of the archive ``source``, if there is one, into the folder ``work``, and load its
    views. Return the ``bytes`` of all files, and whether there are ``photographs`` to train on and to evaluate with;
    ``bytes`` is None of a capture that was unpacked earlier and has lost files."""
    folder, record = Path(task["work"]), Path(task["work"]) / RECORD
    if not task["source"] and not (record.exists() and record.read_bytes() == _as_json(_sizes(folder))):
        return {"bytes": None}
    others: list[PurePosixPath] = []
    try:
        with ExitStack() as stack:
            if task["source"]:
                entries = _entries(Path(task["source"]), stack)
                others = _write_files(entries, folder, task["most_bytes"], task["most_files"])
    except DAMAGED as error:
        if isinstance(error, OSError) and error.errno in DISK_ERRORS:
            reason = (error.strerror or str(error)).lower()
            raise kissgs.OutputError(f"the capture cannot be unpacked: {reason}; try again later") from error
        raise _refusal("is damaged or encrypted, or has two files of one name; pack it again") from error
    try:
        views = kissgs.load_views(folder, unpacked=True)
    except kissgs.KissgsError as error:
        text = str(error)
        for path in (folder.resolve(), folder):
            text = text.replace(f"{path}/", "").replace(f"{path}", "the capture")
        raise type(error)(text) from error
    if views.note and (unused := _photograph(others, views)):
        remedy = "pack photographs as .png, .jpg or .webp where the cameras name them, in 'images' for COLMAP, or none"
        raise _refusal(f"has no photographs that can be used, but {str(unused)[:80]!r}; {remedy}")
    if task["source"]:
        write_file(record, _as_json(_sizes(folder)))
    for path in (folder, *folder.rglob("*")):
        if path.is_dir():
            sync_folder(path)
    return {"bytes": sum(_sizes(folder).values()) + record.stat().st_size, "photographs": views.has_photographs}


def _sizes(folder: Path) -> dict[str, int]:
    """Return the bytes of each file of a capture."""
    files = (path for path in folder.rglob("*") if path.is_file() and path.name != RECORD)
    return {str(path.relative_to(folder)): path.stat().st_size for path in files}


def _as_json(sizes: dict[str, int]) -> bytes:
    return json.dumps(sizes, sort_keys=True).encode()


def _write_files(
    entries: Iterator[tuple[str, int, bool | None, Opener]], folder: Path, most_bytes: int, most_files: int
) -> list[PurePosixPath]:
    """Write the camera files and the photographs of an archive; return the paths of all files and links but cameras."""
    left, others = most_bytes, []
    folders: set[PurePosixPath] = set()
    for number, (name, size, is_file, opened) in enumerate(entries, 1):
        path = PurePosixPath(name)
        needed = is_file is not False and (path.name in CAMERA_FILES or path.suffix.lower() in PHOTOGRAPHS)
        if needed:
            _check_name(name, path, is_file)
            folders.update(path.parents[:-1])
        if is_file is not False and path.name not in CAMERA_FILES:
            others.append(path)
        if number + len(folders) > most_files:
            raise _refusal(f"has more than {most_files:,} entries, which is the limit; pack only what is needed")
        if not needed:
            continue
        left -= size
        if left < 0:
            raise _refusal(f"takes more than {most_bytes:,} bytes when it is unpacked, which is the limit; pack less")
        (folder / path).parent.mkdir(parents=True, exist_ok=True)
        with (folder / path).open("xb") as file:
            if (source := opened()) is not None:
                shutil.copyfileobj(source, file)  # not more than the declared size, by both readers
                source.close()
            file.flush()
            os.fsync(file.fileno())
    return others


def _photograph(paths: list[PurePosixPath], views: kissgs.Views) -> PurePosixPath | None:
    """Return the first file with the name of a view, perhaps with another ending, or link to their folder."""
    names = [PurePosixPath(view.name) for view in views.all]
    folders = {"images", *(part for name in names for part in name.parts[:-1])}
    files = {part for name in names for part in (name.name, name.stem)}
    return next((path for path in paths if path.name in folders | files or path.stem in files), None)


def _check_name(name: str, path: PurePosixPath, is_file: bool | None) -> None:
    if is_file is None:
        raise _refusal(f"has {name[:80]!r}, a link or a device; pack files only")
    if path.is_absolute() or ".." in path.parts:
        raise _refusal(f"has {name[:80]!r}, which is outside its folder; pack the folder itself")
    if not is_packable(name):
        raise _refusal(f"has {name[:80]!r}, a name that is not printable or too long; rename the file")


def _entries(source: Path, stack: ExitStack) -> Iterator[tuple[str, int, bool | None, Opener]]:
    """Yield the entries of a zip or a tar, which stays open until the ``stack`` is left: path with slashes, declared
    bytes, whether it is a file, None for neither a file nor a folder, and a function that opens it."""
    with source.open("rb") as file:
        is_zip = file.read(4) in ZIP_MAGICS
    if is_zip:
        packed = stack.enter_context(_open_zip(source))
        for info in packed.infolist():
            kind = stat.S_IFMT(info.external_attr >> 16)  # 0 of programs that write no mode
            is_file = None if kind not in (0, stat.S_IFREG, stat.S_IFDIR) else not info.is_dir()
            yield info.filename.replace("\\", "/"), info.file_size, is_file, partial(packed.open, info)
        return
    try:
        tar = stack.enter_context(tarfile.open(source))  # noqa: SIM115
    except tarfile.ReadError as error:
        raise _refusal("is neither zip nor tar; pack the folder of its cameras and photographs as one") from error
    for entry in tar:
        if entry.size < 0:
            raise tarfile.ReadError("a negative size")
        is_file = True if entry.isreg() else False if entry.isdir() else None
        yield entry.name, entry.size, is_file, partial(tar.extractfile, entry)
    if (packed_tar := tar.fileobj) is not None:
        packed_tar.seek(tar.offset)
        if packed_tar.read(tarfile.BLOCKSIZE) != bytes(tarfile.BLOCKSIZE):
            raise tarfile.ReadError("not the end, but a damaged header, or nothing")  # where the loop ends, too
        while packed_tar.read(1 << 20):  # to the checksum
            pass


def _open_zip(source: Path) -> zipfile.ZipFile:
    """Open a zip: macOS and Info-ZIP write names in UTF-8 without the flag that says so, others in code page 437."""
    with suppress(UnicodeDecodeError):
        return zipfile.ZipFile(source, metadata_encoding="utf-8")
    return zipfile.ZipFile(source)


def _refusal(text: str) -> kissgs.InvalidViewsError:
    return kissgs.InvalidViewsError(f"the archive of the capture {text}")
