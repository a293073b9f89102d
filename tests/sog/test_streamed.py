"""Streamed SOG of others. Oracle: splat-transform, and a reader of real data in NumPy."""

import json

import numpy as np
import pytest
from helpers.format_scenes import assert_alike, made_scene
from helpers.reference_sog import streamed_files, write_folder
from helpers.splat_transform import convert, needs_splat_transform
from PIL import Image

from kissgs.core.splats import ATTRIBUTES
from kissgs.io.ply import read_ply, write_ply
from kissgs.sog.streamed import STREAMED


@needs_splat_transform
def test_splat_transform_reads_the_reference_files_as_we_do(tmp_path):
    """Level by level; that tool wants the environment to be selected as level -1."""
    scenes = [[made_scene(65, 1), made_scene(40, 1)], [made_scene(20, 1)]]
    folder = write_folder(streamed_files(scenes), tmp_path / "folder")
    for level in (0, 1):
        target = convert(folder / "lod-meta.json", tmp_path / f"{level}.ply", "-L", str(level))
        assert_alike(STREAMED.decode(folder, level=level), read_ply(target), rtol=1e-6, atol=1e-6)


@needs_splat_transform
@pytest.mark.parametrize("degree", [0, 1, 2, 3])
@pytest.mark.parametrize("count", [1, 65])
@pytest.mark.quick(2)
def test_splat_transform_writes_what_we_read(count, degree, tmp_path):
    with (tmp_path / "a.ply").open("wb") as file:
        write_ply(file, made_scene(count, degree))
    packed = convert(tmp_path / "a.ply", tmp_path / "lod/lod-meta.json", "-i", "2")
    theirs = read_ply(convert(packed, tmp_path / "b.ply"))
    assert_alike(STREAMED.decode(packed.parent), theirs, rtol=1e-6, atol=1e-6)


def real_rows(folder):
    """Decode a container in a few lines of float64 NumPy; return a dictionary of columns."""
    meta = json.loads((folder / "meta.json").read_text())

    def pixels(name, mode):
        with Image.open(folder / name) as image:
            return np.asarray(image.convert(mode)).reshape(-1, len(mode))

    count, means, rest = meta["count"], meta["means"], meta["shN"]
    low, high = (pixels(name, "RGB")[:count].astype(int) for name in means["files"])
    mins, maxs = np.array(means["mins"]), np.array(means["maxs"])
    logs = mins + (maxs - mins) * (low + 256 * high) / 65535
    quats = pixels("quats.webp", "RGBA")[:count]
    small = (quats[:, :3] / 255 - 0.5) * np.sqrt(2)
    rotation = np.zeros((count, 4))
    for tag in range(4):
        rows = quats[:, 3] == 252 + tag
        rotation[rows] = np.insert(small[rows], tag, np.sqrt(1 - (small[rows] ** 2).sum(axis=1)), axis=1)
    colors = pixels("sh0.webp", "RGBA")[:count]
    labels = pixels("shN_labels.webp", "RGB")[:count].astype(int)
    k = {1: 3, 2: 8, 3: 15}[rest["bands"]]
    codebook = np.array(rest["codebook"])[pixels("shN_centroids.webp", "RGB")].reshape(-1, k, 3)
    alphas = np.clip(colors[:, 3] / 255, 1e-6, 1 - 1e-6)
    return {
        "means": np.sign(logs) * np.expm1(np.abs(logs)),
        "quats": rotation,
        "scales": np.array(meta["scales"]["codebook"])[pixels("scales.webp", "RGB")[:count]],
        "opacities": np.log(alphas / (1 - alphas)),
        "sh0": np.array(meta["sh0"]["codebook"])[colors[:, :3]],
        "shN": codebook[labels[:, 0] + 256 * labels[:, 1]],
    }


@pytest.mark.parametrize(("level", "count"), [(3, 26_895), (2, 92_802)])
def test_real_data(level, count, shared_data):
    folder = shared_data / "flowers"
    found = STREAMED.decode(folder, level=level)
    assert len(found) == count
    wanted = real_rows(folder / f"{level}_0")
    for name in ATTRIBUTES:
        np.testing.assert_allclose(getattr(found, name), wanted[name], rtol=1e-6, atol=1e-6, err_msg=name)
