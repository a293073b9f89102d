"""Describe the contents of a scene file, for ``kissgs info``."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np

from kissgs.core.errors import InvalidContainerError
from kissgs.core.signed_log import signed_exp
from kissgs.core.splats import ATTRIBUTES, clean
from kissgs.io.packed_files import Source, open_source
from kissgs.io.ply import read_ply, read_ply_info
from kissgs.io.webp import decode_plane
from kissgs.pipeline.scene_files import is_container
from kissgs.sogxt.metadata import CHANNELS, Layout
from kissgs.sogxt.metadata_reader import read_layout
from kissgs.sogxt.names import FILES, PLANES

NAMES = {"quaternions": "quats", "f_dc": "sh0", "f_rest_centroids": "shN"}
MAX_PLANE_BYTES = 1 << 30


@dataclass(frozen=True, slots=True, kw_only=True)
class Info:
    """Contents of a ``.ply`` or a container.

    Attributes:
        path: path of the file or folder.
        kind: "ply" or "sog-xt".
        count: Gaussians.
        sh_degree: 0 to 3.
        bytes: size of the file or the folder.
        parts: bytes per file of a container; empty for a ``.ply``.
        ranges: per attribute, over all channels, the smallest and largest finite value (``.ply``), or the values of the
            lowest and highest level (container; where channels share a step, few reach the highest).
        changed: Gaussians that cleaning would remove or correct (``.ply``), or that the encoder removed or corrected
            (container), by reason.
        details: encoding and whether it is PlayCanvas' compressed layout (``.ply``); side of grid and codebook, version
            and settings of the encoder (container).
    """

    path: str
    kind: Literal["ply", "sog-xt"]
    count: int
    sh_degree: int
    bytes: int
    parts: dict[str, int]
    ranges: dict[str, tuple[float, float]]
    changed: dict[str, int]
    details: dict[str, Any]

    @property
    def bits_per_gaussian(self) -> float:
        """Bits of the whole file per Gaussian."""
        return 8 * self.bytes / max(self.count, 1)

    def as_dict(self) -> dict[str, Any]:
        """Return all fields and derived figures for JSON."""
        return {**asdict(self), "bits_per_gaussian": self.bits_per_gaussian}


def describe(path: Path) -> Info:
    """Describe a scene file.

    No image of a container is decoded, except the mask if the metadata does not state the number of Gaussians.

    Raises:
        KissgsError: the file is not a usable scene or container.
    """
    return _describe_container(path) if is_container(path) else _describe_ply(path)


def _describe_ply(path: Path) -> Info:
    header, splats = read_ply_info(path), read_ply(path)
    return Info(
        path=str(path),
        kind="ply",
        count=len(splats),
        sh_degree=splats.sh_degree,
        bytes=path.stat().st_size,
        parts={},
        ranges={name: _extremes(getattr(splats, name)) for name in ATTRIBUTES if getattr(splats, name).size},
        changed=clean(splats)[1].as_dict(),
        details={"encoding": header.encoding, "compressed": header.compressed},
    )


def _extremes(values: np.ndarray) -> tuple[float, float]:
    low, high = float(values.min()), float(values.max())
    if not np.isfinite(low + high):
        values = values[np.isfinite(values)]
        low, high = (float(values.min()), float(values.max())) if values.size else (0.0, 0.0)
    return low, high


def _describe_container(path: Path) -> Info:
    with open_source(path) as files:
        layout = read_layout(files)
        present = files.names()
        missing = [name for name in PLANES if name not in present]
        if missing:
            raise InvalidContainerError(f"{path} is incomplete: missing {', '.join(missing)}")
        parts = {name: files.size(name) for name in FILES if name in present}
        count = layout.count if layout.count is not None else _count_mask(files, layout)
    made = layout.provenance
    return Info(
        path=str(path),
        kind="sog-xt",
        count=count,
        sh_degree=layout.sh_degree,
        bytes=sum(parts.values()) if path.is_dir() else path.stat().st_size,
        parts=parts,
        ranges=_stored_ranges(layout),
        changed=made.changed if made else {},
        details={
            "grid_side": layout.grid_side,
            "codebook_side": layout.codebook_side,
            "version": made.version if made else None,
            "source_count": made.source_count if made else None,
            "settings": made.settings if made else {},
        },
    )


def _stored_ranges(layout: Layout) -> dict[str, tuple[float, float]]:
    ranges = {}
    for field in CHANNELS:
        ends = np.concatenate(layout.limits(field))
        if field == "means":
            ends = signed_exp(ends)
        ranges[NAMES.get(field, field)] = float(ends.min()), float(ends.max())
    if layout.sh_degree == 0:
        del ranges["shN"]
    return ranges


def _count_mask(files: Source, layout: Layout) -> int:
    side, name = layout.grid_side, "active_mask.webp"
    mask = decode_plane(files.read(name, MAX_PLANE_BYTES), name, width=side, height=side, channels=1)
    return int(np.count_nonzero(mask))
