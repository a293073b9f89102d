"""Metadata of a SOG-XT container: what is written, and what is read and checked before any image is opened."""

from __future__ import annotations

import json
import math
import re
import zlib
from collections.abc import Iterator, Mapping
from typing import Annotated, Any

import numpy as np
import yaml
from pydantic import BaseModel, BeforeValidator, ConfigDict, Field, FiniteFloat, ValidationError
from pydantic_core import PydanticCustomError

from kissgs.core.errors import InvalidContainerError, UnsupportedError
from kissgs.core.positions import MAX_SIGNED_LOG, WORLD, Origin, read_origin, recorded, signed_exp
from kissgs.core.splats import MAX_CODEBOOK_SIDE, MAX_GRID_SIDE, SH_REST_COUNTS
from kissgs.formats import LEVELS_NAME, LOD_NAME
from kissgs.io.containers import MAX_METADATA_BYTES, Source, is_antialiased, stated_text
from kissgs.io.files import parse_json
from kissgs.sogxt import CHECKSUM, FORMAT_NAME, JSON_NAME, YAML_NAME

# The metadata files ``container_meta.yaml``, ``meta.json`` and ``scene.json``.
#
# :class:`Layout` is written in two formats: the paper's Python decoder reads the YAML, browsers read the two JSON
# files.

TILE_ROWS, TILE_COLUMNS = 3, 5

CHANNELS = {"opacities": 1, "means": 1, "scales": 3, "quaternions": 4, "f_dc": 3, "f_rest_centroids": 45}
"""Fields with a range, and its number of channels. One number is written as such, several as a list."""

ATTRIBUTE_OF = {field: field for field in CHANNELS} | {"quaternions": "quats", "f_dc": "sh0", "f_rest_centroids": "shN"}
"""Attribute of a scene that each field holds."""

CHECKED = ("f_dc", "opacities", "scales", "quaternions", "means", "f_rest_centroids")
"""Order of the ranges in the checksum of the metadata."""

FLOAT32_OVERFLOW = 2.0**128 - 2.0**103  # smallest number that does not round to a finite float32


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
        default_factory=dict, description="Settings of the encoder that differ from their defaults."
    )


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
    first_view: dict[str, Any] | None = None
    """View with which viewers open the scene; in ``meta.json`` only, and not read."""
    crc32: dict[str, Annotated[int, Field(ge=0, lt=1 << 32)]] = Field(default_factory=dict)
    """CRC-32 of each image's pixels (:func:`kissgs.io.images.pixels_crc32`); in ``meta.json`` only."""

    @property
    def antialiased(self) -> bool:
        """Whether the scene was trained with antialiasing."""
        return is_antialiased(self.model)

    def limits(self, field: str) -> tuple[np.ndarray, np.ndarray]:
        """Return ``low`` and ``high`` of a field, one number per channel: float32 numbers, as float64."""
        low, high = self.ranges[field]
        return np.array(low, dtype=np.float32).astype(np.float64), np.array(high, dtype=np.float32).astype(np.float64)

    def value_ranges(self) -> dict[str, tuple[float, float]]:
        """Return the values of the lowest and the highest level of every attribute."""
        ranges = {}
        for field, name in ATTRIBUTE_OF.items():
            if field != "f_rest_centroids" or self.sh_degree > 0:
                ends = np.concatenate(self.limits(field))
                ends = signed_exp(ends) if field == "means" else ends
                ranges[name] = float(ends.min()), float(ends.max())
        return ranges

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

        def quantize(field: str) -> dict[str, Any]:
            return {"simple_quantize": self._range_entry(field, "min_values", "max_values")}

        document: dict[str, Any] = {
            "meta": {"grid_side": self.grid_side, "f_rest_centroids_side": self.codebook_side, "image_codec": "webp"},
            "ops": [{"input_fields": [field], "transforms": [quantize(field)]} for field in CHANNELS],
        }
        if self.model is not None:
            document["model"] = self.model
        if self.provenance:
            document["kissgs"] = {**self.provenance.model_dump(), **recorded(self.origin)}
            document[CHECKSUM] = self.checksum
        dumper = getattr(yaml, "CSafeDumper", yaml.SafeDumper)
        text = yaml.dump(document, Dumper=dumper, sort_keys=False, default_flow_style=None, width=120)
        return text.encode("ascii")

    def to_meta_json(self) -> bytes:
        """Return ``meta.json``, version 3, for browsers."""

        def plane(field: str, *files: str, **more: Any) -> dict[str, Any]:  # noqa: ANN401
            return {**self._range_entry(field, "mins", "maxs"), "files": [f"{name}.webp" for name in files], **more}

        observed = {"normalize": "observed-minmax"}
        centroids = self._range_entry("f_rest_centroids", "centroidsMins", "centroidsMaxs")
        document = {
            "version": 3,
            "format": FORMAT_NAME,
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
            document["kissgs"] = {**own, **recorded(self.origin, self.first_view), "crc32": self.crc32}
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


# Reading of a container's metadata: ``meta.json`` if it exists, else the YAML. Unknown keys are ignored.

MAX_YAML_EVENTS = 20_000  # values, and beginnings and ends of lists and mappings; kissgs writes about 500
MAX_YAML_DEPTH = 50  # largest nesting; kissgs writes 6 levels
MAX_YAML_ALIASES = 20  # dumpers write one if two fields share a list; thousands would take long
MAX_NUMBER_LENGTH = 100  # characters of a number of the YAML; kissgs writes up to 25; longer ones are text

_CONSTANTS: dict[str, float | bool | None] = {
    **dict.fromkeys(("", "~", "null", "Null", "NULL"), None),
    **dict.fromkeys(("true", "True", "TRUE"), True),
    **dict.fromkeys(("false", "False", "FALSE"), False),
    ".inf": math.inf,
    "-.inf": -math.inf,
    ".nan": math.nan,
}

_NUMBER = re.compile(r"[-+]?((0|[1-9][0-9]*)(\.[0-9]*)?|\.[0-9]+)([eE][-+]?[0-9]+)?")

_WORD = re.compile(r"""[^ \t\r\n,:"'\[\]{}]+""")

MISSING = object()  # placeholder for a missing checksum: other encoders and early versions of kissgs write none


def read_layout(source: Source) -> Layout:
    """Read and check the metadata of a container."""
    names = source.names()
    if JSON_NAME in names:
        layout = _layout_of(_from_json(source.read(JSON_NAME, MAX_METADATA_BYTES)), JSON_NAME)
        if YAML_NAME in names:
            _compare(source.read(YAML_NAME, MAX_METADATA_BYTES), layout)
        return layout
    if YAML_NAME in names:
        return _layout_of(_from_yaml(source.read(YAML_NAME, MAX_METADATA_BYTES)), YAML_NAME)
    raise InvalidContainerError(
        f"this is no container: it has neither {YAML_NAME} nor {JSON_NAME}, and no {LOD_NAME} or {LEVELS_NAME} of "
        "a streamed scene; name the folder or the zip that has one"
    )


def read_provenance(source: Source) -> Provenance | None:
    """Return what kissgs recorded about the encoding, of which ``meta.json`` has a part; None for other encoders."""
    if YAML_NAME not in source.names():
        return read_layout(source).provenance
    return _layout_of(_from_yaml(source.read(YAML_NAME, MAX_METADATA_BYTES)), YAML_NAME).provenance


def _layout_of(raw: dict[str, Any], name: str) -> Layout:
    """Check the fields of :class:`Layout` from the file ``name``."""
    checksum = raw.pop(CHECKSUM)
    try:
        # Some YAML dumpers write numbers as text, so that is accepted; in JSON it is refused, as in browsers.
        layout = Layout.model_validate(raw, strict=name == JSON_NAME)
    except ValidationError as error:
        problem = error.errors()[0]
        where = ".".join(map(str, problem["loc"]))
        raise InvalidContainerError(f"{name}: {where}: {problem['msg'].lower()}") from error
    _check_ranges(layout, name)
    if checksum is not MISSING and checksum != layout.checksum:
        raise InvalidContainerError(f"{name} is damaged: its numbers do not give its {CHECKSUM}; copy it again")
    return layout


def _compare(data: bytes, layout: Layout) -> None:
    """Refuse a YAML file that states another scene than ``meta.json``, as ``web_decoder/scene.js`` does. Numbers are
    compared by the word before them, and the word after "model", so that browsers need no YAML reader."""
    stated: dict[str, list[float]] = {"model": [False]}
    field = before = key = ""
    for word in _WORD.findall(data.decode("utf-8-sig", "replace")):
        if len(word) <= MAX_NUMBER_LENGTH and _NUMBER.fullmatch(word):
            stated.setdefault(key, []).append(float(word))
        elif word != "-":
            field = word if before == "input_fields" else field
            key = f"{field} {word}" if word in ("min_values", "max_values") else word
            stated[key] = []
            if before == "model":
                stated[before] = [word.lower() == "antialiased"]
            before = word
    stated["origin"] = stated.get("origin") or [*WORLD]
    needed: dict[str, list[float]] = {"grid_side": [layout.grid_side], "f_rest_centroids_side": [layout.codebook_side]}
    needed |= {"origin": [*layout.origin], "model": [layout.antialiased]}
    optional = {"count": [layout.count], "sh_degree": [layout.sh_degree], CHECKSUM: [layout.checksum]}
    same = all(stated.get(key) == value for key, value in needed.items())
    same = same and all(stated.get(key, value) == value for key, value in optional.items())
    with np.errstate(over="ignore"):
        for field in CHANNELS:
            for end, values in zip(("min_values", "max_values"), layout.limits(field), strict=True):
                found = np.array(stated.get(f"{field} {end}", ()), dtype=np.float32)
                same = same and np.array_equal(found, values)
    if not same:
        raise InvalidContainerError(
            f"{YAML_NAME} and {JSON_NAME} do not state the same: one is damaged or of another scene; "
            "copy the container again, or remove the wrong one"
        )


def _check_ranges(layout: Layout, name: str) -> None:
    for field, channels in CHANNELS.items():
        if field not in layout.ranges:
            raise InvalidContainerError(f"{name} gives no range for {field}")
        for values in layout.ranges[field]:
            if len(values) != channels:
                raise InvalidContainerError(f"{name}: the range of {field} has {len(values)} numbers, not {channels}")
    if np.abs(layout.limits("means")).max() > MAX_SIGNED_LOG:
        reason = f"the range of means ends beyond ±{MAX_SIGNED_LOG}, which float32 cannot hold"
        raise InvalidContainerError(f"{name}: {reason}")


def _from_yaml(data: bytes) -> dict[str, Any]:
    """Return the fields of :class:`Layout` from the YAML, as tolerant as the reference decoder."""
    try:
        document = _load_yaml(data)
        sides = document["meta"]
        ops = document["ops"]
        ranges = dict(found for op in ops for found in _ranges_of(op) if found[0] in CHANNELS)
    except (yaml.YAMLError, UnicodeDecodeError) as error:
        raise InvalidContainerError(f"{YAML_NAME} is not readable YAML") from error
    except (KeyError, TypeError, AttributeError, ValueError, IndexError) as error:
        problem = "lacks 'meta' or 'ops', or they are not of the expected form"
        raise InvalidContainerError(f"{YAML_NAME} {problem}") from error
    _require_webp(sides.get("image_codec") if isinstance(sides, dict) else None)
    recorded = document.get("kissgs")
    return {
        "count": recorded.get("count") if isinstance(recorded, dict) else None,
        "grid_side": sides.get("grid_side"),
        "codebook_side": sides.get("f_rest_centroids_side"),
        "ranges": ranges,
        "provenance": recorded,
        "origin": read_origin(document, YAML_NAME),
        "model": stated_text(document.get("model")),
        CHECKSUM: document.get(CHECKSUM, MISSING),
    }


def _load_yaml(data: bytes) -> Any:  # noqa: ANN401
    """Return a document of lists, mappings with keys of text, and the plain values of YAML 1.2: see :func:`_value`.
    PyYAML's loaders know more (numbers of base 60, merge keys, keys of any type), which takes minutes to expand."""
    waiting: list[tuple[Any, list[Any]]] = [(None, [])]
    anchors: dict[str | None, Any] = {}
    aliases = 0
    for number, event in enumerate(yaml.parse(data, Loader=getattr(yaml, "CSafeLoader", yaml.SafeLoader))):
        aliases += isinstance(event, yaml.AliasEvent)
        if number > MAX_YAML_EVENTS or len(waiting) > MAX_YAML_DEPTH or aliases > MAX_YAML_ALIASES:
            raise yaml.YAMLError("too many values or aliases, or nested too deep")
        if getattr(event, "tag", None) is not None:
            raise yaml.YAMLError("tags are not read")
        if isinstance(event, yaml.CollectionStartEvent):
            waiting.append((event, []))
            continue
        parent, items = waiting[-1]
        value: Any
        if isinstance(event, yaml.CollectionEndEvent):
            value = items
            if isinstance(parent, yaml.MappingStartEvent):
                if not all(isinstance(key, str) and key != "<<" for key in items[::2]):
                    raise yaml.YAMLError("a key is no text, or merges mappings")
                value = dict(zip(items[::2], items[1::2], strict=True))
            event, items = waiting.pop()[0], waiting[-1][1]
        elif isinstance(event, yaml.AliasEvent):
            if event.anchor not in anchors:
                raise yaml.YAMLError("an alias of nothing")
            value = anchors[event.anchor]
        elif isinstance(event, yaml.ScalarEvent):
            is_key = isinstance(parent, yaml.MappingStartEvent) and len(items) % 2 == 0
            value = event.value if is_key or not event.implicit[0] else _value(event.value)
        else:
            continue
        anchors[event.anchor] = value
        items.append(value)
    documents = waiting[0][1]
    if len(documents) > 1:
        raise yaml.YAMLError("more than one document")
    return documents[0] if documents else None


def _value(text: str) -> bool | float | str | None:
    """Return the null, true, false or number that an unquoted text stands for, else the text."""
    if text in _CONSTANTS:
        return _CONSTANTS[text]
    if len(text) > MAX_NUMBER_LENGTH or not _NUMBER.fullmatch(text):
        return text
    return int(text) if text.lstrip("+-").isdigit() else float(text)


def _ranges_of(op: Mapping[str, Any]) -> Iterator[tuple[str, tuple[list[Any], list[Any]]]]:
    """Yield field and range of each range of one op (the last one counts); nothing for ops on several fields."""
    fields = op["input_fields"]
    if len(fields) != 1:
        return
    for transform in op.get("transforms", ()):
        quantize = transform.get("simple_quantize")
        if quantize and "min_values" in quantize:
            yield fields[0], (_flat(quantize["min_values"]), _flat(quantize["max_values"]))


def _from_json(data: bytes) -> dict[str, Any]:
    """Return the fields of :class:`Layout` from ``meta.json``; accept what ``web_decoder/scene.js`` accepts."""
    document = parse_json(data, JSON_NAME, parse_int=float)  # every number becomes a float64, as in browsers
    try:
        _check_dialect(document)
        keys = {"opacities": "opacities", "means": "means", "scales": "scales", "quats": "quaternions", "sh0": "f_dc"}
        ranges = {
            field: (_spread(document[key]["mins"], CHANNELS[field]), _spread(document[key]["maxs"], CHANNELS[field]))
            for key, field in keys.items()
        }
        rest = document["shN"]
        ranges["f_rest_centroids"] = _spread(rest["centroidsMins"], 45), _spread(rest["centroidsMaxs"], 45)
        count = _whole(document["count"])
        if count is None:
            raise KeyError("count")
        raw = {
            "count": count,
            "grid_side": _whole(document["gridSide"]),
            "codebook_side": _whole(rest["centroidSide"]),
            "ranges": ranges,
            "origin": read_origin(document, JSON_NAME),
            "model": stated_text(document.get("model")),
            CHECKSUM: document.get(CHECKSUM, MISSING),
        }
        if "kissgs" in document:
            recorded = document["kissgs"]
            degree, checksums = _whole(recorded["sh_degree"]), recorded.get("crc32", {})
            shared = {"count": count, "source_count": count}
            raw["provenance"] = {"version": recorded["version"], "sh_degree": degree, **shared}
            raw["crc32"] = {name: _whole(value) for name, value in checksums.items()}
        return raw
    except (KeyError, TypeError, AttributeError, IndexError) as error:
        raise InvalidContainerError(f"{JSON_NAME} lacks something that a SOG-XT container has: {error}") from error


def _whole(value: Any) -> Any:  # noqa: ANN401
    """Return a whole number as int; anything else unchanged, which type validation refuses."""
    return int(value) if isinstance(value, float) and value.is_integer() else value


def _check_dialect(document: Mapping[str, Any]) -> None:
    """Refuse formats that would decode to wrong values without an error."""
    quats, rest, files = document["quats"], document["shN"], document["mask"]["files"]
    for name, found, known in (
        ("format", document.get("format", FORMAT_NAME), FORMAT_NAME),
        ("version", document.get("version", 3), 3),
        ("quats.encoding", quats.get("encoding", "direct"), "direct"),
        ("shN.layout", rest.get("layout", "uv-codebook"), "uv-codebook"),
        ("shN.coeffs", rest.get("coeffs", 15), 15),
        ("shN.tileRows", rest.get("tileRows", TILE_ROWS), TILE_ROWS),
        ("shN.tileCols", rest.get("tileCols", TILE_COLUMNS), TILE_COLUMNS),
    ):
        if found != known:
            raise UnsupportedError(f"{JSON_NAME}: {name} is {repr(_whole(found))[:80]}; only {known!r} is read")
    if not isinstance(files, list):
        raise TypeError("mask.files is not a list")
    _require_webp(files[0].rsplit(".", 1)[-1])


def _require_webp(codec: object) -> None:
    if codec != "webp":
        raise UnsupportedError(f"the container's images are {codec!r} files; only 'webp' is read")


def _flat(values: Any) -> list[Any]:  # noqa: ANN401
    """Return a number as a list of one, or a flattened list; stop early, since YAML aliases may expand to millions."""
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
    raise ValueError("a range has more than 1000 values")


def _spread(values: Any, channels: int) -> list[Any]:  # noqa: ANN401
    """Return one number per channel: repeat a number, or the first of a list of another length, as browsers do."""
    numbers = values if isinstance(values, list) else [values]
    return numbers if len(numbers) == channels else numbers[:1] * channels
