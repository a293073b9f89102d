"""Reading of a container's metadata: the YAML if it exists, else ``meta.json``. Unknown keys are ignored."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from typing import Any

import numpy as np
import yaml
from pydantic import ValidationError

from kissgs.core.errors import InvalidContainerError, UnsupportedError
from kissgs.core.origin import read_origin
from kissgs.io.container_names import LEVELS_NAME, LOD_NAME
from kissgs.io.json_files import parse_json
from kissgs.io.packed_files import Source
from kissgs.sogxt.metadata import CHANNELS, TILE_COLUMNS, TILE_ROWS, Layout
from kissgs.sogxt.names import CHECKSUM, FORMAT, JSON_NAME, YAML_NAME

MAX_METADATA_BYTES = 1 << 20
"""Largest size of a metadata file, bytes; kissgs writes about 4 kB each."""

MAX_YAML_DEPTH = 50
"""Largest nesting; kissgs writes 6 levels. libyaml composes recursively, and Python's limit does not stop it."""

MAX_YAML_ALIASES = 20
"""Largest number of aliases: dumpers write one if two fields share a list; thousands would take hours to expand."""

MISSING = object()
"""Placeholder for a missing checksum: other encoders and early versions of kissgs write none."""

MAX_SIGNED_LOG = 88.7
"""Largest signed logarithm of a position: exp of more exceeds float32."""


def read_layout(source: Source) -> Layout:
    """Read and check the metadata of a container.

    Raises:
        InvalidContainerError: the metadata is missing, damaged or invalid.
        UnsupportedError: the images are not WebP, or ``meta.json`` is of another format or version.
    """
    names = source.names()
    name = next((name for name in (YAML_NAME, JSON_NAME) if name in names), None)
    if name is None:
        raise InvalidContainerError(
            f"this is no container: it has neither {YAML_NAME} nor {JSON_NAME}, and no {LOD_NAME} or {LEVELS_NAME} of "
            "a streamed scene; name the folder or the zip that has one"
        )
    read = _from_yaml if name == YAML_NAME else _from_json
    raw = read(source.read(name, MAX_METADATA_BYTES))
    checksum = raw.pop(CHECKSUM)
    try:
        # Some YAML dumpers write numbers as text, so that is accepted; in JSON it is refused, as in browsers.
        layout = Layout.model_validate(raw, strict=name == JSON_NAME)
    except ValidationError as error:
        raise InvalidContainerError(f"{name}: {_first_problem(error)}") from error
    _check_ranges(layout, name)
    if checksum is not MISSING and checksum != layout.checksum:
        raise InvalidContainerError(f"{name} is damaged: its numbers do not give its {CHECKSUM}; copy it again")
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
    """Return the fields of :class:`Layout` from the YAML, as tolerant as the reference decoder."""
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
    recorded = document.get("kissgs")
    return {
        "count": recorded.get("count") if isinstance(recorded, dict) else None,
        "grid_side": sides.get("grid_side"),
        "codebook_side": sides.get("f_rest_centroids_side"),
        "ranges": ranges,
        "provenance": recorded,
        "origin": read_origin(document, YAML_NAME),
        "model": _text(document.get("model")),
        CHECKSUM: document.get(CHECKSUM, MISSING),
    }


def _check_nesting(events: Iterable[yaml.Event]) -> None:
    """Raise YAMLError for documents that are nested too deeply, or that aliases or merge keys expand without bound."""
    depth = aliases = 0
    for event in events:
        aliases += isinstance(event, yaml.AliasEvent)
        if isinstance(event, yaml.CollectionStartEvent):
            depth += 1
        elif isinstance(event, yaml.CollectionEndEvent):
            depth -= 1
        merges = isinstance(event, yaml.ScalarEvent) and event.value == "<<"
        if merges or depth > MAX_YAML_DEPTH or aliases > MAX_YAML_ALIASES:
            raise yaml.YAMLError("nested too deep, or with too many aliases or merge keys")


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
            "model": _text(document.get("model")),
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
        ("format", document.get("format", FORMAT), FORMAT),
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


def _text(value: object) -> str | None:
    return value[:100] if isinstance(value, str) else None


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


def _first_problem(error: ValidationError) -> str:
    problem = error.errors()[0]
    return f"{'.'.join(map(str, problem['loc']))}: {problem['msg'].lower()}"
