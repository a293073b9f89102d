"""Packed captures; oracle: the views of the capture itself, and the names and sizes of what they show."""

import json
import shutil
import zipfile
from pathlib import Path

import numpy as np
import pytest
from helpers.captured_scene import write_capture
from PIL import Image

from kissgs.cameras.captures.load import load_views, pack_capture
from kissgs.cameras.photographs import read_photo_header
from kissgs.core.errors import InvalidViewsError


def assert_same_views(found, expected):
    assert [view.name for view in found.all] == [view.name for view in expected.all]
    assert [view.name for view in found.test] == [view.name for view in expected.test]
    for ours, theirs in zip(found.all, expected.all, strict=True):
        np.testing.assert_array_equal(ours.camera.K, theirs.camera.K)
        np.testing.assert_array_equal(ours.camera.viewmat, theirs.camera.viewmat)
        np.testing.assert_array_equal(ours.load_photo(), theirs.load_photo())


def packed(capture, tmp_path):
    """Return the unpacked archive of a capture, and its names."""
    pack_capture(capture, tmp_path / "packed.zip")
    with zipfile.ZipFile(tmp_path / "packed.zip") as archive:
        archive.extractall(tmp_path / "unpacked")
        return tmp_path / "unpacked", archive.namelist()


def renamed(capture, name):
    """Give the first photograph this path in the camera file."""
    path = capture / "transforms.json"
    document = json.loads(path.read_text())
    document["frames"][0]["file_path"] = name
    path.write_text(json.dumps(document))


def test_only_what_views_use_is_packed(tmp_path):
    capture = write_capture(tmp_path / "statue")
    (capture / "images" / "unused.png").write_bytes(b"x")
    (capture / "images_4").mkdir()
    (capture / "notes.txt").write_text("notes")
    (capture / "dataparser_transforms.json").write_text(json.dumps({"transform": np.eye(4)[:3].tolist()}))
    unpacked, names = packed(capture, tmp_path)
    photographs = [f"images/{name}.png" for name in "abc"]
    assert names == ["dataparser_transforms.json", "transforms.json", *photographs]
    assert_same_views(load_views(unpacked, unpacked=True), load_views(capture))
    first = (tmp_path / "packed.zip").read_bytes()
    pack_capture(capture / "transforms.json", tmp_path / "again.zip")
    assert (tmp_path / "again.zip").read_bytes() == first


@pytest.mark.parametrize(("file", "name"), [("r_0.png", "r_0"), ("a.0001.JPG", "a.0001"), ("0\u30001", "0\u30001")])
@pytest.mark.parametrize("folder", ["train", "images"])
def test_photographs_that_are_named_without_an_ending_get_one(tmp_path, file, name, folder):
    capture = write_capture(tmp_path / "statue")
    (capture / folder).mkdir(exist_ok=True)
    (capture / "images" / "a.png").rename(capture / folder / file)
    renamed(capture, f"./{folder}/{name}")
    unpacked, names = packed(capture, tmp_path)
    ending = Path(file).suffix if file != name else ".png"
    assert f"{folder}/{name}{ending}" in names
    assert_same_views(load_views(unpacked, unpacked=True), load_views(capture))


@pytest.mark.parametrize("place", ["absolute", "above", "scaled"])
def test_photographs_anywhere_are_found_in_the_archive(tmp_path, place):
    capture = write_capture(tmp_path / "here" / "statue")
    if place == "scaled":
        (capture / "images").rename(capture / "images_4")
    else:
        outside = tmp_path / "elsewhere" / "a.png"
        outside.parent.mkdir()
        (capture / "images" / "a.png").rename(outside)
        renamed(capture, str(outside) if place == "absolute" else "../../elsewhere/a.png")
    unpacked, names = packed(capture, tmp_path)
    assert all(".." not in name and not name.startswith("/") for name in names)
    expected = load_views(capture)
    assert_same_views(load_views(unpacked, unpacked=True), expected)


def test_the_folder_of_a_scale_packs_its_photographs(tmp_path):
    capture = write_capture(tmp_path / "statue")
    shutil.copytree(capture / "images", capture / "images_2")
    unpacked, names = packed(capture / "images_2", tmp_path)
    assert {name.split("/")[0] for name in names if name.endswith(".png")} == {"images_2"}
    assert_same_views(load_views(unpacked, unpacked=True), load_views(capture / "images_2"))


def test_large_photographs_are_packed_as_they_are_used(tmp_path):
    capture = write_capture(tmp_path / "statue", size=(66, 44))
    rng = np.random.default_rng(0)
    for path in (capture / "images").iterdir():
        Image.fromarray(rng.integers(0, 255, (1100, 1650, 3), dtype=np.uint8)).save(path)
    transparent = Image.fromarray(rng.integers(0, 255, (1100, 1650, 4), dtype=np.uint8))
    transparent.save(capture / "images" / "b.png")
    unpacked, _ = packed(capture, tmp_path)
    headers = {path.name: read_photo_header(path) for path in (unpacked / "images").iterdir()}
    sizes = {name: (header.width, header.height) for name, header in headers.items()}
    assert sizes == {"a.png": (1600, 1066), "b.png": (1650, 1100), "c.png": (1600, 1066)}
    assert_same_views(load_views(unpacked, unpacked=True), load_views(capture))


def test_what_cannot_be_packed(tmp_path):
    capture = write_capture(tmp_path / "statue", names=["a.png", "b.png"])
    (tmp_path / "images").mkdir()
    (tmp_path / "images" / "b.png").write_bytes((capture / "images" / "a.png").read_bytes())
    renamed(capture, "../images/b.png")
    with pytest.raises(InvalidViewsError, match="in different folders; rename one"):
        pack_capture(capture, tmp_path / "packed.zip")
    with pytest.raises(InvalidViewsError, match="has no cameras"):
        pack_capture(tmp_path / "images", tmp_path / "packed.zip")
    (capture / "images" / "a.png").rename(capture / "images" / "a\n.png")
    renamed(capture, "images/a\n.png")
    with pytest.raises(InvalidViewsError, match=r"'images/a\\n.png' of a photograph is not printable"):
        pack_capture(capture, tmp_path / "packed.zip")
    assert not (tmp_path / "packed.zip").exists()
