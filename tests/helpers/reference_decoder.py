"""Naive decoders from docs/reference/format.md alone: as the paper's, and as viewers, which read ``meta.json`` only."""

from __future__ import annotations

import io
import json
import zipfile
from collections.abc import Mapping

import numpy as np
import yaml
from PIL import Image

F = np.float32

COLUMNS = (
    *("x", "y", "z", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2"),
    *(f"f_rest_{i}" for i in range(45)),
    *("opacity", "scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3"),
)


def as_files(source):
    """Return files by name, from a dict or the bytes of a zip."""
    if isinstance(source, Mapping):
        return dict(source)
    with zipfile.ZipFile(io.BytesIO(source)) as archive:
        return {name: archive.read(name) for name in archive.namelist()}


def pixels(files, name):
    """Return the pixels of an image as integers, from Pillow."""
    return np.asarray(Image.open(io.BytesIO(files[name]))).astype(np.int64)


def levels(files, name, channels):
    """Return an image as rows of pixels, and check its number of channels."""
    image = pixels(files, f"{name}.webp")
    assert image.ndim == 3
    assert image.shape[2] == channels, f"{name} has {image.shape[2]} channels"
    return image.reshape(-1, channels)


def stretched(raw):
    """Scale an array from its minimum and maximum to 0 and 1."""
    raw = raw.astype(F)
    low, high = raw.min(), raw.max()
    return (raw - low) / (high - low + F(1e-8))


def ranges_of(document):
    """Return (min_values, max_values) by field; later ranges replace earlier ones."""
    found = {}
    for op in document["ops"]:
        if len(op["input_fields"]) != 1:
            continue
        for transform in op.get("transforms", []):
            quantize = transform.get("simple_quantize")
            if quantize and "min_values" in quantize:
                found[op["input_fields"][0]] = quantize["min_values"], quantize["max_values"]
    return found


def between(raw, limits, channels):
    """Convert levels to values in a range; ``channels`` None stands for a scalar range."""
    low, high = (np.asarray(limit, dtype=F).reshape(channels) if channels else F(float(limit)) for limit in limits)
    return stretched(raw) * (high - low) + low


def untiled(image, side):
    """Convert 15 tiles of S x S pixels in 3 rows to ``(S*S, 45)``, with index channel * 15 + coefficient."""
    assert image.shape == (3 * side, 5 * side, 3)
    entries = np.empty((side * side, 45), dtype=image.dtype)
    for row in range(3):
        for column in range(5):
            tile = image[row * side : (row + 1) * side, column * side : (column + 1) * side]
            for channel in range(3):
                entries[:, channel * 15 + row * 5 + column] = tile[:, :, channel].reshape(-1)
    return entries


def decode(source):
    """Return the 62 float32 columns, by name, of the .ply that the paper's decoder writes."""
    files = as_files(source)
    document = yaml.safe_load(files["container_meta.yaml"].decode("ascii"))
    grid, side = int(document["meta"]["grid_side"]), int(document["meta"]["f_rest_centroids_side"])
    ranges = ranges_of(document)

    active = pixels(files, "active_mask.webp").reshape(grid * grid, -1)[:, 0] > 0
    positions = levels(files, "means_bytes_0", 3) + 256 * levels(files, "means_bytes_1", 3)
    logs = between(positions, ranges["means"], None)
    means = np.sign(logs) * np.expm1(np.abs(logs))

    logits = between(pixels(files, "opacities.webp").reshape(grid * grid, -1)[:, 0], ranges["opacities"], None)
    opacities = F(1) / (F(1) + np.exp(-logits))
    scales = np.exp(between(levels(files, "scales", 3), ranges["scales"], 3))
    quats = between(levels(files, "quaternions", 4), ranges["quaternions"], 4)
    f_dc = between(levels(files, "f_dc", 3), ranges["f_dc"], 3)

    tiles = pixels(files, "f_rest_centroids.webp")
    entries = between(untiled(stretched(tiles), side), ranges["f_rest_centroids"], 45)
    labels = levels(files, "f_rest_labels", 3)
    f_rest = entries[labels[:, 1] * side + labels[:, 0]]

    table = [means, np.zeros_like(means), f_dc, f_rest, (np.log(opacities) - np.log1p(-opacities))[:, None]]
    table = np.concatenate([*table, np.log(scales), quats], axis=1)[active]
    assert table.dtype == F
    assert len(active) == grid * grid
    return dict(zip(COLUMNS, table.T, strict=True))


def as_columns(splats):
    """Return the columns of a kissgs scene, in float32; SH of missing bands are zero."""
    count, coefficients = len(splats), splats.shN.shape[1]
    rest = np.zeros((count, 3, 15), dtype=F)
    rest[:, :, :coefficients] = splats.shN.transpose(0, 2, 1)
    parts = [splats.means, np.zeros((count, 3), F), splats.sh0, rest.reshape(count, 45), splats.opacities[:, None]]
    return dict(zip(COLUMNS, np.concatenate([*parts, splats.scales, splats.quats], axis=1).T, strict=True))


def range_magnitude(ranges, column):
    """Return the largest magnitude in the range of a column's channel."""
    name, _, index = column.rpartition("_")
    field, index = {
        "f_dc": ("f_dc", index),
        "f_rest": ("f_rest_centroids", index),
        "scale": ("scales", index),
        "rot": ("quaternions", index),
        "": ("opacities" if column == "opacity" else "means", 0),
    }[name]
    return max(abs(float(np.ravel(limit)[int(index)])) for limit in ranges[field])


def assert_equal_scenes(ours, reference, files):
    """Assert that a kissgs scene equals the oracle's columns up to float32 rounding, 5e-7 of a channel's range.

    Activating opacities costs the oracle an ulp, which is 1.2e-7 * e^logit of the logit.
    """
    ranges = ranges_of(yaml.safe_load(files["container_meta.yaml"]))
    mine = as_columns(ours)
    for name in COLUMNS:
        found, wanted = mine[name].astype(np.float64), reference[name].astype(np.float64)
        assert found.shape == wanted.shape
        assert np.isfinite(wanted).all(), name
        if name in ("nx", "ny", "nz"):
            continue
        tolerance = 5e-7 * max(range_magnitude(ranges, name), 1)
        if name in "xyz":
            tolerance *= 1 + np.abs(found)
        if name == "opacity":
            tolerance += 1.2e-7 * np.exp(np.maximum(found, 0))
        assert (np.abs(found - wanted) <= tolerance).all(), f"{name}: off by up to {np.abs(found - wanted).max()}"


def check_browser(files):
    """Return ``meta.json`` after the checks of other tools."""
    meta = json.loads(files["meta.json"])
    assert (meta["version"], meta["format"], meta["profile"]) == (3, "sog-xt", "SOG-XT")
    grid = meta["gridSide"]
    names = [*meta["mask"]["files"], *meta["means"]["files"]]
    names += [meta[key]["files"][0] for key in ("opacities", "scales", "quats", "sh0")] + [meta["shN"]["files"][1]]
    for name in names:
        assert Image.open(io.BytesIO(files[name])).size == (grid, grid), name
    assert meta["quats"]["encoding"] == "direct"
    for key in ("opacities", "scales", "quats", "sh0", "shN"):
        assert meta[key]["normalize"] == "observed-minmax"
    rest = meta["shN"]
    assert (rest["layout"], rest["coeffs"], rest["tileRows"], rest["tileCols"]) == ("uv-codebook", 15, 3, 5)
    side = rest["centroidSide"]
    assert Image.open(io.BytesIO(files[rest["files"][0]])).size == (5 * side, 3 * side)
    labels = pixels(files, rest["files"][1])
    assert labels[:, :, 0].max() < side
    assert labels[:, :, 1].max() < side
    assert int((pixels(files, meta["mask"]["files"][0])[:, :, 0] > 0).sum()) == meta["count"]
    return meta


def decode_browser(source, *, means_top=None):
    """Decode as viewers do, in float64, with normalised quaternions; ``means_top`` divides positions by that level."""
    files = as_files(source)
    meta = check_browser(files)
    active = pixels(files, meta["mask"]["files"][0])[:, :, 0].reshape(-1) > 0

    def mixed(raw, low, high, top=None):
        raw = raw.astype(np.float64)
        first, last = (raw.min(), raw.max()) if top is None else (0, top)
        part = (raw - first) / (last - first + 1e-8)
        return np.asarray(low) * (1 - part) + np.asarray(high) * part

    def plane(key, channels):
        part = meta[key]
        return mixed(pixels(files, part["files"][0]).reshape(-1, channels), part["mins"], part["maxs"])

    low_bytes, high_bytes = (pixels(files, name).reshape(-1, 3) for name in meta["means"]["files"])
    logs = mixed(low_bytes + 256 * high_bytes, meta["means"]["mins"], meta["means"]["maxs"], means_top)
    grey = pixels(files, meta["opacities"]["files"][0])[:, :, 0].reshape(-1)
    quats = plane("quats", 4)
    rest, side = meta["shN"], meta["shN"]["centroidSide"]
    entries = untiled(pixels(files, rest["files"][0]), side)
    labels = pixels(files, rest["files"][1]).reshape(-1, 3)
    shown = mixed(entries, rest["centroidsMins"], rest["centroidsMaxs"])[labels[:, 1] * side + labels[:, 0]]
    scene = {
        "means": np.sign(logs) * np.expm1(np.abs(logs)),
        "quats": quats / np.linalg.norm(quats, axis=1, keepdims=True),
        "scales": plane("scales", 3),
        "opacities": mixed(grey, meta["opacities"]["mins"], meta["opacities"]["maxs"]),
        "sh0": plane("sh0", 3),
        "shN": shown.reshape(-1, 3, 15).transpose(0, 2, 1),
    }
    return {name: values[active] for name, values in scene.items()}
