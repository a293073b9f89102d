"""Files of an item whose folder its node does not see, in blocks that are small beside Ray's object store."""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path
from typing import Any

BLOCK_BYTES = 8 << 20
"""Bytes of a block; the object store of a small cluster has 80 MB."""

CHECKPOINT_SECONDS = 30.0
"""Seconds between two looks for files that the function has written while it runs."""

Times = dict[str, int]
"""Times of the last change of files, by their names relative to a folder, ns."""


def is_seen(folder: str | None) -> bool:
    """Return whether this machine can use an item's folder."""
    return folder is None or (Path(folder).is_dir() and os.access(folder, os.R_OK | os.W_OK | os.X_OK))


def blocks_of(path: Path) -> Iterator[bytes]:
    """Yield the content of a file; of an empty one, one empty block."""
    with path.open("rb") as file:
        yield file.read(BLOCK_BYTES)
        while block := file.read(BLOCK_BYTES):
            yield block


def times_of(folder: Path) -> Times:
    """Return all files of a folder but hidden ones, which are incomplete."""
    paths = [path for path in folder.rglob("[!.]*") if path.is_file()]
    return {str(path.relative_to(folder)): path.stat().st_mtime_ns for path in paths}


def changed(folder: Path, before: Times, *, complete: bool) -> Iterator[dict[str, Any]]:
    """Yield the blocks of new and changed files as events, and bring ``before`` up to date.

    Files in folders of the folder may be incomplete, and are left out, unless ``complete``. Of each file, the last
    event has ``last``: only then is it to be seen at its destination.
    """
    for name, time in sorted(times_of(folder).items()):
        if time != before.get(name) and (complete or "/" not in name):
            offset = 0
            for block in blocks_of(folder / name):
                yield {"file": name, "offset": offset, "block": block, "last": False}
                offset += len(block)
            yield {"file": name, "offset": offset, "block": b"", "last": True}
            before[name] = time


def receive(folder: Path, event: dict[str, Any]) -> None:
    """Write a block of an incomplete file, and give that its name once it is complete and on the disk."""
    path = folder / event["file"]
    part = path.with_name(f".{path.name}.part")
    if path.parent != folder and folder.is_dir():
        path.parent.mkdir(parents=True, exist_ok=True)
    with part.open("r+b" if event["offset"] else "wb") as file:
        file.seek(event["offset"])
        file.write(event["block"])
        if event["last"]:
            file.flush()
            os.fsync(file.fileno())
    if event["last"]:
        part.replace(path)
