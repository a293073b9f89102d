"""Names of uploads and containers, bounds for their sizes, and files that belong to no Python package."""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import kissgs
from kissgs.formats import UPLOADS

Format = Literal["sogxt", "sog", "spz", "compressed.ply"]  # the library's containers, and formats that it converts to

DEFAULT: Format = "sogxt"


@dataclass(frozen=True, slots=True)
class ContainerFile:
    """Ending and media type of a result. A ``.sog`` is a zip as well, but some browsers unpack what is called a zip, or
    change the ending of its name; only zip has a registered type."""

    ending: str
    media_type: str = "application/octet-stream"

    @property
    def name(self) -> str:
        """Name of the file in the folder of a result."""
        return f"scene{self.ending}"


CONTAINER_FILES: dict[Format, ContainerFile] = {
    "sogxt": ContainerFile(".zip", "application/zip"),
    "sog": ContainerFile(".sog"),
    "spz": ContainerFile(".spz"),
    "compressed.ply": ContainerFile(".compressed.ply"),
}

THUMBNAIL, THUMBNAIL_SIZE = "thumbnail.webp", (320, 240)  # name and pixels of the image of a result

UPLOAD_FILES = tuple(f"scene{ending}" for ending in UPLOADS.values())
"""Names of a job's upload, of which it has one: the ending tells formats that are not recognised by their content."""


def container_file(options: dict[str, Any]) -> ContainerFile:
    """Return the result's file for the stored options of a job; jobs without a format made SOG-XT."""
    return CONTAINER_FILES[options.get("format", DEFAULT)]


BYTES_PER_GAUSSIAN = (68, 104, 164, 248)  # bytes per Gaussian of a .ply, by SH degree
STEPS_BYTES = 300_000  # upper bound of a checkpoint's record of steps, at the largest count that settings allow

FINETUNE_BYTES, ENTRY_BYTES, MAX_ENTRIES = 12 * 14, 12 * 45, 1 << 16
"""Fine-tuning state in bytes per Gaussian and per codebook entry, and the approximate maximum number of entries."""


def checkpoint_bytes(gaussians: int, sh_degree: int, *, compact: bool = True, finetune: bool = False) -> int:
    """Return an upper bound in bytes for the checkpoints of a scene's compaction and fine-tuning. A compaction
    checkpoint holds each parameter and its two Adam moments, for at most all Gaussians of the scene. A fine-tuning
    checkpoint holds the levels and the codebook entries, also with their moments. The larger of the two is counted
    twice, because the previous checkpoint exists until the next one is complete."""
    first = compact * (STEPS_BYTES + 3 * BYTES_PER_GAUSSIAN[sh_degree] * gaussians)
    second = finetune * (STEPS_BYTES + FINETUNE_BYTES * gaussians + ENTRY_BYTES * min(max(gaussians, 64), MAX_ENTRIES))
    return first + second + max(first, second)


_PACKAGE = Path(kissgs.__file__).parent

ROOT = _PACKAGE if (_PACKAGE / "web_decoder").is_dir() else _PACKAGE.parent
"""Folder of these files: the package ``kissgs`` in a wheel, the folder around it in a checkout."""

WEB_DECODER = ROOT / "web_decoder"
VENDOR_SCRIPT = ROOT / "scripts" / "vendor"


def sync_folder(folder: Path) -> None:
    """Flush a folder's entries to the disk, so that a power failure cannot undo a rename."""
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
