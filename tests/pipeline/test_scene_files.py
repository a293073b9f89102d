"""Containers under any name and in any kind of zip: all commands agree on what is a container."""

import io
import zipfile

import numpy as np
import pytest

import kissgs
from kissgs import InvalidContainerError, KissgsError, Settings, decompress, sample_scene
from kissgs.io.scene_format import ReadOptions
from kissgs.pipeline.scene_files import describe, is_container, open_scene


def zips():
    """Return one container as zips in many forms, by file name."""
    packed = kissgs.compress(sample_scene(50), settings=Settings.from_preset("fast"))

    def again(method=zipfile.ZIP_STORED, folder="", comment=b""):
        buffer = io.BytesIO()
        with zipfile.ZipFile(buffer, "w", method) as archive:
            for name, data in packed.files.items():
                archive.writestr(folder + name, data)
            archive.comment = comment
        return buffer.getvalue()

    plain = packed.to_zip()
    return {
        "plain.zip": plain,
        "capitals.ZIP": plain,
        "other.ending": plain,
        "no_ending": plain,
        "named.ply": plain,
        "deflated.zip": again(zipfile.ZIP_DEFLATED),
        "folder.zip": again(folder="a/b c/"),
        "comment.zip": again(comment=b"x" * 65535),
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
