"""Reading a container's metadata: its YAML if it is there, else ``meta.json``. What we do not know is let pass."""

from __future__ import annotations

import json
from collections.abc import Iterable, Iterator, Mapping
from typing import Any, NoReturn

import numpy as np
import yaml
from pydantic import ValidationError

from kissgs.core.errors import InvalidContainerError, UnsupportedError
from kissgs.sogxt.container import Source
from kissgs.sogxt.metadata import CHANNELS, TILE_COLUMNS, TILE_ROWS, Layout
from kissgs.sogxt.names import CHECKSUM, JSON_NAME, YAML_NAME

MAX_METADATA_BYTES = 1 << 20
"""The three metadata files have about 4 kB each."""

MAX_YAML_DEPTH = 50
"""Ours is nested 6 deep. libyaml composes by recursion, which no limit of Python's stops before the stack ends."""

MAX_YAML_ALIASES = 20
"""Dumpers write one where two fields share a list; a few thousand would take hours to follow."""

ABSENT = object()
"""Stands for a checksum that nobody wrote: other encoders, and kissgs before it had one."""

MAX_SIGNED_LOG = 88.7
"""e to more than this is beyond float32."""


def read_layout(source: Source) -> Layout:
    """Read and check the metadata of a container.

    Raises:
        InvalidContainerError: there is none, or it says something impossible.
        UnsupportedError: its images are not WebP.
    """
    names = source.names()
    name = next((name for name in (YAML_NAME, JSON_NAME) if name in names), None)
    if name is None:
        raise InvalidContainerError(f"this is no SOG-XT container: it has neither {YAML_NAME} nor {JSON_NAME}")
    read = _from_yaml if name == YAML_NAME else _from_json
    raw = read(source.read(name, MAX_METADATA_BYTES))
    checksum = raw.pop(CHECKSUM)
    try:
        # Numbers as text occur in YAML, whose dumpers write some so; in JSON they are refused, as browsers do.
        layout = Layout.model_validate(raw, strict=name == JSON_NAME)
    except ValidationError as error:
        raise InvalidContainerError(f"{name}: {_first_problem(error)}") from error
    _check_ranges(layout, name)
    if checksum is not ABSENT and checksum != layout.checksum:
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
    made = document.get("kissgs")
    return {
        "count": made.get("count") if isinstance(made, dict) else None,
        "grid_side": sides.get("grid_side"),
        "codebook_side": sides.get("f_rest_centroids_side"),
        "ranges": ranges,
        "provenance": made,
        CHECKSUM: document.get(CHECKSUM, ABSENT),
    }


def _check_nesting(events: Iterable[yaml.Event]) -> None:
    """Raise YAMLError for documents that a few bytes make deep, or, by aliases and merge keys, endless."""
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
    """Field and range of one op, as often as it gives one (the last counts); nothing for ops on several fields."""
    fields = op["input_fields"]
    if len(fields) != 1:
        return
    for transform in op.get("transforms", ()):
        quantize = transform.get("simple_quantize")
        if quantize and "min_values" in quantize:
            yield fields[0], (_flat(quantize["min_values"]), _flat(quantize["max_values"]))


def _from_json(data: bytes) -> dict[str, Any]:
    """The fields of :class:`Layout` out of ``meta.json``: what ``web_decoder/scene.js`` takes, and nothing else."""
    try:
        # Every number becomes a float64, as in browsers; NaN and Infinity are not JSON.
        document = json.loads(data.decode("utf-8-sig"), parse_int=float, parse_constant=_refuse_constant)
    except (ValueError, RecursionError) as error:
        raise InvalidContainerError(f"{JSON_NAME} is not readable JSON") from error
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
            CHECKSUM: document.get(CHECKSUM, ABSENT),
        }
        if "kissgs" in document:
            made = document["kissgs"]
            degree, checksums = _whole(made["sh_degree"]), made.get("crc32", {})
            shared = {"count": count, "source_count": count}
            raw["provenance"] = {"version": made["version"], "sh_degree": degree, **shared}
            raw["crc32"] = {name: _whole(value) for name, value in checksums.items()}
        return raw
    except (KeyError, TypeError, AttributeError, IndexError) as error:
        raise InvalidContainerError(f"{JSON_NAME} lacks something that a SOG-XT container has: {error}") from error


def _refuse_constant(name: str) -> NoReturn:
    raise ValueError(f"{name} is not JSON")


def _whole(value: Any) -> Any:  # noqa: ANN401
    """A whole number as int; anything else as it is, for the check of types to refuse."""
    return int(value) if isinstance(value, float) and value.is_integer() else value


def _check_dialect(document: Mapping[str, Any]) -> None:
    """Refuse what would decode without complaint, and wrong."""
    quats, rest, files = document["quats"], document["shN"], document["mask"]["files"]
    for name, found, known in (
        ("format", document.get("format", "sog-xt"), "sog-xt"),
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
        raise TypeError("mask.files is no list")
    _require_webp(files[0].rsplit(".", 1)[-1])


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
    """As browsers do: a number, or the first of a list of another length, stands for all channels."""
    numbers = values if isinstance(values, list) else [values]
    return numbers if len(numbers) == channels else numbers[:1] * channels


def _first_problem(error: ValidationError) -> str:
    problem = error.errors()[0]
    return f"{'.'.join(map(str, problem['loc']))}: {problem['msg'].lower()}"
