"""Archives of captures, zip or tar: unpacking, and the check that the views can be loaded. It runs in a job process,
whose limits of memory and time end what a hostile archive begins."""

from __future__ import annotations

import json
import os
import shutil
import stat
import tarfile
import zipfile
import zlib
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from dataclasses import dataclass
from functools import partial
from lzma import LZMAError
from pathlib import Path, PurePosixPath
from typing import IO, Any

import kissgs
from kissgs.formats import CAMERA_FILES, PHOTOGRAPHS

from .job_process import Task, sync_folder, write

FACTS = "capture.json"
"""File among the unpacked ones that has what :func:`unpack` returned; no file of an archive gets this name."""

MAX_NAME_BYTES = 255  # of the name of a file in an archive, with its folders
ZIP_MAGICS = (b"PK\x03\x04", b"PK\x05\x06")

DAMAGED = (
    *(zipfile.BadZipFile, tarfile.TarError, zlib.error, LZMAError, EOFError, ValueError),
    *(RuntimeError, NotImplementedError),  # of encrypted files, and of unknown compression
    *(FileExistsError, NotADirectoryError, IsADirectoryError),  # of names that occur twice
)
"""Errors of the readers, and of the file system, for damaged and odd archives."""


@dataclass(frozen=True, slots=True)
class _Member:
    """Entry of an archive: its path with slashes, its declared size in bytes, and whether it is a file, a folder or
    neither, such as a link."""

    name: str
    size: int
    is_file: bool
    is_folder: bool
    open: Callable[[], IO[bytes] | None]


def unpack(task: Task, progress: kissgs.Progress) -> dict[str, Any]:
    """Unpack what a capture needs of the archive ``source`` into the folder ``work``, and load its views. Return the
    ``bytes`` of all files, and whether there are ``photographs`` to train on and others to evaluate with."""
    folder = Path(task["work"])
    try:
        with ExitStack() as stack:
            size = _write_files(_members(Path(task["source"]), stack), folder, task["most_bytes"], task["most_files"])
    except DAMAGED as error:
        text = "the archive of the capture is damaged or encrypted, or has two files of one name; pack it again"
        raise kissgs.InvalidViewsError(text) from error
    except OSError as error:
        reason = (error.strerror or str(error)).lower()
        raise kissgs.OutputError(f"the capture cannot be unpacked: {reason}; try again later") from error
    try:
        views = kissgs.load_views(folder, unpacked=True)
    except kissgs.KissgsError as error:
        text = str(error)
        for path in (folder.resolve(), folder):
            text = text.replace(f"{path}/", "").replace(f"{path}", "the capture")
        raise type(error)(text) from error
    facts = {"bytes": size, "photographs": views.has_photographs}
    write(folder / FACTS, json.dumps(facts).encode())
    for path in (*folder.rglob("*"), folder):
        if path.is_dir():
            sync_folder(path)
    return facts


def _write_files(members: Iterator[_Member], folder: Path, most_bytes: int, most_files: int) -> int:
    """Write the camera files and the photographs of an archive; return their size in bytes."""
    size = 0
    for number, member in enumerate(members, 1):
        if number > most_files:
            text = f"the archive of the capture has more than {most_files:,} entries, which is the limit"
            raise kissgs.InvalidViewsError(f"{text}; pack only its cameras and photographs")
        path = _checked_path(member)
        if member.is_folder or not (path.name in CAMERA_FILES or path.suffix.lower() in PHOTOGRAPHS):
            continue
        size += member.size
        if size > most_bytes:
            text = f"the capture takes more than {most_bytes:,} bytes when it is unpacked, which is the limit"
            raise kissgs.InvalidViewsError(f"{text}; send fewer or smaller photographs")
        (folder / path).parent.mkdir(parents=True, exist_ok=True)
        source = member.open()
        with (folder / path).open("xb") as file:
            if source is not None:
                with source:
                    shutil.copyfileobj(source, file)  # not more than the declared size, by both readers
            file.flush()
            os.fsync(file.fileno())
    return size


def _checked_path(member: _Member) -> PurePosixPath:
    """Return the path of an entry, which is a file or a folder below the folder of the archive."""
    path = PurePosixPath(member.name)
    shown = repr(member.name[:80])
    if not (member.is_file or member.is_folder):
        raise kissgs.InvalidViewsError(f"the archive of the capture has {shown}, a link or a device; pack files only")
    if path.is_absolute() or ".." in path.parts:
        text = f"the archive of the capture has {shown}, which is outside its folder; pack the folder itself"
        raise kissgs.InvalidViewsError(text)
    if not member.name.isprintable() or len(member.name.encode()) > MAX_NAME_BYTES:
        text = f"the archive of the capture has {shown}, a name that is not printable or too long; rename the file"
        raise kissgs.InvalidViewsError(text)
    return path


def _members(source: Path, stack: ExitStack) -> Iterator[_Member]:
    """Yield the entries of a zip or a tar, which stays open until the ``stack`` is left."""
    with source.open("rb") as file:
        is_zip = file.read(4) in ZIP_MAGICS
    if is_zip:
        packed = stack.enter_context(zipfile.ZipFile(source))
        for info in packed.infolist():
            kind = stat.S_IFMT(info.external_attr >> 16)  # 0 of programs that write no mode
            name, is_file = info.filename.replace("\\", "/"), kind in (0, stat.S_IFREG)
            folder = name.endswith("/") and kind in (0, stat.S_IFREG, stat.S_IFDIR)
            yield _Member(name, info.file_size, is_file, folder, partial(packed.open, info))
        return
    try:
        tar = stack.enter_context(tarfile.open(source))  # noqa: SIM115
    except tarfile.ReadError as error:
        text = "the capture is neither a zip nor a tar file; pack the folder of its cameras and photographs as one"
        raise kissgs.InvalidViewsError(text) from error
    for entry in tar:
        yield _Member(entry.name, entry.size, entry.isreg(), entry.isdir(), partial(tar.extractfile, entry))
