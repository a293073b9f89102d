"""Metadata of a SOG container, ``meta.json``, of versions 1 and 2, checked before any image is opened."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from kissgs.core.array_types import Float32, Float64
from kissgs.core.errors import InvalidContainerError, UnsupportedError
from kissgs.core.positions import MAX_SIGNED_LOG, WORLD, Origin, read_origin, signed_exp
from kissgs.core.splats import SH_REST_COUNTS
from kissgs.io.containers import MAX_METADATA_BYTES, META_NAME, Source, is_antialiased, is_file_name, stated_text
from kissgs.io.conventions import OPACITY_OF_BYTE
from kissgs.io.files import is_number, listed, parse_json, whole_number

MAX_SH_ENTRIES = 1 << 16  # largest number of entries of the SH codebook: labels have two bytes
MAX_FLOAT32 = 3e38  # bound of numbers, which float32 must hold

_LEVELS = 256

_MODELS = ("antialiased", "3dgs", "classic", "default")
"""Variants of the renderer that draw 3D Gaussians, all but the first without compensation; None stands for them too."""

_KNOWN = {"version", "count", "asset", "model", "means", "scales", "quats", "sh0", "shN", "antialias", "kissgs"}


@dataclass(frozen=True, slots=True)
class Rest:
    """View-dependent colour: the codebook, and the files of its entries and of each Gaussian's entry."""

    entries: int | None  # number of entries; None: as many as the image has (version 1)
    coefficients: int  # 3, 8 or 15
    table: Float32[np.ndarray, " 256"]
    centroids: str
    labels: str


@dataclass(frozen=True, slots=True)
class SogLayout:
    """Contents of ``meta.json``. Tables have one row per channel; NaN stands for a level without a value. The ends of
    the positions' range are signed logarithms; scales, colours and opacities are as in :class:`Splats`."""

    version: int
    count: int
    low: Float64[np.ndarray, " 3"]
    high: Float64[np.ndarray, " 3"]
    scales: Float32[np.ndarray, "3 256"]
    sh0: Float32[np.ndarray, "3 256"]
    opacities: Float32[np.ndarray, " 256"]
    files: dict[str, str]  # names of the images means_low, means_high, scales, quats, sh0
    rest: Rest | None
    model: str | None  # variant of the renderer that the scene was made for, such as "antialiased"
    generator: str | None
    origin: Origin
    unknown: tuple[str, ...]  # keys of the file that are not read

    @property
    def notes(self) -> tuple[str, ...]:
        """Phrases for what reading the container leaves out, one phrase each."""
        return (f"left out: {listed(self.unknown)}",) if self.unknown else ()

    @property
    def images(self) -> list[str]:
        """Names of the images."""
        return [*self.files.values(), *([self.rest.centroids, self.rest.labels] if self.rest else [])]

    @property
    def antialiased(self) -> bool:
        """Whether the scene was trained with antialiasing."""
        return is_antialiased(self.model)

    @property
    def sh_degree(self) -> int:
        """SH degree, 0 to 3."""
        return SH_REST_COUNTS.index(self.rest.coefficients) if self.rest else 0

    def value_ranges(self) -> dict[str, tuple[float, float]]:
        """Return the values of the lowest and the highest level of every attribute."""
        tables = {
            "means": signed_exp(np.concatenate([self.low, self.high])),
            "scales": self.scales,
            "opacities": self.opacities,
            "sh0": self.sh0,
            **({"shN": self.rest.table} if self.rest else {}),
        }
        finite = {name: table[np.isfinite(table)] for name, table in tables.items()}
        return {name: (float(values.min()), float(values.max())) for name, values in finite.items() if values.size}


def read_layout(source: Source, name: str = META_NAME) -> SogLayout:
    """Read and check the metadata of a container."""
    document = parse_json(source.read(name, MAX_METADATA_BYTES), name)
    if not isinstance(document, dict):
        raise InvalidContainerError(f"{name} is not the metadata of a SOG container: it is no JSON object")
    version = document.get("version", 1)
    if version not in (1, 2) or isinstance(version, bool):
        raise UnsupportedError(f"{name} is of version {str(version)[:40]!r}; SOG versions 1 and 2 are read")
    try:
        return _read(document, int(version))
    except _MetadataError as error:
        raise InvalidContainerError(f"{name}: {error}") from error


class _MetadataError(Exception):
    """Problem at a place in the document, as the end of a sentence."""


def _read(document: dict[str, Any], version: int) -> SogLayout:
    first = version == 1  # whose levels are evenly spaced, also those of opacities, the fourth channel of colours
    table = _even_table if first else _codebook
    colors = table(document, "sh0", 4 if first else 3)
    asset = document.get("asset")
    low, high = (_numbers(_part(document, "means"), key, "means.", 3) for key in ("mins", "maxs"))
    if max(np.abs(low).max(), np.abs(high).max()) > MAX_SIGNED_LOG:
        raise _MetadataError(f"the range of means ends beyond ±{MAX_SIGNED_LOG}, which float32 cannot hold")
    return SogLayout(
        version=version,
        count=_first_count(document) if first else _whole(document, "count", "", 0, 1 << 32),
        low=low,
        high=high,
        scales=table(document, "scales", 3),
        sh0=colors[:3],
        opacities=np.clip(colors[3], OPACITY_OF_BYTE[0], OPACITY_OF_BYTE[-1]) if first else OPACITY_OF_BYTE,
        files=_files(document),
        rest=_rest(document, first) if document.get("shN") is not None else None,
        model=None if first else _model(document),
        generator=stated_text(asset.get("generator")) if isinstance(asset, dict) and not first else None,
        origin=WORLD if first else read_origin(document, META_NAME),
        unknown=tuple(key for key in document if key not in _KNOWN),
    )


def _model(document: dict[str, Any]) -> str | None:
    """Return the variant of the renderer; one that does not draw 3D Gaussians is refused."""
    asset = document.get("asset")
    model = stated_text(document.get("model")) or (stated_text(asset.get("model")) if isinstance(asset, dict) else None)
    if model is None and document.get("antialias") is True:  # as the format's specification spells it
        return "antialiased"
    if model and model.lower() not in _MODELS:
        raise UnsupportedError(
            f"{META_NAME} names the model {model[:40]!r}, which is not supported; export 3D Gaussians (known are "
            f"{', '.join(_MODELS)})"
        )
    return model


def _first_count(document: dict[str, Any]) -> int:
    """Return the number of Gaussians of version 1."""
    if _part(document, "quats").get("encoding", "quaternion_packed") != "quaternion_packed":
        found = str(document["quats"]["encoding"])[:40]
        raise _MetadataError(f"quats.encoding is {found!r}; only 'quaternion_packed' is read")
    shape = _part(document, "means").get("shape")
    if not isinstance(shape, list) or not shape:
        raise _MetadataError("means.shape does not give the number of Gaussians; export the scene again")
    return _whole({"count": shape[0]}, "count", "means.shape: ", 0, 1 << 32)


def _rest(document: dict[str, Any], first: bool) -> Rest:
    rest = _part(document, "shN")
    centroids, labels = _names(rest, "shN", 2)
    if not first:
        coefficients = SH_REST_COUNTS[_whole(rest, "bands", "shN.", 1, 3)]
        entries = _whole(rest, "count", "shN.", 1, MAX_SH_ENTRIES)
        return Rest(entries, coefficients, _codebook(document, "shN", 1)[0], centroids, labels)
    shape = rest.get("shape")
    width = shape[1] if isinstance(shape, list) and len(shape) == 2 else None
    if width not in (9, 24, 45) or isinstance(width, bool):
        raise _MetadataError("shN.shape does not have 9, 24 or 45 values per Gaussian; export the scene again")
    return Rest(None, int(width) // 3, _even_table(document, "shN", 1)[0], centroids, labels)


def _part(document: dict[str, Any], key: str) -> dict[str, Any]:
    part = document.get(key)
    if not isinstance(part, dict):
        raise _MetadataError(f"it lacks {key!r}, which a SOG container has; export the scene again")
    return part


def _numbers(part: dict[str, Any], key: str, where: str, count: int) -> Float64[np.ndarray, " count"]:
    values = part.get(key)
    values = values if isinstance(values, list) else [values]
    if len(values) != count or not all(is_number(value, MAX_FLOAT32) for value in values):
        raise _MetadataError(f"{where}{key} is not a list of {count} finite numbers; export the scene again")
    return np.array(values, dtype=np.float64)


def _even_table(document: dict[str, Any], key: str, channels: int) -> Float32[np.ndarray, "channels 256"]:
    """Return the values of version 1: levels evenly spaced between the smallest and the largest."""
    low, high = (_numbers(_part(document, key), end, f"{key}.", channels) for end in ("mins", "maxs"))
    levels = np.arange(_LEVELS) / (_LEVELS - 1)
    return (low[:, None] + (high - low)[:, None] * levels).astype(np.float32)


def _codebook(document: dict[str, Any], key: str, channels: int) -> Float32[np.ndarray, "channels 256"]:
    """Return the codebook of version 2, once per channel. Old encoders wrote null for the first value, which is then
    extrapolated by the mean step; other missing values are refused only if an image uses them."""
    values = _part(document, key).get("codebook")
    if not isinstance(values, list) or not 1 <= len(values) <= _LEVELS:
        raise _MetadataError(f"{key}.codebook is not a list of up to {_LEVELS} numbers; export the scene again")
    if not all(value is None or is_number(value, MAX_FLOAT32) for value in values):
        raise _MetadataError(f"{key}.codebook has something else than finite numbers; export the scene again")
    table = np.full(_LEVELS, np.nan)
    table[: len(values)] = [math.nan if value is None else value for value in values]
    if values[0] is None:
        table[0] = table[1] + (table[1] - table[_LEVELS - 1]) / (_LEVELS - 1)
    return np.tile(table.astype(np.float32), (channels, 1))


def _files(document: dict[str, Any]) -> dict[str, str]:
    low, high = _names(_part(document, "means"), "means", 2)
    files = {"means_low": low, "means_high": high}
    return files | {key: _names(_part(document, key), key, 1)[0] for key in ("scales", "quats", "sh0")}


def _names(part: dict[str, Any], key: str, count: int) -> list[str]:
    names = part.get("files")
    if not isinstance(names, list) or len(names) != count or not all(map(is_file_name, names)):
        raise _MetadataError(f"{key}.files does not name {count} image{'s' * (count > 1)}; export the scene again")
    return names


def _whole(part: dict[str, Any], key: str, where: str, least: int, most: int) -> int:
    value = whole_number(part.get(key), least, most)
    if value is None:
        raise _MetadataError(f"{where}{key} is not a whole number from {least} to {most}; export the scene again")
    return value
