"""The work folder of a streamed scene: sizes of the scene, files, whose work it holds, and its last step."""

from __future__ import annotations

import contextlib
import errno
import fcntl
import json
import os
import shutil
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import TypeAdapter, ValidationError

from kissgs.core.array_types import Float32
from kissgs.core.errors import OutputError
from kissgs.core.positions import Origin
from kissgs.core.splats import SH_REST_COUNTS, Splats
from kissgs.formats import MANIFESTS, ContainerName
from kissgs.io.containers import META_NAME
from kissgs.io.files import atomic_file, move_into_place, path_state, reason_of
from kissgs.io.streamed import MAX_TREE_BYTES
from kissgs.sog import FILES

# ``Layout``: sizes of a streamed scene; and the files of its work folder.

CONTEXT = 280_000  # largest number of Gaussians of the level that stands for other chunks where sensitivity is measured
# The partition's marker; cameras; the first view; the result.
PARTITION, CAMERAS, VIEW, OUT = "partition.json", "cameras.json", "view.json", "out"
ENVIRONMENT = "environment"  # name of the environment's container


@dataclass(frozen=True, slots=True)
class ContainerFile:
    """A container of the result: one level of some chunks, or the environment, which has no chunks."""

    name: str
    level: int = 0
    chunks: tuple[int, ...] = ()  # those that have Gaussians


@dataclass(frozen=True, slots=True, kw_only=True)
class Layout:
    """Sizes of a streamed scene: numbers of Gaussians, but for ``depth`` and ``levels``."""

    container: ContainerName
    source_count: int  # before cleaning
    sh_degree: int
    counts: tuple[int, ...]  # in each chunk
    depth: int  # number of cuts one after another; there are 2^depth chunks
    levels: int
    leaf: int  # at most, in a leaf
    environment: int
    changed: dict[str, int]  # by cleaning, by kind; and "invisible"
    notes: tuple[str, ...]  # what reading the scene left out or changed, and where its positions are
    origin: Origin
    antialiased: bool = False

    @property
    def filled(self) -> list[int]:
        """Chunks that have Gaussians."""
        return [chunk for chunk, count in enumerate(self.counts) if count]

    @property
    def manifest(self) -> str:
        """File name of the manifest."""
        return next(name for name, container in MANIFESTS.items() if container == self.container)

    @property
    def context(self) -> int:
        """Level that stands for other chunks where sensitivity is measured: the finest of few Gaussians."""
        total = sum(self.counts)
        return next((level for level in range(self.levels) if total >> level <= CONTEXT), self.levels - 1)

    def path(self, name: str) -> str:
        """Return the path of a container in the folder of the result: that of a folder for SOG, else of a zip."""
        return name if self.container == "sog" else f"{name}.zip"

    def entry(self, name: str) -> str:
        """Return how the manifest names a container."""
        return f"{name}/{META_NAME}" if self.container == "sog" else self.path(name)

    def files(self) -> list[ContainerFile]:
        """Return the containers of all levels, the coarsest first: each has twice the chunks of one a level finer."""
        found = []
        for level in reversed(range(self.levels)):
            size = 1 << min(level, self.depth)
            for number in range((1 << self.depth) // size):
                chunks = [chunk for chunk in range(number * size, (number + 1) * size) if self.counts[chunk]]
                if chunks:
                    found.append(ContainerFile(f"{level}_{number}", level, tuple(chunks)))
        return found

    def all_files(self) -> list[ContainerFile]:
        """Return all containers, the environment first if there is one."""
        return [ContainerFile(ENVIRONMENT), *self.files()] if self.environment else self.files()


def work_folder(manifest: Path) -> Path:
    """Return the work folder of a streamed scene, given its manifest."""
    folder = manifest.parent if manifest.parent.name not in ("", "..") else manifest.parent.resolve()
    return folder.parent / f"{folder.name}.partial"


def continuation(work: Path) -> str:
    """Return what the same command does after the work has ended early: all that follows the partition is kept."""
    return f"the same command {'goes on where it was' if (work / PARTITION).exists() else 'begins anew'}"


def read_layout(work: Path) -> Layout | None:
    """Return the layout of a scene; None if it is not partitioned yet."""
    found = read_json(work / PARTITION)
    try:
        return None if found is None else TypeAdapter(Layout).validate_python(found)
    except ValidationError as error:
        raise OutputError(f"{work / PARTITION} is damaged; delete {work} and start again") from error


def read_leaves(work: Path, chunk: int) -> dict[str, Any]:
    """Return the bounds and errors of a chunk's leaves, and their counts by level."""
    return json.loads(leaves_file(work, chunk).read_bytes())


def gaussians_file(work: Path, part: int | str, level: int | None = None) -> Path:
    """Return the file of the Gaussians of a level of a chunk; without ``level``, that of a chunk until its levels are
    made, or of the :data:`ENVIRONMENT`."""
    name = part if isinstance(part, str) else f"chunk_{part}"
    return work / f"{name}{'' if level is None else f'_level_{level}'}.f32"


def leaves_file(work: Path, chunk: int) -> Path:
    """Return the file of a chunk's leaves, which marks its levels as done."""
    return work / f"chunk_{chunk}.json"


def rows_file(work: Path, name: str) -> Path:
    """Return the file of the number of rows of each leaf in a container, which marks the container as done."""
    return work / f"file_{name}.json"


def read_counts(work: Path, name: str) -> dict[str, Any]:
    """Return the number of rows of each leaf in a container, and the note of its encoding."""
    return json.loads(rows_file(work, name).read_bytes())


def write_json(path: Path, values: object) -> None:
    """Write JSON atomically."""
    with atomic_file(path, overwrite=True) as file:
        file.write(json.dumps(values, separators=(",", ":")).encode())


# Gaussians as rows of float32 numbers in scratch files, which can be appended to and read back bit by bit.


def row_bytes(sh_degree: int) -> int:
    """Return the bytes of one Gaussian."""
    return 4 * (14 + 3 * SH_REST_COUNTS[sh_degree])


def to_rows(splats: Splats) -> Float32[np.ndarray, "N F"]:
    """Return all numbers of each Gaussian in a row."""
    rest, logits = splats.shN.reshape(len(splats), 3 * splats.shN.shape[1]), splats.opacities[:, None]
    return np.concatenate([splats.means, splats.quats, splats.scales, logits, splats.sh0, rest], axis=1)


def append_rows(path: Path, rows: Float32[np.ndarray, "N F"]) -> None:
    """Append rows to a file."""
    with _explained("write", path), path.open("ab") as file:
        file.write(np.ascontiguousarray(rows).data)


def write_rows(path: Path, rows: Float32[np.ndarray, "N F"]) -> None:
    """Write a file of rows, atomically; an existing file is replaced."""
    with atomic_file(path, overwrite=True) as file:
        file.write(np.ascontiguousarray(rows).data)


def sync(path: Path) -> None:
    """Wait until a file is on the disk."""
    with _explained("write", path), path.open("ab") as file:
        os.fsync(file.fileno())


def read_gaussians(work: Path, layout: Layout, parts: Sequence[int | str], level: int | None = None) -> Splats:
    """Return the Gaussians of these chunks, or of the :data:`ENVIRONMENT`, from :func:`gaussians_file` of each."""
    rows, width = [], row_bytes(layout.sh_degree) // 4
    for part in parts:
        if isinstance(part, str):
            count = layout.environment
        else:
            count = layout.counts[part] if level is None else sum(read_leaves(work, part)["counts"][level])
        path = gaussians_file(work, part, level)
        with _explained("read", path):
            values, size = np.fromfile(path, np.float32), path.stat().st_size
        if size != 4 * width * count:
            raise OutputError(f"{path} is not complete; delete {path.parent} and start again")
        rows.append(values.reshape(count, width))
    together = rows[0] if len(rows) == 1 else np.concatenate([np.empty((0, width), np.float32), *rows])
    columns = [np.ascontiguousarray(column) for column in np.split(together, (3, 7, 10, 11, 14), axis=1)]
    return Splats(
        means=columns[0],
        quats=columns[1],
        scales=columns[2],
        opacities=columns[3][:, 0],
        sh0=columns[4],
        shN=columns[5].reshape(len(together), SH_REST_COUNTS[layout.sh_degree], 3),
        antialiased=layout.antialiased,
    )


@contextlib.contextmanager
def _explained(what: str, path: Path) -> Iterator[None]:
    try:
        yield
    except OSError as error:
        raise OutputError(f"cannot {what} {path}: {reason_of(error)}") from error


# Whose work the folder holds, and its result.

WORK, LOCK = "work.json", "lock"  # files: which work the folder belongs to; locked by the process that works in it
TEMPORARY = ".kissgs."  # beginning of the names of files that are being written


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
    found = (path.relative_to(folder) for path in folder.rglob("*"))
    if strange := next((path for path in found if path not in ours), None):
        raise OutputError(f"{folder} holds other files ({strange}); {remedy}")
    if any(folder.iterdir()) and not overwrite:
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
        work.mkdir(exist_ok=True)
        strange = (path for path in work.iterdir() if path.name != LOCK and not path.name.startswith(TEMPORARY))
        if not (work / WORK).exists() and any(strange):
            raise OutputError(f"{work} holds other files; choose another name")
        lock = (work / LOCK).open("ab")
    except OSError as error:
        raise OutputError(f"cannot make {work}: {reason_of(error)}") from error
    with lock:
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as error:
            raise OutputError(f"another process works in {work}; wait for it, or choose another name") from error
        except OSError:  # a network file system without locks
            pass
        if (work / WORK).exists() and read_json(work / WORK) != mine:
            raise OutputError(f"{work} belongs to other or older work; delete it, or choose another name")
        for left in (*work.glob(f"{TEMPORARY}*"), *(work / OUT).glob(f"{TEMPORARY}*"), _discarded(work)):
            with contextlib.suppress(OSError):  # of a process that was killed
                shutil.rmtree(left) if left.is_dir() else left.unlink()
        write_json(work / WORK, mine)
        try:
            yield
        except OutputError as error:
            if not any(os.strerror(number).lower() in str(error) for number in (errno.ENOSPC, errno.EDQUOT)):
                raise
            raise OutputError(f"{error}; once there is room, {continuation(work)}") from error


def finish(work: Path, manifest: Path, source: Path, *, overwrite: bool) -> None:
    """Move the result into place, and delete the work folder; may be repeated after an interruption anywhere. The work
    folder is renamed before it is deleted: a part of it would look like other work."""
    result = work / OUT
    if (result / manifest.name).exists():
        check_destination(manifest, source, overwrite=overwrite)
        move_into_place(result, manifest.parent)
    elif not manifest.exists():
        raise OutputError(f"{work} was complete, but its result is gone; delete it and start again")
    try:
        work.rename(_discarded(work))
        shutil.rmtree(_discarded(work))
    except OSError as error:
        raise OutputError(f"cannot delete {work}: {reason_of(error)}") from error


def remove(work: Path) -> None:
    """Delete a claimed work folder whose work is of no use; what cannot be deleted stays. The files by which
    :func:`claimed` recognises it are the last to go, so that after an interruption anywhere the same command may begin
    anew."""
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
