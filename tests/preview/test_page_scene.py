"""Scenes for the page; oracle: ``kissgs.load``."""

import zipfile
from io import BytesIO

import numpy as np
import pytest

import kissgs
from kissgs.core.errors import InvalidContainerError, InvalidSceneError
from kissgs.preview import page_container, page_scene

FAST = kissgs.Settings(preset="fast")


@pytest.fixture(scope="module")
def splats():
    return kissgs.sample_scene(65, sh_degree=2)


@pytest.mark.parametrize("name", ["scene.zip", "scene.sog"])
def test_a_container_is_taken_as_it_is(tmp_path, splats, name):
    path = tmp_path / name
    kissgs.compress(splats, path, settings=FAST)
    for prepare in (page_scene, page_container):
        found = prepare(path)
        assert (found.name, found.data, found.converted) == (name, path.read_bytes(), False)
        assert prepare(path.read_bytes()).data == path.read_bytes()


def test_a_folder_is_packed(tmp_path, splats):
    folder = tmp_path / "scene.of.mine"
    kissgs.compress(splats, f"{folder}/", settings=FAST)
    (folder / "notes.txt").write_text("private")
    expected = {path.name: path.read_bytes() for path in folder.iterdir() if path.name != "notes.txt"}
    for path in (folder, folder / "meta.json"):
        found = page_scene(path)
        assert found.name == "scene.of.mine.zip"
        with zipfile.ZipFile(BytesIO(found.data)) as archive:
            assert {name: archive.read(name) for name in archive.namelist()} == expected


@pytest.mark.parametrize("ending", ["ply", "spz"])
def test_other_formats_become_an_exact_ply(tmp_path, splats, ending):
    path = tmp_path / f"scene.{ending}"
    kissgs.save(splats, path)
    found = page_scene(path)
    assert found.name == f"{path.stem}.ply"
    (tmp_path / "page.ply").write_bytes(found.data)
    expected, decoded = kissgs.load(path), kissgs.load(tmp_path / "page.ply")
    for name in ("means", "quats", "scales", "opacities", "sh0", "shN"):
        np.testing.assert_array_equal(getattr(decoded, name), getattr(expected, name), err_msg=name)


def test_other_formats_become_a_container(tmp_path, splats):
    path = tmp_path / "scene.ply"
    kissgs.save(splats, path)
    found = page_container(path)
    assert (found.name, found.converted) == ("scene.zip", True)
    assert found.data == kissgs.compress(path).to_zip()


def test_unreadable_scenes(tmp_path, splats):
    (tmp_path / "text.ply").write_text("no scene")
    damaged = bytearray(kissgs.compress(splats, container="sog", settings=FAST).to_zip())
    damaged[100] ^= 255
    (tmp_path / "damaged.sog").write_bytes(damaged)
    for prepare in (page_scene, page_container):
        with pytest.raises(InvalidSceneError):
            prepare(tmp_path / "text.ply")
        with pytest.raises(InvalidContainerError):
            prepare(tmp_path / "damaged.sog")


def test_names_that_are_no_text(tmp_path, splats):
    path = tmp_path / "a\udcffb.ply"
    kissgs.save(splats, path)
    assert page_scene(path).name == "a\ufffdb.ply"
