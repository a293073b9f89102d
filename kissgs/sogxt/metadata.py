"""The metadata files ``container_meta.yaml``, ``meta.json`` and ``scene.json``.

:class:`Layout` is written in two formats: the paper's Python decoder reads the YAML, browsers read the two JSON files.
"""

from __future__ import annotations

import json
import zlib
from collections.abc import Mapping
from typing import Annotated, Any

import numpy as np
import yaml
from pydantic import BaseModel, BeforeValidator, ConfigDict, Field, FiniteFloat
from pydantic_core import PydanticCustomError

from kissgs.core.origin import WORLD, Origin, recorded
from kissgs.core.splats import MAX_CODEBOOK_SIDE, MAX_GRID_SIDE, SH_REST_COUNTS
from kissgs.io.containers import is_antialiased
from kissgs.sogxt.names import CHECKSUM, FORMAT, JSON_NAME

TILE_ROWS, TILE_COLUMNS = 3, 5

CHANNELS = {"opacities": 1, "means": 1, "scales": 3, "quaternions": 4, "f_dc": 3, "f_rest_centroids": 45}
"""Fields with a range, and its number of channels. One number is written as such, several as a list."""

CHECKED = ("f_dc", "opacities", "scales", "quaternions", "means", "f_rest_centroids")
"""Order of the ranges in the checksum of the metadata."""

FLOAT32_OVERFLOW = 2.0**128 - 2.0**103
"""Smallest number that does not round to a finite float32."""


def _no_bool(value: Any) -> Any:  # noqa: ANN401
    """Refuse true and false, which Python treats as numbers."""
    if isinstance(value, bool):
        raise PydanticCustomError("no_bool", "Input should be a valid number, not true or false")
    return value


Number = BeforeValidator(_no_bool)
Limit = Annotated[FiniteFloat, Field(gt=-FLOAT32_OVERFLOW, lt=FLOAT32_OVERFLOW), Number]


class Provenance(BaseModel):
    """Metadata of kissgs, under the key ``kissgs``; other readers skip it, and it may be missing."""

    model_config = ConfigDict(extra="ignore", frozen=True)

    version: str = Field(pattern=r"^[A-Za-z0-9_.+-]{1,40}$", description="Version of kissgs that wrote the container.")
    sh_degree: Annotated[int, Number] = Field(
        ge=0, le=3, description="SH degree of the scene; coefficients of higher bands are zero."
    )
    count: int = Field(ge=0, description="Number of Gaussians: active cells of the mask.")
    source_count: int = Field(ge=0, description="Number of Gaussians in the scene that was encoded.")
    changed: dict[str, int] = Field(
        default_factory=dict, description="Number of Gaussians pruned or repaired, by reason."
    )
    settings: dict[str, bool | int | float | str | None] = Field(
        default_factory=dict, description="Settings of the encoder."
    )
    sha256: dict[str, str] = Field(default_factory=dict, description="SHA-256 of each image file, hexadecimal.")


class Layout(BaseModel):
    """All metadata that a decoder needs besides the images."""

    model_config = ConfigDict(frozen=True)

    grid_side: Annotated[int, Number] = Field(ge=1, le=MAX_GRID_SIDE)
    codebook_side: Annotated[int, Number] = Field(ge=1, le=MAX_CODEBOOK_SIDE)
    ranges: dict[str, tuple[list[Limit], list[Limit]]]
    count: int | None = Field(None, ge=0, le=MAX_GRID_SIDE**2)
    provenance: Provenance | None = None
    origin: Origin = WORLD
    model: str | None = None
    """Variant of the renderer that the scene was made for, as in SOG: "antialiased", or None."""
    crc32: dict[str, Annotated[int, Field(ge=0, lt=1 << 32)]] = Field(default_factory=dict)
    """CRC-32 of each image's pixels (:func:`kissgs.io.webp.pixels_crc32`); in ``meta.json`` only."""

    @property
    def antialiased(self) -> bool:
        """Whether the scene was trained with antialiasing."""
        return is_antialiased(self.model)

    @property
    def notes(self) -> tuple[str, ...]:
        """Phrases for what reading leaves out: nothing is."""
        return ()

    def limits(self, field: str) -> tuple[np.ndarray, np.ndarray]:
        """Return ``low`` and ``high`` of a field, one number per channel: float32 numbers, as float64."""
        low, high = self.ranges[field]
        return np.array(low, dtype=np.float32).astype(np.float64), np.array(high, dtype=np.float32).astype(np.float64)

    @property
    def sh_degree(self) -> int:
        """SH degree: the larger one of the written degree and the one that bands with non-zero ranges need."""
        low, high = self.limits("f_rest_centroids")
        coefficients = np.flatnonzero(((low != 0) | (high != 0)).reshape(3, 15).any(axis=0))
        needed = 1 + int(coefficients.max(initial=-1))
        inferred = next(degree for degree, count in enumerate(SH_REST_COUNTS) if needed <= count)
        return max(inferred, self.provenance.sh_degree if self.provenance else 0)

    @property
    def checksum(self) -> int:
        """CRC-32 of all numbers that decoding needs, as float64, little endian."""
        sizes = [-1 if self.count is None else self.count, self.grid_side, self.codebook_side, self.sh_degree]
        ends = [np.stack(self.limits(field), axis=1).ravel() for field in CHECKED]
        return zlib.crc32(np.concatenate([sizes, *ends]).astype("<f8").tobytes())

    def to_yaml(self) -> bytes:
        """Return ``container_meta.yaml``: ASCII, floats always with a point, so that YAML 1.1 readers see numbers."""
        document: dict[str, Any] = {
            "meta": {
                "grid_side": self.grid_side,
                "f_rest_centroids_side": self.codebook_side,
                "image_codec": "webp",
            },
            "ops": [
                {
                    "input_fields": [field],
                    "transforms": [{"simple_quantize": self._range_entry(field, "min_values", "max_values")}],
                }
                for field in CHANNELS
            ],
        }
        if self.model is not None:
            document["model"] = self.model
        if self.provenance:
            document["kissgs"] = {**self.provenance.model_dump(), **recorded(self.origin)}
            document[CHECKSUM] = self.checksum
        dumper = getattr(yaml, "CSafeDumper", yaml.SafeDumper)
        return yaml.dump(document, Dumper=dumper, sort_keys=False, allow_unicode=False, width=120).encode("ascii")

    def to_meta_json(self) -> bytes:
        """Return ``meta.json``, version 3, for browsers."""

        def plane(field: str, *files: str, **more: Any) -> dict[str, Any]:  # noqa: ANN401
            return {**self._range_entry(field, "mins", "maxs"), "files": [f"{name}.webp" for name in files], **more}

        observed = {"normalize": "observed-minmax"}
        centroids = self._range_entry("f_rest_centroids", "centroidsMins", "centroidsMaxs")
        document = {
            "version": 3,
            "format": FORMAT,
            "profile": "SOG-XT",
            "count": self.count,
            "gridSide": self.grid_side,
            "mask": {"files": ["active_mask.webp"]},
            "means": plane("means", "means_bytes_0", "means_bytes_1"),
            "opacities": plane("opacities", "opacities", **observed),
            "scales": plane("scales", "scales", **observed),
            "quats": plane("quaternions", "quaternions", encoding="direct", **observed),
            "sh0": plane("f_dc", "f_dc", **observed),
            "shN": {
                "layout": "uv-codebook",
                "coeffs": 15,
                "centroidSide": self.codebook_side,
                "tileRows": TILE_ROWS,
                "tileCols": TILE_COLUMNS,
                **centroids,
                "files": ["f_rest_centroids.webp", "f_rest_labels.webp"],
                **observed,
            },
        }
        if self.model is not None:
            document["model"] = self.model
        if self.provenance:
            own = self.provenance.model_dump(include={"version", "sh_degree"})
            document["kissgs"] = {**own, **recorded(self.origin), "crc32": self.crc32}
            document[CHECKSUM] = self.checksum
        return json.dumps(document, separators=(",", ":"), allow_nan=False).encode("ascii")

    def _range_entry(self, field: str, low: str, high: str) -> dict[str, float | list[float]]:
        values = self.ranges[field]
        if CHANNELS[field] == 1:
            return {low: values[0][0], high: values[1][0]}
        return {low: values[0], high: values[1]}


SCENE_PLANES = {
    "mask": "active_mask",
    "positionCoarse": "means_bytes_1",
    "positionDetail": "means_bytes_0",
    "baseColor": "f_dc",
    "opacity": "opacities",
    "scales": "scales",
    "rotations": "quaternions",
    "shCentroids": "f_rest_centroids",
    "shLabels": "f_rest_labels",
}


def scene_json(files: Mapping[str, bytes]) -> bytes:
    """Return ``scene.json``: role and size of each file, so that viewers can plan their loading."""

    def entry(name: str) -> dict[str, Any]:
        return {"url": name, "bytes": len(files[name])}

    planes = {role: entry(f"{name}.webp") for role, name in SCENE_PLANES.items()}
    document = {"version": 1, "metadata": entry(JSON_NAME), "planes": planes}
    return json.dumps(document, separators=(",", ":")).encode("ascii")
