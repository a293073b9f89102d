"""Scenes written by the ending of their name. Reference: the readers of each format, and the scene itself."""

import re
from pathlib import Path

import numpy as np
import pytest
from helpers.format_scenes import made_scene

import kissgs
from kissgs import OutputError, UnsupportedError
from kissgs.formats import OUTPUT_FORMATS, output_format

ENDINGS = [*OUTPUT_FORMATS, "SPZ", "Compressed.PLY"]


@pytest.mark.parametrize("ending", ENDINGS)
def test_every_format_is_read_back_by_its_content_or_ending(ending, tmp_path):
    scene = kissgs.sample_scene(600, sh_degree=2)
    path = tmp_path / f"a.b.{ending}"
    notes = kissgs.save(scene, path)
    found = kissgs.load(path)
    kind = ending.lower()
    assert (len(found), found.sh_degree) == (600, 0 if kind == "splat" else 2)
    assert kissgs.recognise(path) == {"compressed.ply": "ply", "glb": "gltf", "spz.glb": "gltf"}.get(kind, kind)
    assert (notes != ()) == (kind == "splat")
    centre = np.abs(np.sort(found.means, axis=0) - np.sort(scene.means, axis=0)).max()
    assert centre < 0.05
    before = path.read_bytes()
    kissgs.save(scene, path, overwrite=True)
    assert path.read_bytes() == before


def test_a_ply_is_exact_and_others_are_cleaned(tmp_path):
    scene = made_scene(20, 1)
    scene.means[3] = np.nan
    scene.quats[4] = 0
    kissgs.save(scene, tmp_path / "a.ply")
    assert kissgs.read_ply_info(tmp_path / "a.ply").count == 20
    for ending in OUTPUT_FORMATS[1:]:
        path = tmp_path / f"b.{ending}"
        kissgs.save(scene, path)
        assert kissgs.read_scene_info(path).count == 19
    assert np.isnan(scene.means[3]).all(), "the given scene is unchanged"


def test_axes_of_spz(tmp_path):
    scene = kissgs.sample_scene(50, sh_degree=1)
    kissgs.save(scene, tmp_path / "up.spz")
    kissgs.save(scene, tmp_path / "raw.spz", raw_axes=True)
    up, raw = kissgs.load(tmp_path / "up.spz"), kissgs.load(tmp_path / "raw.spz", raw_axes=True)
    np.testing.assert_allclose(up.means, raw.means, atol=1e-3)
    np.testing.assert_allclose(kissgs.load(tmp_path / "raw.spz").means * [1, -1, -1], raw.means)


@pytest.mark.parametrize("name", ["a.zip", "a.sog", "A.ZIP"])
def test_names_of_containers_lead_to_compress(name, tmp_path):
    with pytest.raises(OutputError, match=r"is the name of a container; kissgs compress writes those$"):
        kissgs.save(kissgs.sample_scene(10), tmp_path / name)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("name", ["a", "a.ksplat", "a.gltf", "ply", ".spz.txt", "a.png"])
def test_other_endings_are_refused(name):
    endings = ".ply, .compressed.ply, .spz, .splat, .glb, .spz.glb"
    with pytest.raises(OutputError, match=f"has no ending of a format that is written: {re.escape(endings)}; choose"):
        output_format(Path(name))


@pytest.mark.parametrize("ending", OUTPUT_FORMATS)
def test_a_scene_without_gaussians(ending, tmp_path):
    """Formats that do not allow it refuse it, and leave no file."""
    path = tmp_path / f"a.{ending}"
    if ending in ("spz", "glb", "spz.glb"):
        with pytest.raises(UnsupportedError, match=rf"without Gaussians cannot be written as \.{ending[-3:]}; write"):
            kissgs.save(made_scene(0, 1), path)
        assert list(tmp_path.iterdir()) == []
    else:
        assert kissgs.save(made_scene(0, 0), path) == ()
        assert len(kissgs.load(path)) == 0
