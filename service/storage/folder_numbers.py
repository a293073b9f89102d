"""Numbers of a data folder: its own, ``identity``, and that of its database, each in a file of this name."""

from __future__ import annotations

import os
import re
from pathlib import Path

from ..core.settings import SettingsError


def read_number(path: Path) -> int | None:
    """Read a number from a file.

    Returns:
        The number; None if the file is missing or empty.

    Raises:
        SettingsError: the file cannot be read or has other content.
    """
    try:
        text = path.read_bytes().strip()
    except FileNotFoundError:
        return None
    except OSError as error:
        raise SettingsError(f"KISSGS_DATA_DIR: cannot read {path}: {(error.strerror or '').lower()}") from error
    if text and not re.fullmatch(rb"[0-9]{1,18}", text):
        raise SettingsError(f"KISSGS_DATA_DIR: {path} does not contain a number; restore it, or choose another folder")
    return int(text) if text else None


def write_number(path: Path, number: int) -> None:
    """Write a number to a file atomically.

    Raises:
        SettingsError: it cannot be written.
    """
    part = path.with_name(f"{path.name}.part")
    try:
        part.write_text(f"{number}\n", encoding="ascii")
        part.replace(path)
        sync_folder(path.parent)
    except OSError as error:
        raise SettingsError(f"KISSGS_DATA_DIR: cannot write {path}: {(error.strerror or '').lower()}") from error


def sync_folder(folder: Path) -> None:
    """Flush a folder's entries to the disk, so that a power failure cannot undo a rename."""
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
