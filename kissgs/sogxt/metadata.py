"""What stands beside the images: ``container_meta.yaml``, ``meta.json`` and ``scene.json``.

One truth, :class:`Layout`, in two spellings: the YAML is what the paper's Python decoder reads, the two JSON files what
browsers read. Reading takes the YAML if it is there, else ``meta.json``, and tolerates what we do not know.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Iterator, Mapping
from typing import Annotated, Any, Literal

import numpy as np
import yaml
from pydantic import BaseModel, ConfigDict, Field, FiniteFloat, ValidationError

from kissgs.errors import InvalidContainerError, UnsupportedError
from kissgs.sogxt.container import Source
from kissgs.sogxt.names import JSON_NAME, YAML_NAME
from kissgs.sogxt.order import MAX_GRID_SIDE
from kissgs.splats import SH_REST_COUNTS

MAX_METADATA_BYTES = 1 << 20
"""The three metadata files have about 4 kB each."""

MAX_YAML_DEPTH = 50
"""Ours is nested 6 deep. libyaml composes by recursion, which no limit of Python's stops before the stack ends."""

TILE_ROWS, TILE_COLUMNS = 3, 5
MAX_CODEBOOK_SIDE = 256
"""Labels have two 8-bit coordinates."""

MAX_SIGNED_LOG = 88.7
"""e to more than this is beyond float32."""

CHANNELS = {"opacities": 1, "means": 1, "scales": 3, "quaternions": 4, "f_dc": 3, "f_rest_centroids": 45}
"""Fields with a range, and how many numbers it has. One number stands as such, several as a list."""

Limit = Annotated[FiniteFloat, Field(ge=-3.4028234e38, le=3.4028234e38)]


class Provenance(BaseModel):
    """Our own part of the metadata, under the key ``kissgs``; other readers skip it, and it may be missing."""

    model_config = ConfigDict(extra="ignore", frozen=True)

    version: str = Field(description="Version of kissgs that wrote the container.")
    sh_degree: int = Field(ge=0, le=3, description="SH degree of the scene; coefficients of higher bands are zero.")
    count: int = Field(ge=0, description="Number of Gaussians: active cells of the mask.")
    source_count: int = Field(ge=0, description="Number of Gaussians in the scene that was encoded.")
    changed: dict[str, int] = Field(default_factory=dict, description="Gaussians left out or mended, by reason.")
    settings: dict[str, Any] = Field(default_factory=dict, description="Encoder settings.")
    sha256: dict[str, str] = Field(default_factory=dict, description="SHA-256 of each image file, hexadecimal.")


class SimpleQuantize(BaseModel):
    """Values of the smallest and the largest level that occur in the field's image, per channel."""

    min_values: Limit | list[Limit]
    max_values: Limit | list[Limit]


class Transform(BaseModel):
    """One step between image and values."""

    simple_quantize: SimpleQuantize


class Op(BaseModel):
    """How one field is stored."""

    input_fields: list[str] = Field(min_length=1, max_length=1)
    transforms: list[Transform] = Field(min_length=1)


class Sides(BaseModel):
    """Sizes of the images and the suffix of their files."""

    grid_side: int = Field(ge=1, le=MAX_GRID_SIDE)
    f_rest_centroids_side: int = Field(ge=1, le=MAX_CODEBOOK_SIDE)
    image_codec: Literal["webp"]


class ContainerMeta(BaseModel):
    """``container_meta.yaml`` as kissgs writes it."""

    meta: Sides
    ops: list[Op]
    kissgs: Provenance | None = None


class Layout(BaseModel):
    """All that a decoder must know beside the images."""

    model_config = ConfigDict(frozen=True)

    grid_side: int = Field(ge=1, le=MAX_GRID_SIDE)
    codebook_side: int = Field(ge=1, le=MAX_CODEBOOK_SIDE)
    ranges: dict[str, tuple[list[Limit], list[Limit]]]
    provenance: Provenance | None = None

    def limits(self, field: str) -> tuple[np.ndarray, np.ndarray]:
        """``low`` and ``high`` of a field, one number per channel: float32 numbers, as float64."""
        low, high = self.ranges[field]
        return np.array(low, dtype=np.float32).astype(np.float64), np.array(high, dtype=np.float32).astype(np.float64)

    @property
    def sh_degree(self) -> int:
        """Degree that was written, or that the bands which are not zero throughout need, whichever is larger."""
        low, high = self.limits("f_rest_centroids")
        coefficients = np.flatnonzero(((low != 0) | (high != 0)).reshape(3, 15).any(axis=0))
        needed = 1 + int(coefficients.max(initial=-1))
        inferred = next(degree for degree, count in enumerate(SH_REST_COUNTS) if needed <= count)
        return max(inferred, self.provenance.sh_degree if self.provenance else 0)

    def to_yaml(self) -> bytes:
        """``container_meta.yaml``: ASCII, floats always with a point, so that YAML 1.1 readers see numbers."""
        document = {
            "meta": {
                "grid_side": self.grid_side,
                "f_rest_centroids_side": self.codebook_side,
                "image_codec": "webp",
            },
            "ops": [
                {
                    "input_fields": [field],
                    "transforms": [{"simple_quantize": self._spelled(field, "min_values", "max_values")}],
                }
                for field in CHANNELS
            ],
        }
        if self.provenance:
            document["kissgs"] = self.provenance.model_dump()
        dumper = getattr(yaml, "CSafeDumper", yaml.SafeDumper)
        return yaml.dump(document, Dumper=dumper, sort_keys=False, allow_unicode=False, width=120).encode("ascii")

    def to_meta_json(self, count: int) -> bytes:
        """``meta.json``, version 3: the same for browsers."""

        def plane(field: str, *files: str, **more: Any) -> dict[str, Any]:  # noqa: ANN401
            return {**self._spelled(field, "mins", "maxs"), "files": [f"{name}.webp" for name in files], **more}

        observed = {"normalize": "observed-minmax"}
        centroids = self._spelled("f_rest_centroids", "centroidsMins", "centroidsMaxs")
        document = {
            "version": 3,
            "format": "sog-xt",
            "profile": "SOG-XT",
            "count": count,
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
        if self.provenance:
            document["kissgs"] = self.provenance.model_dump(include={"version", "sh_degree", "sha256"})
        return json.dumps(document, separators=(",", ":"), allow_nan=False).encode("ascii")

    def _spelled(self, field: str, low: str, high: str) -> dict[str, float | list[float]]:
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
    """``scene.json``: which file holds what and how large it is, so that viewers can plan their loading."""

    def entry(name: str) -> dict[str, Any]:
        return {"url": name, "bytes": len(files[name])}

    planes = {role: entry(f"{name}.webp") for role, name in SCENE_PLANES.items()}
    document = {"version": 1, "metadata": entry(JSON_NAME), "planes": planes}
    return json.dumps(document, separators=(",", ":")).encode("ascii")


def read_layout(source: Source) -> Layout:
    """Read and check the metadata of a container.

    Raises:
        InvalidContainerError: there is none, or it says something impossible.
        UnsupportedError: its images are not WebP.
    """
    names = source.names()
    if YAML_NAME in names:
        raw = _from_yaml(source.read(YAML_NAME, MAX_METADATA_BYTES))
        name = YAML_NAME
    elif JSON_NAME in names:
        raw = _from_json(source.read(JSON_NAME, MAX_METADATA_BYTES))
        name = JSON_NAME
    else:
        raise InvalidContainerError(f"this is no SOG-XT container: it has neither {YAML_NAME} nor {JSON_NAME}")
    try:
        layout = Layout.model_validate(raw)
    except ValidationError as error:
        raise InvalidContainerError(f"{name}: {_first_problem(error)}") from error
    _check_ranges(layout, name)
    return layout


def _check_ranges(layout: Layout, name: str) -> None:
    for field, channels in CHANNELS.items():
        if field not in layout.ranges:
            raise InvalidContainerError(f"{name} gives no range for {field}")
        for values in layout.ranges[field]:
            if len(values) != channels:
                raise InvalidContainerError(f"{name}: the range of {field} has {len(values)} numbers, not {channels}")
    if np.abs(layout.limits("means")).max() > MAX_SIGNED_LOG:
        raise InvalidContainerError(
            f"{name}: the range of means ends beyond ±{MAX_SIGNED_LOG}, which float32 cannot hold"
        )


def _from_yaml(data: bytes) -> dict[str, Any]:
    """The fields of :class:`Layout` out of the YAML, as forgiving as the reference decoder."""
    loader = getattr(yaml, "CSafeLoader", yaml.SafeLoader)
    try:
        _check_nesting(yaml.parse(data, Loader=loader))
        document = yaml.load(data, Loader=loader)
        sides = document["meta"]
        ops = document["ops"]
        ranges = dict(found for op in ops for found in _ranges_of(op) if found[0] in CHANNELS)
    except (yaml.YAMLError, UnicodeDecodeError, RecursionError) as error:
        raise InvalidContainerError(f"{YAML_NAME} is not readable YAML") from error
    except (KeyError, TypeError, AttributeError, ValueError, IndexError) as error:
        raise InvalidContainerError(
            f"{YAML_NAME} lacks 'meta' or 'ops', or they are not of the expected form"
        ) from error
    _require_webp(sides.get("image_codec") if isinstance(sides, dict) else None)
    return {
        "grid_side": sides.get("grid_side"),
        "codebook_side": sides.get("f_rest_centroids_side"),
        "ranges": ranges,
        "provenance": document.get("kissgs"),
    }


def _check_nesting(events: Iterable[yaml.Event]) -> None:
    """Raise YAMLError for documents that a few bytes make deep, or, by merge keys that double, endless."""
    depth = 0
    for event in events:
        if isinstance(event, yaml.CollectionStartEvent):
            depth += 1
        elif isinstance(event, yaml.CollectionEndEvent):
            depth -= 1
        if depth > MAX_YAML_DEPTH or (isinstance(event, yaml.ScalarEvent) and event.value == "<<"):
            raise yaml.YAMLError("nested too deep, or with merge keys")


def _ranges_of(op: Mapping[str, Any]) -> Iterator[tuple[str, tuple[list[Any], list[Any]]]]:
    """Field and range of one op, as often as it gives one (the last counts); nothing for ops on several fields."""
    fields = op["input_fields"]
    if len(fields) != 1:
        return
    for transform in op.get("transforms", ()):
        quantize = transform.get("simple_quantize")
        if quantize and "min_values" in quantize:
            yield fields[0], (_flat(quantize["min_values"]), _flat(quantize["max_values"]))


def _from_json(data: bytes) -> dict[str, Any]:
    """The fields of :class:`Layout` out of ``meta.json``."""
    try:
        document = json.loads(data)
        if document.get("format", "sog-xt") != "sog-xt":
            raise InvalidContainerError(f"{JSON_NAME} is of the format {document['format']!r}, not 'sog-xt'")
        keys = {"opacities": "opacities", "means": "means", "scales": "scales", "quats": "quaternions", "sh0": "f_dc"}
        ranges = {
            field: (_spread(document[key]["mins"], CHANNELS[field]), _spread(document[key]["maxs"], CHANNELS[field]))
            for key, field in keys.items()
        }
        rest = document["shN"]
        ranges["f_rest_centroids"] = _spread(rest["centroidsMins"], 45), _spread(rest["centroidsMaxs"], 45)
        files = document["mask"]["files"]
        _require_webp(str(files[0]).rsplit(".", 1)[-1])
        return {"grid_side": document["gridSide"], "codebook_side": rest["centroidSide"], "ranges": ranges}
    except (ValueError, RecursionError) as error:
        raise InvalidContainerError(f"{JSON_NAME} is not readable JSON") from error
    except (KeyError, TypeError, AttributeError, IndexError) as error:
        raise InvalidContainerError(f"{JSON_NAME} lacks something that a SOG-XT container has: {error}") from error


def _require_webp(codec: object) -> None:
    if codec != "webp":
        raise UnsupportedError(f"the container's images are {codec!r} files; only 'webp' is read")


def _flat(values: Any) -> list[Any]:  # noqa: ANN401
    """A number as a list of one; nested lists flattened. A few aliases in a YAML could spell millions: stop early."""
    flat: list[Any] = []
    waiting = [values]
    for _ in range(1000):
        if not waiting:
            return flat
        value = waiting.pop()
        if isinstance(value, list):
            waiting.extend(reversed(value))
        else:
            flat.append(value)
    raise ValueError("a range of absurd length")


def _spread(values: Any, channels: int) -> list[Any]:  # noqa: ANN401
    """As browsers do: a range of another length stands for all channels by its first number."""
    flat = _flat(values)
    return flat if len(flat) == channels else [flat[0]] * channels


def _first_problem(error: ValidationError) -> str:
    problem = error.errors()[0]
    return f"{'.'.join(map(str, problem['loc']))}: {problem['msg'].lower()}"
