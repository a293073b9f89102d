"""Describe the contents of a scene file, for ``kissgs info``."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from kissgs.core.errors import InvalidContainerError
from kissgs.core.signed_log import signed_exp
from kissgs.core.splats import ATTRIBUTES, clean
from kissgs.io.packed_files import Source, open_source
from kissgs.io.scene_file import refuse_more_than
from kissgs.pipeline.read_options import DEFAULT_READ_OPTIONS, ReadOptions
from kissgs.pipeline.scene_files import read_scene, stored_bytes
from kissgs.pipeline.scene_formats import SceneFormat, recognise, scene_root
from kissgs.sogxt.metadata import CHANNELS, Layout
from kissgs.sogxt.metadata_reader import read_layout
from kissgs.sogxt.names import FILES, PLANES

if TYPE_CHECKING:
    from kissgs.io.gltf import GltfInfo
    from kissgs.io.ksplat import KsplatInfo
    from kissgs.io.ply import PlyInfo
    from kissgs.io.spz import SpzInfo
    from kissgs.pipeline.inspect_sog import SogFacts

    Header = PlyInfo | SpzInfo | KsplatInfo | GltfInfo

NAMES = {"quaternions": "quats", "f_dc": "sh0", "f_rest_centroids": "shN"}
MAX_PLANE_BYTES = 1 << 30

DETAILS: dict[SceneFormat, dict[str, str]] = {
    "ply": {"encoding": "encoding", "compressed": "compressed"},
    "spz": {"version": "version", "antialiased": "antialiased", "fractional_bits": "fractional_bits"},
    "ksplat": {"compression_level": "level", "sections": "sections"},
    "gltf": {"binary": "binary", "primitives": "primitives", "spz": "spz"},
}
"""Details that the headers of files state, and the fields of the headers that have them."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Info:
    """Contents of a scene file or a container.

    Attributes:
        path: path of the file or folder.
        kind: format of the scene.
        count: Gaussians; of a streamed scene, those of one level and the environment.
        sh_degree: 0 to 3.
        bytes: size of the file or the folder.
        parts: bytes per file of a container, per container of a streamed scene; empty for other files.
        ranges: per attribute, over all channels, the smallest and largest finite value, or the values of the lowest and
            highest level (containers; where channels share a step, few reach the highest).
        changed: Gaussians that cleaning would remove or correct, or that the encoder removed or corrected (SOG-XT), by
            reason; empty for SOG, whose images are not decoded for this.
        details: encoding and whether it is PlayCanvas' compressed layout (``.ply``); side of grid and codebook, version
            and settings of the encoder (SOG-XT); version, variant of the renderer, generator and size of the codebook
            (SOG); the level that is described, and Gaussians per level and of the environment (streamed SOG); version,
            antialiasing and precision of positions (``.spz``); compression level and sections (``.ksplat``); primitives
            and compression (glTF).
    """

    path: str
    kind: SceneFormat
    count: int
    sh_degree: int
    bytes: int
    parts: dict[str, int]
    ranges: dict[str, tuple[float, float]]
    changed: dict[str, int]
    details: dict[str, Any]

    @property
    def bits_per_gaussian(self) -> float:
        """Bits of the whole file per Gaussian; of a streamed scene, those of the level's files."""
        total = sum(self.parts.values()) if self.kind == "streamed-sog" else self.bytes
        return 8 * total / max(self.count, 1)

    def as_dict(self) -> dict[str, Any]:
        """Return all fields and derived figures for JSON."""
        return {**asdict(self), "bits_per_gaussian": self.bits_per_gaussian}


@dataclass(frozen=True, slots=True, kw_only=True)
class SceneInfo:
    """Properties of a scene that its headers and metadata state.

    Attributes:
        format: format of the scene.
        count: Gaussians.
        sh_degree: 0 to 3.
    """

    format: SceneFormat
    count: int
    sh_degree: int


def read_scene_info(path: Path, *, name: str | None = None) -> SceneInfo:
    """Read the headers and metadata of a scene, without decoding it; errors in the rest are not found.

    Args:
        path: the file or folder.
        name: name of the file, if ``path`` has another one; the ending tells ``.splat``.

    Raises:
        KissgsError: the file is not a scene.
    """
    kind = recognise(path, name=name)
    if kind == "splat":
        from kissgs.io.splat import count_splat

        return SceneInfo(format=kind, count=count_splat(path), sh_degree=0)
    found: Header | SogFacts | Info
    if kind == "sogxt":
        found = _describe_sogxt(path)
    elif kind == "sog" or kind == "streamed-sog":
        found = _sog_facts(scene_root(path), kind, 0)
    else:
        found = _header(path, kind)
    return SceneInfo(format=kind, count=found.count, sh_degree=found.sh_degree)


def describe(path: Path, reading: ReadOptions = DEFAULT_READ_OPTIONS) -> Info:
    """Describe a scene file.

    No image of a container is decoded, except SOG-XT's mask if the metadata does not state the number of Gaussians.

    Raises:
        KissgsError: the file is not a usable scene or container, or has more Gaussians than ``reading`` allows.
    """
    kind = recognise(path)
    if kind == "sogxt":
        found = _describe_sogxt(path)
    elif kind == "sog" or kind == "streamed-sog":
        found = _describe_sog(path, kind, reading.level)
    else:
        return _describe_file(path, kind, reading)
    refuse_more_than(reading.max_gaussians, found.count, str(path))  # no default: no image is decoded
    return found


def _describe_sog(path: Path, kind: Literal["sog", "streamed-sog"], level: int) -> Info:
    root = scene_root(path)
    facts = _sog_facts(root, kind, level)
    return Info(
        path=str(path),
        kind=kind,
        count=facts.count,
        sh_degree=facts.sh_degree,
        bytes=stored_bytes(path),
        parts=facts.parts,
        ranges=facts.ranges,
        changed={},
        details=facts.details,
    )


def _sog_facts(root: Path, kind: Literal["sog", "streamed-sog"], level: int) -> SogFacts:
    from kissgs.pipeline.inspect_sog import sog_facts, streamed_facts

    return sog_facts(root) if kind == "sog" else streamed_facts(root, level)


def _describe_file(path: Path, kind: SceneFormat, reading: ReadOptions) -> Info:
    details, splats = _details(path, kind), read_scene(path, reading)
    return Info(
        path=str(path),
        kind=kind,
        count=len(splats),
        sh_degree=splats.sh_degree,
        bytes=path.stat().st_size,
        parts={},
        ranges={name: _extremes(getattr(splats, name)) for name in ATTRIBUTES if getattr(splats, name).size},
        changed=clean(splats)[1].as_dict(),
        details=details,
    )


def _details(path: Path, kind: SceneFormat) -> dict[str, Any]:
    """Return what the header of a file states besides count and SH degree."""
    if kind not in DETAILS:
        return {}
    header = _header(path, kind)
    return {name: getattr(header, field) for name, field in DETAILS[kind].items()}


def _header(path: Path, kind: SceneFormat) -> Header:
    """Read the header of a file that has one."""
    if kind == "spz":
        from kissgs.io.spz import read_spz_info

        return read_spz_info(path)
    if kind == "ksplat":
        from kissgs.io.ksplat import read_ksplat_info

        return read_ksplat_info(path)
    if kind == "gltf":
        from kissgs.io.gltf import read_gltf_info

        return read_gltf_info(path)
    from kissgs.io.ply import read_ply_info

    return read_ply_info(path)


def _extremes(values: np.ndarray) -> tuple[float, float]:
    low, high = float(values.min()), float(values.max())
    if not np.isfinite(low + high):
        values = values[np.isfinite(values)]
        low, high = (float(values.min()), float(values.max())) if values.size else (0.0, 0.0)
    return low, high


def _describe_sogxt(path: Path) -> Info:
    root = scene_root(path)
    with open_source(root) as files:
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
        kind="sogxt",
        count=count,
        sh_degree=layout.sh_degree,
        bytes=sum(parts.values()) if root.is_dir() else path.stat().st_size,
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
    from kissgs.io.webp import decode_plane

    side, name = layout.grid_side, "active_mask.webp"
    mask = decode_plane(files.read(name, MAX_PLANE_BYTES), name, width=side, height=side, channels=1)
    return int(np.count_nonzero(mask))
