"""Oracle: the chunks decoded one by one, splat-transform's files, and a reader of real data in NumPy."""

import json

import numpy as np
import pytest
from helpers.format_scenes import assert_alike, made_scene
from helpers.reference_sog import sog_files, streamed_files, write_folder, zip_of
from helpers.splat_transform import convert, needs_splat_transform
from PIL import Image

from kissgs.core.errors import InvalidContainerError, KissgsError, UnsupportedError
from kissgs.core.splats import ATTRIBUTES
from kissgs.io.ply import read_ply, write_ply
from kissgs.sog import streamed
from kissgs.sog.decode import decode

LEVELS = [[made_scene(65, 2), made_scene(40, 1)], [made_scene(20, 1)], [made_scene(3, 0)]]
ENVIRONMENT = made_scene(7, 1)
FILES = streamed_files(LEVELS, environment=ENVIRONMENT)


def joined(scenes):
    """Return the decoded chunks one after another, lower degrees filled with zeros."""
    found = [decode(sog_files(scene)) for scene in scenes]
    most = max(s.shN.shape[1] for s in found)
    arrays = {name: np.concatenate([getattr(s, name) for s in found]) for name in ATTRIBUTES if name != "shN"}
    arrays["shN"] = np.concatenate([np.pad(s.shN, ((0, 0), (0, most - s.shN.shape[1]), (0, 0))) for s in found])
    return arrays


@pytest.mark.parametrize("level", [0, 1, 2])
def test_every_level_with_the_environment(level):
    found = streamed.decode(FILES, level=level)
    for name, wanted in joined([*LEVELS[level], ENVIRONMENT]).items():
        np.testing.assert_array_equal(getattr(found, name), wanted)


def test_folders_and_zips(tmp_path):
    wanted = streamed.decode(FILES)
    packed = tmp_path / "a.zip"
    packed.write_bytes(zip_of(FILES))
    for source in (write_folder(FILES, tmp_path / "folder"), packed, zip_of(FILES, folder="a/b/")):
        np.testing.assert_array_equal(streamed.decode(source).means, wanted.means)


def edited(change, files=FILES):
    meta = json.loads(files["lod-meta.json"])
    change(meta)
    return {**files, "lod-meta.json": json.dumps(meta).encode()}


def leaf(meta, number=0, level="0"):
    return meta["tree"]["children"][number]["lods"][level]


def test_rows_that_no_leaf_names_are_left_out():
    whole = streamed.decode(FILES)
    found = streamed.decode(edited(lambda meta: leaf(meta, 1).update(offset=5, count=10)))
    kept = np.r_[5:15, 32:112]
    np.testing.assert_array_equal(found.means, whole.means[kept])
    np.testing.assert_array_equal(found.shN, whole.shN[kept])


def test_old_files_without_a_version():
    found = streamed.decode(edited(lambda meta: (meta.pop("version"), meta.update(environment=None))))
    assert len(found) == 105


CHANGES = {
    "there is no level 3; this scene has levels 0 (the finest) to 2": None,
    "lod-meta.json is of version '2'; version 1 is read": lambda m: m.update(version=2),
    "lodLevels is not a whole number from 1 to 64": lambda m: m.update(lodLevels=0),
    "it lacks the list 'filenames'": lambda m: m.pop("filenames"),
    "it names a file that is not below its folder": lambda m: m["filenames"].append("../x/meta.json"),
    "names files on the web": lambda m: m.update(environment="https://example.org/meta.json"),
    "two leaves share rows of 0_0/meta.json": lambda m: leaf(m).update(offset=10),
    "a leaf names rows up to 1,000 of 0_0/meta.json, which has 65": lambda m: leaf(m).update(count=968),
    "a leaf has a level that is not 0 to 2": lambda m: m["tree"]["children"][0]["lods"].update({"3": {}}),
    "a leaf does not name a file, an offset and a count": lambda m: leaf(m).update(file=99),
    "its tree has a node that is no JSON object": lambda m: m["tree"]["children"].append(1),
    "levels or children are of the wrong kind": lambda m: m["tree"]["children"].append({"lods": []}),
    "the container has no file 'x/meta.json'": lambda m: m["filenames"].__setitem__(0, "x/meta.json"),
}


@pytest.mark.parametrize(("message", "change"), list(CHANGES.items()), ids=list(CHANGES))
def test_damaged_trees(message, change):
    with pytest.raises(KissgsError) as error:
        streamed.decode(edited(change) if change else FILES, level=0 if change else 3)
    assert message in str(error.value)
    assert "\n" not in str(error.value)


def test_limits_and_depth():
    with pytest.raises(UnsupportedError, match=r"level 0 has 112 Gaussians; the limit is 111"):
        streamed.decode(FILES, max_gaussians=111)
    deep = b'{"lodLevels": 1, "filenames": [], "tree": ' + b'{"children": [' * 100_000
    with pytest.raises(InvalidContainerError, match=r"lod-meta\.json is not readable JSON"):
        streamed.decode({"lod-meta.json": deep})


@needs_splat_transform
def test_splat_transform_reads_the_reference_files_as_we_do(tmp_path):
    """Level by level; that tool wants the environment to be selected as level -1."""
    scenes = [[made_scene(65, 1), made_scene(40, 1)], [made_scene(20, 1)]]
    folder = write_folder(streamed_files(scenes), tmp_path / "folder")
    for level in (0, 1):
        target = convert(folder / "lod-meta.json", tmp_path / f"{level}.ply", "-L", str(level))
        assert_alike(streamed.decode(folder, level=level), read_ply(target), rtol=1e-6, atol=1e-6)


@needs_splat_transform
@pytest.mark.parametrize("degree", [0, 1, 2, 3])
@pytest.mark.parametrize("count", [1, 65])
@pytest.mark.quick(2)
def test_splat_transform_writes_what_we_read(count, degree, tmp_path):
    with (tmp_path / "a.ply").open("wb") as file:
        write_ply(file, made_scene(count, degree))
    packed = convert(tmp_path / "a.ply", tmp_path / "lod/lod-meta.json", "-i", "2")
    theirs = read_ply(convert(packed, tmp_path / "b.ply"))
    assert_alike(streamed.decode(packed.parent), theirs, rtol=1e-6, atol=1e-6)


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
    found = streamed.decode(folder, level=level)
    assert len(found) == count
    wanted = real_rows(folder / f"{level}_0")
    for name in ATTRIBUTES:
        np.testing.assert_allclose(getattr(found, name), wanted[name], rtol=1e-6, atol=1e-6, err_msg=name)
