"""Archives of captures, zip or tar: unpacking, and the check that the views can be loaded. It runs in a job process,
whose limits of memory and time end what a hostile archive begins."""

from __future__ import annotations

import os
import shutil
import stat
import tarfile
import zipfile
import zlib
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from functools import partial
from lzma import LZMAError
from pathlib import Path, PurePosixPath
from typing import IO, Any

import kissgs
from kissgs.formats import CAMERA_FILES, PHOTOGRAPHS

from .job_process import Task, sync_folder

MAX_NAME_BYTES = 255  # of the name of a file in an archive, with its folders
ZIP_MAGICS = (b"PK\x03\x04", b"PK\x05\x06")

DAMAGED = (
    *(zipfile.BadZipFile, tarfile.TarError, zlib.error, LZMAError, EOFError, ValueError),
    *(RuntimeError, NotImplementedError),  # of encrypted files, and of unknown compression
    *(FileExistsError, NotADirectoryError, IsADirectoryError),  # of names that occur twice
)
"""Errors of the readers, and of the file system, for damaged and odd archives."""

Opener = Callable[[], IO[bytes] | None]


def unpack(task: Task, progress: kissgs.Progress) -> dict[str, Any]:
    """Unpack what a capture needs of the archive ``source``, if there is one, into the folder ``work``, and load its
    views. Return the ``bytes`` of all files, and whether there are ``photographs`` to train on and to evaluate with."""
    folder = Path(task["work"])
    try:
        with ExitStack() as stack:
            if task["source"]:
                _write_files(_entries(Path(task["source"]), stack), folder, task["most_bytes"], task["most_files"])
    except DAMAGED as error:
        raise _refusal("is damaged or encrypted, or has two files of one name; pack it again") from error
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
    paths = [folder, *folder.rglob("*")]
    for path in paths:
        if path.is_dir():
            sync_folder(path)
    return {"bytes": sum(path.stat().st_size for path in paths if path.is_file()), "photographs": views.has_photographs}


def _write_files(
    entries: Iterator[tuple[str, int, bool | None, Opener]], folder: Path, most_bytes: int, most_files: int
) -> None:
    """Write the camera files and the photographs of an archive."""
    left = most_bytes
    for number, (name, size, is_file, opened) in enumerate(entries, 1):
        if number > most_files:
            raise _refusal(f"has more than {most_files:,} entries, which is the limit; pack only what is needed")
        path = PurePosixPath(name)
        _check_name(name, path, is_file)
        if not is_file or not (path.name in CAMERA_FILES or path.suffix.lower() in PHOTOGRAPHS):
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


def _check_name(name: str, path: PurePosixPath, is_file: bool | None) -> None:
    if is_file is None:
        raise _refusal(f"has {name[:80]!r}, a link or a device; pack files only")
    if path.is_absolute() or ".." in path.parts:
        raise _refusal(f"has {name[:80]!r}, which is outside its folder; pack the folder itself")
    if not name.isprintable() or len(name.encode()) > MAX_NAME_BYTES:
        raise _refusal(f"has {name[:80]!r}, a name that is not printable or too long; rename the file")


def _entries(source: Path, stack: ExitStack) -> Iterator[tuple[str, int, bool | None, Opener]]:
    """Yield the entries of a zip or a tar, which stays open until the ``stack`` is left: path with slashes, declared
    bytes, whether it is a file, None for neither a file nor a folder, and a function that opens it."""
    with source.open("rb") as file:
        is_zip = file.read(4) in ZIP_MAGICS
    if is_zip:
        packed = stack.enter_context(zipfile.ZipFile(source))
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
        is_file = True if entry.isreg() else False if entry.isdir() else None
        yield entry.name, entry.size, is_file, partial(tar.extractfile, entry)


def _refusal(text: str) -> kissgs.InvalidViewsError:
    return kissgs.InvalidViewsError(f"the archive of the capture {text}")
