"""The work folder of a streamed scene: whose work it holds, its room on the disk, and the last step of the work."""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from typing import Any

from kissgs.core.errors import OutputError
from kissgs.io.atomic import atomic_file, path_state, reason_of
from kissgs.sog.names import LOD_NAME
from kissgs.streaming.build import OUT
from kissgs.streaming.rows import row_bytes

WORK = "work.json"
"""File that says which work the folder belongs to."""

REPLACED = "replaced"
"""Folder for what the result replaces, until the result is in place."""

ENCODED_BYTES = 30
"""Upper estimate of the encoded bytes of a Gaussian with all its levels."""


def check_destination(folder: Path, overwrite: bool) -> None:
    """Refuse to replace anything but a streamed scene, and that only if allowed.

    Raises:
        OutputError: the folder holds something else, or a scene that may not be replaced.
    """
    present, is_folder = path_state(folder)
    if present and not is_folder:
        raise OutputError(f"{folder} is a file; name {LOD_NAME} in a new folder")
    if present and any(folder.iterdir()):
        if not (folder / LOD_NAME).is_file():
            raise OutputError(f"{folder} holds other files; name {LOD_NAME} in a new folder")
        if not overwrite:
            raise OutputError(f"{folder / LOD_NAME} exists already; choose another name or allow overwriting (--force)")


def claim(work: Path, mine: dict[str, Any]) -> None:
    """Make the work folder, or check that the one that is there belongs to the same work, and tidy it.

    Args:
        work: the work folder.
        mine: JSON that identifies the work: its input, settings and version.

    Raises:
        OutputError: it belongs to other work, or cannot be written.
    """
    try:
        if work.exists():
            if read_json(work / WORK) != mine:
                raise OutputError(f"{work} belongs to other or older work; delete it, or choose another name")
            for left in (*work.glob(".kissgs.*"), *(work / OUT).glob(".kissgs.*")):  # of a process that was killed
                shutil.rmtree(left) if left.is_dir() else left.unlink()
            return
        (work / OUT).mkdir(parents=True)
    except OSError as error:
        raise OutputError(f"cannot use {work}: {reason_of(error)}") from error
    with atomic_file(work / WORK) as file:
        file.write(json.dumps(mine).encode())


def needed_bytes(count: int, sh_degree: int) -> int:
    """Return the most bytes that the work folder takes: the Gaussians of all levels as float32, and the result."""
    return count * (2 * row_bytes(sh_degree) + ENCODED_BYTES)


def check_space(work: Path, needed: int) -> None:
    """Check that the disk has room for what the work folder still lacks.

    Raises:
        OutputError: the disk is too full.
    """
    present = sum(path.stat().st_size for path in work.rglob("*") if path.is_file())
    free = shutil.disk_usage(work).free
    if needed - present > free:
        raise OutputError(
            f"{work} will take up to {needed / 1e6:,.0f} MB, but its disk has {free / 1e6:,.0f} MB free; "
            "free some, or write to another disk"
        )


def finish(work: Path, folder: Path) -> None:
    """Move the result into place, and delete the work folder; may be repeated after an interruption anywhere.

    Raises:
        OutputError: the result cannot be moved.
    """
    out, replaced = work / OUT, work / REPLACED
    try:
        if out.exists():
            if folder.exists():
                folder.rename(replaced)
            out.rename(folder)
        shutil.rmtree(work)
    except OSError as error:
        raise OutputError(f"cannot write {folder}: {reason_of(error)}") from error


def read_json(path: Path) -> Any:  # noqa: ANN401  any JSON
    """Return the JSON of a file; None if it is missing or incomplete."""
    try:
        return json.loads(path.read_bytes())
    except (OSError, ValueError):
        return None
