"""Streamed scenes in the preview's viewer, in Chromium. Oracle: ``kissgs.render`` of the rows that belong together."""

import json
from dataclasses import replace

import numpy as np
import pytest
from helpers.streamed_scenes import FAST, write_small
from helpers.viewers import image_of, opened, pinhole, psnr, scattered, seen_from

import kissgs
from kissgs.core.splats import concatenate
from kissgs.rendering.camera import look_at

CAMERA = seen_from((1.2, -1.2, -4.2), (300, 200))
MANY = 100_000


@pytest.fixture(scope="module")
def viewer(browser):
    with opened("streaming", browser) as (viewer, site):
        yield viewer.page, site


@pytest.fixture(scope="module")
def city(viewer, tmp_path_factory):
    """A folder with levels of 1,200, 600, 300 and 150 Gaussians in 16 leaves, and its address."""
    folder = tmp_path_factory.mktemp("streamed")
    write_small(scattered(1200, 2), folder / "city" / "lod-meta.json", chunk=400, leaf=80, coarsest=200)
    files = {str(path.relative_to(folder)): path.read_bytes() for path in (folder / "city").rglob("*.*")}
    return folder / "city", viewer[1].put("streamed", files) + "city/lod-meta.json"


def draw(viewer, camera, **job):
    found = viewer[0].evaluate("job => draw(job)", {"camera": pinhole(camera), **job})
    found["image"] = image_of(found["image"], camera)
    return found


def rendered(splats, camera=CAMERA):
    return np.clip(kissgs.render(splats, camera)[0], 0, 1)


def rows_of(folder, ranges):
    """Return the Gaussians of rows of files."""
    files = {name: kissgs.load(folder / name) for name, _ in ranges}
    return concatenate([files[name].select(slice(at, at + n)) for name, own in ranges for at, n in own])


def leaves_of(folder, manifest="lod-meta.json"):
    """Return bounds and levels of all leaves, as the manifest has them."""
    document = json.loads((folder / manifest).read_bytes())
    found, waiting = [], [document["tree"]]
    while waiting:
        node = waiting.pop()
        waiting += node.get("children", [])
        if "lods" in node:
            lods = {int(level): lod for level, lod in node["lods"].items()}
            found.append((node["bound"], {k: (document["filenames"][v["file"]], v["offset"]) for k, v in lods.items()}))
    return found


def levels_drawn(folder, ranges):
    """Return the level of each leaf; each must be drawn once, and nothing else."""
    drawn = [(name, at) for name, own in ranges for at, _ in own]
    levels = []
    for _, lods in leaves_of(folder):
        (level,) = [level for level, place in lods.items() if place in drawn]
        levels.append(level)
    assert len(drawn) == len(levels)
    return levels


def test_from_the_coarsest_level_to_the_finest(viewer, city):
    folder, url = city
    asked = viewer[1].asked
    asked.clear()
    first = draw(viewer, CAMERA, url=url, budget=MANY, coarse=True)
    assert set(levels_drawn(folder, first["ranges"])) == {3}
    to_coarse = psnr(first["image"], rendered(kissgs.load(folder, level=3)))
    sizes = {f"/streamed/city/{path.relative_to(folder)}": path.stat().st_size for path in folder.rglob("*.*")}
    needed = [path for path in sizes if "/3_0/" in path or "lod-meta" in path]
    assert first["bytes"] == sum(sizes[path] for path in needed)

    last = draw(viewer, CAMERA)
    assert set(levels_drawn(folder, last["ranges"])) == {0}
    to_finest = psnr(last["image"], rendered(kissgs.load(folder)))
    assert min(to_coarse, to_finest) > 38
    assert psnr(last["image"], first["image"]) < 30
    assert last["received"] == sum(sizes[path] for path in sizes if path in asked)
    assert last["problems"] == []


def test_a_small_budget_goes_to_what_is_near(viewer, city):
    """First from afar; then from near one leaf, whose finest file is loaded only then."""
    folder, url = city
    asked = viewer[1].asked
    asked.clear()
    far = draw(viewer, seen_from((1.2, -1.2, -80), (300, 200)), url=url, budget=650)
    assert 0 not in levels_drawn(folder, far["ranges"])
    assert not any("/0_" in path for path in asked)

    leaves = leaves_of(folder)
    nearest = 5
    low, high = (np.array(leaves[nearest][0][end]) for end in ("min", "max"))
    middle, size = (low + high) / 2, np.linalg.norm(high - low)
    out = middle / np.linalg.norm(middle)
    close = look_at(middle + 0.8 * size * out, middle, np.array([0, -1.0, 0.1]), fov=0.9, width=300, height=200)
    near = draw(viewer, close)
    levels = levels_drawn(folder, near["ranges"])
    assert levels[nearest] == 0
    assert min(levels[:nearest] + levels[nearest + 1 :]) > 0
    assert f"/streamed/city/{leaves[nearest][1][0][0]}" in asked
    rows = rows_of(folder, near["ranges"])
    assert len(rows) == sum(level["gaussians"] for level in near["levels"]) <= 650
    reached = psnr(near["image"], rendered(rows, close))
    assert reached > 36


def test_sogxt_containers_and_an_environment(viewer, tmp_path):
    """A manifest of zips, as one for this project's own containers has them: two leaves, two levels, a sky."""
    scene = scattered(900, 1)
    left = scene.means[:, 0] < 0
    half = np.arange(len(scene)) % 2 == 0
    sky = scattered(150, 0)
    sky = replace(sky, means=3 * sky.means)
    parts = {f"{level}_{side}.zip": scene.select(np.flatnonzero((left == (side == 0)) & (half | (level == 0))))
             for level in (0, 1) for side in (0, 1)}  # fmt: skip
    parts["sky.zip"] = sky
    for name, part in parts.items():
        kissgs.compress(part, tmp_path / name, settings=FAST)
    names = [name for name in parts if name != "sky.zip"]
    stored = {name: kissgs.decompress(tmp_path / name) for name in parts}

    def leaf(side):
        means = parts[f"0_{side}.zip"].means
        lods = {
            str(level): {"file": names.index(name), "offset": 0, "count": len(stored[name])}
            for level, name in enumerate((f"0_{side}.zip", f"1_{side}.zip"))
        }
        bound = {"min": means.min(axis=0).tolist(), "max": means.max(axis=0).tolist()}
        return {"bound": bound, "lods": lods, "errors": [0, 0.1]}

    manifest = {"lodLevels": 2, "filenames": names, "environment": "sky.zip"}
    manifest["tree"] = {"bound": leaf(0)["bound"], "children": [leaf(0), leaf(1)]}
    files = {name: (tmp_path / name).read_bytes() for name in parts}
    url = viewer[1].put("xt", {**files, "levels.json": json.dumps(manifest).encode()}) + "levels.json"
    first = draw(viewer, CAMERA, url=url, budget=MANY, coarse=True)
    last = draw(viewer, CAMERA)
    for found, level in ((first, 1), (last, 0)):
        wanted = concatenate([padded(stored[f"{level}_{side}.zip"]) for side in (0, 1)] + [padded(stored["sky.zip"])])
        assert psnr(found["image"], rendered(wanted)) > 38
        assert sorted(name for name, _ in found["ranges"]) == sorted([f"{level}_0.zip", f"{level}_1.zip", "sky.zip"])
    assert psnr(first["image"], last["image"]) < 30


def padded(splats):
    """Return the scene with zeros for the spherical harmonics up to degree 1."""
    return replace(splats, shN=np.pad(splats.shN, ((0, 0), (0, 3 - splats.shN.shape[1]), (0, 0))))
