"""Streamed SOG of others. Oracle: splat-transform, and a reader in plain numbers."""

import numpy as np
import pytest
from helpers.format_scenes import assert_alike, made_scene
from helpers.reference_sog import read_files, streamed_files, write_folder
from helpers.splat_transform import convert, needs_splat_transform

from kissgs.core.splats import ATTRIBUTES
from kissgs.io.ply import read_ply, write_ply
from kissgs.io.scene_format import ReadOptions
from kissgs.sog.decode import STREAMED


@needs_splat_transform
def test_splat_transform_reads_the_reference_files_as_we_do(tmp_path):
    """Level by level; that tool wants the environment to be selected as level -1."""
    scenes = [[made_scene(65, 1), made_scene(40, 1)], [made_scene(20, 1)]]
    folder = write_folder(streamed_files(scenes), tmp_path / "folder")
    for level in (0, 1):
        target = convert(folder / "lod-meta.json", tmp_path / f"{level}.ply", "-L", str(level))
        assert_alike(STREAMED.decode(folder, ReadOptions(level=level)), read_ply(target), rtol=1e-6, atol=1e-6)


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


def test_real_data(shared_data):
    folder = shared_data / "flowers"
    found = STREAMED.decode(folder, ReadOptions(level=3))
    assert len(found) == 26_895
    wanted = read_files({path.name: path.read_bytes() for path in (folder / "3_0").iterdir()})
    for name in ATTRIBUTES:
        np.testing.assert_allclose(getattr(found, name), wanted[name], rtol=1e-6, atol=1e-6, err_msg=name)
