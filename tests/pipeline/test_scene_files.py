"""Containers under any name and in any kind of zip, and scenes written by the ending of their name. Oracles: all
commands agree on what is a container; the readers of each format."""

import re
import zipfile
from pathlib import Path

import numpy as np
import pytest
from helpers.format_scenes import made_scene
from helpers.reference_sog import zip_of

import kissgs
from kissgs import InvalidContainerError, KissgsError, OutputError, Settings, UnsupportedError, decompress, sample_scene
from kissgs.formats import OUTPUT_FORMATS, output_format
from kissgs.io.scene_format import ReadOptions
from kissgs.pipeline.scene_files import describe, is_container, open_scene


def zips():
    """Return one container as zips in many forms, by file name."""
    packed = kissgs.compress(sample_scene(50), settings=Settings.from_preset("fast"))

    plain = packed.to_zip()
    return {
        "plain.zip": plain,
        "capitals.ZIP": plain,
        "other.ending": plain,
        "no_ending": plain,
        "named.ply": plain,
        "deflated.zip": zip_of(packed.files, zipfile.ZIP_DEFLATED),
        "folder.zip": zip_of(packed.files, folder="a/b c/"),
        "comment.zip": zip_of(packed.files, comment=b"x" * 65535),
        "program.exe": b"MZ" + bytes(5000) + plain,
        "script.zip": b"#!/bin/sh\nexec unzip $0\n" + plain,
        "empty line.zip": b"\n" + plain,
        "more behind.zip": plain + b"\0" * 100,
    }


FORMS = zips()


@pytest.mark.parametrize("name", FORMS)
def test_all_commands_read_what_decompress_reads(name, tmp_path):
    path = tmp_path / name
    path.write_bytes(FORMS[name])
    wanted = decompress(FORMS["plain.zip"])
    for found in (decompress(path), decompress(FORMS[name]), kissgs.load(path)):
        np.testing.assert_array_equal(found.means, wanted.means)
    assert (described := describe(path)).kind == "sogxt"
    assert described.count == len(wanted)
    assert open_scene(FORMS[name], ReadOptions(), 1, lambda *_: None)[2] == len(FORMS[name])


def test_a_ply_with_a_zip_at_its_end_is_a_ply_to_all(tmp_path):
    path = tmp_path / "a.ply"
    kissgs.save(sample_scene(20), path)
    path.write_bytes(path.read_bytes() + FORMS["plain.zip"])
    assert not is_container(path)
    for source in (path, path.read_bytes()):
        with pytest.raises(InvalidContainerError, match=r"is a \.ply, not a container; kissgs convert reads both"):
            decompress(source)
    assert describe(path).kind == "ply"


def test_a_false_zip_is_refused_by_all_commands(tmp_path):
    path = tmp_path / "a.zip"
    path.write_bytes(b"<html>no such page</html>")
    for read in (decompress, kissgs.load, describe, kissgs.compress):
        with pytest.raises(KissgsError, match=r"is not a readable zip file|this is an HTML page"):
            read(path)


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
