"""Ray task that runs an item on a node; and files of an item whose folder its node does not see."""

from __future__ import annotations

import contextlib
import os
import time
from collections.abc import Iterator
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import ray

from kissgs._version import __version__
from kissgs.runners import NODE_UNUSABLE, Outcome, WorkItem
from kissgs.runners.process import ItemProcess, temporary_folder

BLOCK_BYTES = 8 << 20  # bytes of a block; the object store of a small cluster has 80 MB
CHECKPOINT_SECONDS = 30.0  # seconds between two looks for files that the function has written while it runs
Times = dict[str, int]  # times of the last change of files, by their names relative to a folder, ns


def run_on_node(values: dict[str, Any], version: str, files: dict[str, list[Any]] | None) -> Iterator[dict[str, Any]]:
    """Run an item in a process on a node, and yield its events. ``version`` is that of kissgs where it was submitted;
    ``files`` are references to blocks of its files."""
    node = ray.util.get_node_ip_address()
    if __version__ != version:
        message = f"the node {node} has kissgs {__version__}, and this machine {version}; install one version"
        yield {"outcome": asdict(Outcome("error", code=NODE_UNUSABLE, message=message))}
        return
    item, before, folder = WorkItem.from_dict(values), None, Path()
    with contextlib.ExitStack() as stack:
        if item.files and not is_seen(item.folder):
            if files is None:
                yield {"unseen": True}
                return
            folder = stack.enter_context(temporary_folder())
            for name, blocks in files.items():
                (folder / name).parent.mkdir(parents=True, exist_ok=True)
                with (folder / name).open("wb") as file:
                    for block in blocks:
                        file.write(ray.get(block))
            item, before = replace(item, folder=str(folder)), times_of(folder)
        yield {"node": node}
        process, looked = ItemProcess(item), time.monotonic()
        stack.callback(process.kill)
        for event in process.events():
            if isinstance(event, Outcome):
                if before is not None:
                    yield from changed(folder, before, complete=event.kind == "done")
                yield {"outcome": asdict(event)}
                continue
            yield {"progress": list(event)}
            if before is not None and time.monotonic() - looked > CHECKPOINT_SECONDS:
                yield from changed(folder, before, complete=False)
                looked = time.monotonic()


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
    """Yield the blocks of new and changed files as events, and bring ``before`` up to date. Files in folders of the
    folder may be incomplete, and are left out, unless ``complete``. Of each file, the last event has ``last``: only
    then is it to be seen at its destination."""
    for name, modified in sorted(times_of(folder).items()):
        if modified != before.get(name) and (complete or "/" not in name):
            offset = 0
            for block in blocks_of(folder / name):
                yield {"file": name, "offset": offset, "block": block, "last": False}
                offset += len(block)
            yield {"file": name, "offset": offset, "block": b"", "last": True}
            before[name] = modified


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
