"""Describe the contents of a scene file, for ``kissgs info``."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from kissgs.core.splats import ATTRIBUTES, clean
from kissgs.io.files import refuse_more_than
from kissgs.pipeline.scene_files import (
    CONTAINER_FORMATS,
    DEFAULT_READ_OPTIONS,
    STREAMED_FORMATS,
    ReadOptions,
    SceneFormat,
    read_scene,
    reading_notes,
    recognise,
    scene_root,
    stored_bytes,
)

if TYPE_CHECKING:
    from kissgs.io.gltf import GltfInfo
    from kissgs.io.ksplat import KsplatInfo
    from kissgs.io.ply import PlyInfo
    from kissgs.io.spz import SpzInfo
    from kissgs.pipeline.container_facts import Facts

    Header = PlyInfo | SpzInfo | KsplatInfo | GltfInfo

DETAILS: dict[SceneFormat, dict[str, str]] = {
    "ply": {"encoding": "encoding", "compressed": "compressed", "antialiased": "antialiased"},
    "spz": {"version": "version", "antialiased": "antialiased", "fractional_bits": "fractional_bits"},
    "ksplat": {"compression_level": "level", "sections": "sections"},
    "gltf": {"binary": "binary", "primitives": "primitives", "spz": "spz", "antialiased": "antialiased"},
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
        details: whether it is marked as antialiased, but for formats without such a mark; encoding and whether it is
            PlayCanvas' compressed layout (``.ply``); side of grid and codebook, version
            and settings of the encoder (SOG-XT); version, variant of the renderer, generator and size of the codebook
            (SOG); the level that is described, and Gaussians per level and of the environment (streamed scenes);
            version and precision of positions (``.spz``); compression level and sections (``.ksplat``);
            primitives and compression (glTF); the origin of positions where it is not the world's.
        notes: what reading leaves out or changes, one phrase each; of containers, what their metadata says.
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
    notes: tuple[str, ...] = ()

    @property
    def bits_per_gaussian(self) -> float:
        """Bits of the whole file per Gaussian; of a streamed scene, those of the level's files."""
        total = sum(self.parts.values()) if self.kind in STREAMED_FORMATS else self.bytes
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
    found: Header | Facts
    found = _facts(path, kind, 0) if kind in CONTAINER_FORMATS else _header(path, kind)
    return SceneInfo(format=kind, count=found.count, sh_degree=found.sh_degree)


def describe(path: Path, reading: ReadOptions = DEFAULT_READ_OPTIONS) -> Info:
    """Describe a scene file.

    No image of a container is decoded, except SOG-XT's mask if the metadata does not state the number of Gaussians.

    Raises:
        KissgsError: the file is not a usable scene or container, or has more Gaussians than ``reading`` allows.
    """
    kind = recognise(path)
    if kind not in CONTAINER_FORMATS:
        return _describe_file(path, kind, reading)
    facts = _facts(path, kind, reading.level)
    refuse_more_than(reading.max_gaussians, facts.count, str(path))  # no default: no image is decoded
    return Info(
        path=str(path),
        kind=kind,
        count=facts.count,
        sh_degree=facts.sh_degree,
        bytes=stored_bytes(path),
        parts=facts.parts,
        ranges=facts.ranges,
        changed=facts.changed,
        details=facts.details,
        notes=facts.notes,
    )


def _facts(path: Path, kind: SceneFormat, level: int) -> Facts:
    """Return the facts of a container, or of a level of a streamed scene."""
    root = scene_root(path)
    if kind == "sog":
        from kissgs.pipeline.inspect_sog import sog_facts

        return sog_facts(root)
    if kind == "sogxt":
        from kissgs.pipeline.inspect_sogxt import sogxt_facts

        return sogxt_facts(root)
    from kissgs.pipeline.inspect_streamed import streamed_sog_facts, streamed_sogxt_facts

    return streamed_sog_facts(root, level) if kind == "streamed-sog" else streamed_sogxt_facts(root, level)


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
        notes=tuple(reading_notes(splats)),
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
