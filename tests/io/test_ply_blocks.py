"""Scenes read in blocks. Oracle: the same file read as a whole."""

import pytest
from helpers.reference_ply import assert_identical, header_bytes, ply_bytes, random_columns

import kissgs
from kissgs.core.errors import InvalidSceneError
from kissgs.core.splats import concatenate
from kissgs.io import ply
from kissgs.io.ply import read_ply, read_ply_blocks
from kissgs.pipeline.scene_files import write_scene


@pytest.mark.parametrize("encoding", ["ascii", "binary_little_endian", "binary_big_endian"])
@pytest.mark.parametrize("count", [0, 1, 299, 300, 301, 1000])
@pytest.mark.parametrize("degree", [0, 2])
@pytest.mark.quick(8)
def test_blocks_are_the_scene(encoding, count, degree, tmp_path, monkeypatch):
    monkeypatch.setattr(ply, "BLOCK", 100)
    monkeypatch.setattr("kissgs.io.ply_rows.BLOCK_BYTES", 100 * 4 * (14 + 45))
    path = tmp_path / "scene.ply"
    path.write_bytes(ply_bytes(random_columns(count, degree), encoding))
    blocks = list(read_ply_blocks(path))
    assert sum(map(len, blocks)) == count
    assert len(blocks) > 1 or count < 1000
    if count:
        assert_identical(concatenate(blocks), read_ply(path))


def test_colours_of_8_bits_in_blocks(tmp_path):
    names = ("x", "y", "z", "opacity", "scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3")
    lines = ["element vertex 3", *(f"property float {name}" for name in names)]
    lines += [f"property uchar {name}" for name in ("red", "green", "blue")]
    rows = "".join(" ".join(["0.5"] * 11 + [str(40 * row), "128", "255"]) + "\n" for row in range(3))
    (tmp_path / "scene.ply").write_bytes(header_bytes(lines, "ascii") + rows.encode())
    assert_identical(concatenate(list(read_ply_blocks(tmp_path / "scene.ply"))), read_ply(tmp_path / "scene.ply"))


def test_compressed_scenes_come_as_one_block(tmp_path):
    with (tmp_path / "scene.compressed.ply").open("wb") as file:
        write_scene(file, kissgs.sample_scene(700, sh_degree=1), "compressed.ply")
    (block,) = read_ply_blocks(tmp_path / "scene.compressed.ply")
    assert_identical(block, read_ply(tmp_path / "scene.compressed.ply"))


def test_a_file_that_ends_too_soon_is_named(tmp_path):
    path = tmp_path / "scene.ply"
    path.write_bytes(ply_bytes(random_columns(50, 0))[:-5])
    with pytest.raises(InvalidSceneError, match=r"scene\.ply"):
        list(read_ply_blocks(path))
