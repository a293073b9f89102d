"""The work folder of a streamed scene, and the work items that fill it, here or on a runner."""

from __future__ import annotations

import contextlib
import errno
import json
import os
import shutil
import socket
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, wait
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, BinaryIO

from kissgs.core.errors import OutputError, UnsupportedError
from kissgs.core.progress import Progress
from kissgs.formats import MANIFESTS
from kissgs.io.files import path_state, reason_of
from kissgs.io.streamed import MAX_TREE_BYTES
from kissgs.runners import Resources, Runner, WorkItem, error_of
from kissgs.settings import EncodeSettings
from kissgs.sog.encode import FILES
from kissgs.streaming import build
from kissgs.streaming.build import CHUNK
from kissgs.streaming.layout import (
    OUT,
    PARTITION,
    Layout,
    continuation,
    leaves_file,
    read_layout,
    rows_file,
    write_json,
)
from kissgs.streaming.levels import row_bytes

# The work folder of a streamed scene: whose work it holds, its room on the disk, and the last step of the work.

WORK, LOCK = "work.json", "lock"
"""Files: which work the folder belongs to; locked by the process that works in it."""

TEMPORARY = ".kissgs."
"""Beginning of the names of files that are being written."""

REPLACED = "replaced"
"""Folder for what the result replaces, until the result is in place."""

ENCODED_BYTES = 30
"""Upper estimate of the encoded bytes of a Gaussian with all its levels."""


def check_destination(manifest: Path, source: Path, *, overwrite: bool) -> None:
    """Refuse to replace anything but a streamed scene, and that only if allowed."""
    folder, remedy = manifest.parent, f"name {manifest.name} in a new folder"
    present, is_folder = path_state(folder)
    if not folder.name:
        raise OutputError(f"{folder} cannot be replaced; {remedy}")
    if not present:
        return
    if not is_folder or folder.is_symlink() or folder.is_mount():
        what = "a link" if folder.is_symlink() else "a mount point" if is_folder else "a file"
        raise OutputError(f"{folder} is {what} and cannot be replaced as a whole; {remedy}")
    for inside, what in ((Path.cwd(), "the current folder"), (source.resolve(), "the input")):
        if inside.is_relative_to(folder.resolve()):
            where = f"is {what}" if inside == folder.resolve() else f"has {what} in it"
            raise OutputError(f"{folder} would be replaced as a whole, but {where}; {remedy}")
    ours = _paths_of(folder)
    if strange := next((path for path in folder.iterdir() if path.relative_to(folder) not in ours), None):
        raise OutputError(f"{folder} holds other files ({strange.name}); {remedy}")
    found = {path.relative_to(folder) for path in folder.rglob("*")}
    if found - ours:
        raise OutputError(f"{folder} holds other files ({min(found - ours)}); {remedy}")
    if found and not overwrite:
        raise OutputError(f"{manifest} exists already; choose another name or allow overwriting (--force)")


def _paths_of(folder: Path) -> set[Path]:
    """Return the relative paths of all files and folders of the streamed scenes whose manifests are in a folder."""
    found: set[Path] = set()
    for manifest, container in MANIFESTS.items():
        document = read_json(folder / manifest)
        if not isinstance(document, dict) or not isinstance(document.get("filenames"), list):
            continue
        environment = document.get("environment")
        named = [Path(str(name)) for name in (*document["filenames"], *([environment] if environment else ()))]
        if container == "sog":
            files = [path.parent / name for path in named for name in FILES]
        else:
            files = [path for path in named if path.suffix == ".zip"]
        found |= {Path(manifest), *files, *(above for path in files for above in path.parents)}
    return found


@contextlib.contextmanager
def claimed(work: Path, mine: dict[str, Any]) -> Iterator[None]:
    """Make the work folder, or check that the one that is there belongs to the same work; keep others out meanwhile."""
    try:
        if work.is_symlink():
            raise OutputError(f"{work} is a link; delete it, or choose another name")
        if work.exists() and not (work / WORK).exists() and _names(work) - {LOCK}:
            raise OutputError(f"{work} holds other files; choose another name")
        work.mkdir(exist_ok=True)
        lock = (work / LOCK).open("ab")
    except OSError as error:
        raise OutputError(f"cannot make {work}: {reason_of(error)}") from error
    with lock:
        if not _locked(lock):
            raise OutputError(f"another process works in {work}; wait for it, or choose another name")
        _take_over(work, mine)
        yield


@contextlib.contextmanager
def explaining_full_disks(work: Path) -> Iterator[None]:
    """Let errors about a full disk say what the same command does once there is room."""
    try:
        yield
    except OutputError as error:
        if not any(os.strerror(number).lower() in str(error) for number in (errno.ENOSPC, errno.EDQUOT)):
            raise
        raise OutputError(f"{error}; once there is room, {continuation(work)}") from error


def _names(work: Path) -> set[str]:
    return {path.name for path in work.iterdir() if not path.name.startswith(TEMPORARY)}


def _take_over(work: Path, mine: dict[str, Any]) -> None:
    """Check whose work a work folder holds, and remove what a killed process was writing."""
    try:
        if (work / WORK).exists() and read_json(work / WORK) != mine:
            raise OutputError(f"{work} belongs to other or older work; delete it, or choose another name")
        for left in (*work.glob(f"{TEMPORARY}*"), *(work / OUT).glob(f"{TEMPORARY}*"), _discarded(work)):
            shutil.rmtree(left, ignore_errors=True) if left.is_dir() else left.unlink(missing_ok=True)
    except OSError as error:
        raise OutputError(f"cannot use {work}: {reason_of(error)}") from error
    write_json(work / WORK, mine)


def _locked(lock: BinaryIO) -> bool:
    """Lock a file until it is closed, or the process ends; return False if another process has locked it."""
    try:
        import fcntl
    except ImportError:  # Windows
        return True
    try:
        fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    except OSError:  # a network file system without locks
        return True
    return True


def needed_bytes(count: int, sh_degree: int) -> int:
    """Return the most bytes that the work folder takes: all levels as float32, a chunk once more, and the result."""
    return (2 * count + min(count, CHUNK)) * row_bytes(sh_degree) + count * ENCODED_BYTES


def megabytes(count: float) -> str:
    """Format bytes: "10,622 MB", and below one megabyte "34 kB"."""
    return f"{count / 1e6:,.0f} MB" if count >= 1e6 else f"{count / 1e3:,.0f} kB"


def check_space(work: Path, needed: int) -> None:
    """Check, before the partition, that the disk has room for the work folder; what is in it counts as free."""
    present = sum(path.stat().st_size for path in work.rglob("*") if path.is_file())
    free = shutil.disk_usage(work).free
    if needed - present > free:
        raise OutputError(
            f"{work} will take up to {megabytes(needed)}, but its disk has {megabytes(free)} free; "
            "free some, or write to another disk"
        )


def finish(work: Path, manifest: Path, source: Path, *, overwrite: bool) -> None:
    """Move the result into place, and delete the work folder; may be repeated after an interruption anywhere.

    What the result replaces is in the work folder until the result is in place. The work folder is renamed before it is
    deleted: a part of it would look like other work.
    """
    result, folder = work / OUT, manifest.parent
    if (result / manifest.name).exists():
        check_destination(manifest, source, overwrite=overwrite)
    elif not manifest.exists():
        raise OutputError(f"{work} was complete, but its result is gone; delete it and start again")
    try:
        if (result / manifest.name).exists():
            if folder.exists():
                folder.rename(work / REPLACED)
            result.rename(folder)
        work.rename(_discarded(work))
        shutil.rmtree(_discarded(work))
    except OSError as error:
        raise OutputError(f"cannot write {folder}: {reason_of(error)}") from error


def remove(work: Path) -> None:
    """Delete a claimed work folder whose work is of no use; what cannot be deleted stays.

    The files by which :func:`claimed` recognises it are the last to go, so that after an interruption anywhere the same
    command may begin anew.
    """
    with contextlib.suppress(OSError):
        for path in work.iterdir():
            if path.name not in (WORK, LOCK):
                shutil.rmtree(path) if path.is_dir() else path.unlink()
        (work / WORK).unlink(missing_ok=True)
        (work / LOCK).unlink()
        work.rmdir()


def _discarded(work: Path) -> Path:
    """Return the name under which a work folder is deleted."""
    return work.with_name(f"{TEMPORARY}{work.name}.old")


def read_json(path: Path) -> Any:  # noqa: ANN401  any JSON
    """Return the JSON of a file; None if it is missing, incomplete, or larger than a manifest may be."""
    try:
        with path.open("rb") as file:
            data = file.read(MAX_TREE_BYTES + 1)
        return json.loads(data) if len(data) <= MAX_TREE_BYTES else None
    except (OSError, ValueError, RecursionError):
        return None


# Work items of a streamed scene. Those of a step do not depend on each other. One that is run twice, because its node
# was given up, writes the same bytes again.

PROCESS_BYTES = 500_000_000
"""Memory of an item for libraries, bytes."""

MEMORY_RATIO = 5
"""Memory of an item for each byte of the Gaussians of its file as float32."""

POLL_SECONDS = 0.5
"""Seconds between reports of progress, which may also stop the work."""


@dataclass(frozen=True, slots=True)
class Item:
    """Something to make from files of a work folder: the levels of a chunk, or a container of the result."""

    work: str
    settings: dict[str, Any]  # of the encoder
    chunk: int | None = None
    file: str = ""

    @property
    def done(self) -> bool:
        """Whether it has been made."""
        work = Path(self.work)
        return (rows_file(work, self.file) if self.chunk is None else leaves_file(work, self.chunk)).exists()

    def run(self, threads: int, progress: Progress) -> None:
        """Make it, unless it is there.

        A node that was given up may still be at work: what it completes meanwhile, it takes the input of.
        """
        work = Path(self.work)
        layout, settings = read_layout(work), EncodeSettings.model_validate(self.settings)
        if self.done:
            return
        try:
            if self.chunk is not None:
                build.make_levels(work, layout, self.chunk, threads, progress)
            else:
                file = next(each for each in layout.all_files() if each.name == self.file)
                build.make_file(work, layout, settings, file, threads, progress)
        except OutputError:
            if not self.done:
                raise


def run_item(arguments: dict[str, Any], progress: Progress) -> dict[str, Any]:
    """Run an item on a runner: "item", its fields; "threads"."""
    item = Item(**arguments["item"])
    if read_json(Path(item.work) / PARTITION) is None:
        raise UnsupportedError(
            f"the machine {socket.gethostname()} does not see {item.work}; "
            "--ray needs storage that all machines see at the same path"
        )
    item.run(arguments["threads"], progress)
    return {}


def run_all(
    runner: Runner,
    items: Sequence[Item],
    layout: Layout,
    threads: int,
    report: Callable[[float], None],
) -> None:
    """Run items and wait for them; if one fails, or the caller is stopped, the others are cancelled."""
    memory = PROCESS_BYTES + MEMORY_RATIO * max(layout.counts) * row_bytes(layout.sh_degree)
    requested = Resources(cpus=max(1, threads), memory=memory)
    if refusal := runner.refusal(requested):
        raise UnsupportedError(f"{refusal}; choose another number with --threads")
    handles = [
        runner.submit(WorkItem(f"{__name__}:run_item", {"item": asdict(item), "threads": max(1, threads)}, requested))
        for item in items
    ]
    waiting = {handle.outcome for handle in handles}
    try:
        while waiting:
            report(1 - len(waiting) / len(items))
            done, waiting = wait(waiting, POLL_SECONDS, FIRST_COMPLETED)
            for each in done:
                if each.result().kind != "done":
                    raise error_of(each.result())
    except BaseException:
        for handle in handles:
            runner.cancel(handle.id)
        wait([handle.outcome for handle in handles])
        raise
