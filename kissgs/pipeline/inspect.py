"""Describe the contents of a scene file, for ``kissgs info``."""

from __future__ import annotations

from dataclasses import asdict, dataclass, fields, replace
from pathlib import Path
from typing import Any

import numpy as np

from kissgs.core.splats import ATTRIBUTES, clean
from kissgs.formats import FORMATS
from kissgs.io.files import refuse_more_than
from kissgs.io.scene_format import DEFAULT_READ_OPTIONS, Facts, ReadOptions
from kissgs.pipeline.scene_files import read_scene, reading_notes, recognise, refuse_level, scene_root, stored_bytes


@dataclass(frozen=True, slots=True, kw_only=True)
class Info(Facts):
    """Contents of a scene file or a container.

    Beyond what the metadata states, those that are decoded for it have their ranges over all finite values, and the
    Gaussians that cleaning would remove or correct. The count of a streamed scene is that of one level.
    """

    path: str
    kind: str
    bytes: int
    """Size of the file or the folder."""

    @property
    def bits_per_gaussian(self) -> float:
        """Bits of the whole file per Gaussian; of a streamed scene, those of the level's files."""
        total = sum(self.parts.values()) if FORMATS[self.kind].manifest else self.bytes
        return 8 * total / max(self.count, 1)

    def as_dict(self) -> dict[str, Any]:
        """Return all fields and derived figures for JSON, without the texts for the terminal."""
        found = {"path": self.path, **asdict(self), "bits_per_gaussian": self.bits_per_gaussian}
        return {name: value for name, value in found.items() if name not in ("title", "lines")}


@dataclass(frozen=True, slots=True, kw_only=True)
class SceneInfo:
    """Properties of a scene that its headers and metadata state.

    Attributes:
        format: format of the scene.
        count: Gaussians.
        sh_degree: 0 to 3.
    """

    format: str
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
    facts = FORMATS[kind].codec.info(scene_root(path), 0)
    return SceneInfo(format=kind, count=facts.count, sh_degree=facts.sh_degree)


def describe(path: Path, reading: ReadOptions = DEFAULT_READ_OPTIONS) -> Info:
    """Describe a scene file.

    No image of a container is decoded, except SOG-XT's mask if the metadata does not state the number of Gaussians.
    """
    kind = recognise(path)
    refuse_level(kind, reading.level)
    facts = FORMATS[kind].codec.info(scene_root(path), reading.level)
    if FORMATS[kind].is_container:
        refuse_more_than(reading.max_gaussians, facts.count, str(path))  # no default: no image is decoded
    else:
        splats = read_scene(path, reading)
        facts = replace(
            facts,
            count=len(splats),
            sh_degree=splats.sh_degree,
            ranges={name: _extremes(getattr(splats, name)) for name in ATTRIBUTES if getattr(splats, name).size},
            changed=clean(splats)[1].as_dict(),
            notes=tuple(reading_notes(splats)),
        )
    found = {each.name: getattr(facts, each.name) for each in fields(facts)}
    return Info(path=str(path), kind=kind, bytes=stored_bytes(path), **found)


def _extremes(values: np.ndarray) -> tuple[float, float]:
    low, high = float(values.min()), float(values.max())
    if not np.isfinite(low + high):
        values = values[np.isfinite(values)]
        low, high = (float(values.min()), float(values.max())) if values.size else (0.0, 0.0)
    return low, high
