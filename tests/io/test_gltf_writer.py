"""Oracle: a naive parser, the naive columns of helpers/reference_gltf.py, and the file of splat-transform."""

import io
import json
import struct

import numpy as np
import pytest
from helpers.format_scenes import assert_alike, made_scene
from helpers.reference_gltf import NAME, SPZ, attributes, parse_glb
from helpers.splat_transform import convert, needs_splat_transform

from kissgs.core.errors import UnsupportedError
from kissgs.core.splats import ATTRIBUTES, clean
from kissgs.io import gltf_writer
from kissgs.io.gltf import describe, read_gltf
from kissgs.io.gltf_writer import write_glb, write_spz_glb
from kissgs.io.ply import write_ply
from kissgs.io.spz import write_spz


def written(splats):
    """Return a file of the scene once it is cleaned."""
    file = io.BytesIO()
    assert write_glb(file, clean(splats)[0]) == ()
    return file.getvalue()


@pytest.mark.parametrize(("count", "degree"), [(1, 0), (65, 1), (3, 2), (65, 3)])
def test_a_naive_parser_finds_the_scene(count, degree):
    scene = clean(made_scene(count, degree))[0]
    root, columns = parse_glb(written(scene))
    colours = np.array(columns.pop("COLOR_0"))
    wanted = attributes(scene)
    assert set(columns) == set(wanted)
    for name, rows in wanted.items():
        np.testing.assert_allclose(columns[name], rows, rtol=1e-6, atol=1e-7, err_msg=name)
    srgb = np.clip(0.5 + 0.28209479177387814 * scene.sh0.astype(float), 0, 1)
    np.testing.assert_allclose(np.round((colours[:, :3] / 255) ** (1 / 2.2), 1), np.round(srgb, 1), atol=0.11)
    np.testing.assert_allclose(colours[:, 3:] / 255, columns[f"{NAME}:OPACITY"], atol=0.51 / 255)
    (primitive,) = root["meshes"][0]["primitives"]
    assert primitive["mode"] == 0
    assert primitive["extensions"][NAME]["kernel"] == "ellipse"
    assert primitive["extensions"][NAME]["colorSpace"] == "srgb_rec709_display"
    assert root["extensionsUsed"] == [NAME]
    assert root["accessors"][primitive["attributes"]["COLOR_0"]]["normalized"] is True


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_read_back(degree):
    scene = clean(made_scene(65, degree))[0]
    data = written(scene)
    stated = describe(data)
    assert (stated.count, stated.sh_degree) == (65, degree)
    assert stated.details == {"binary": True, "primitives": 1, "spz": False, "antialiased": False}
    found = read_gltf(data)
    assert_alike(found, scene, rtol=1e-6, atol=1e-6, opacities=0.1)  # floats next to opacity 1 are far apart as logits
    for name in ("means", "quats", "sh0", "shN"):
        np.testing.assert_array_equal(np.abs(getattr(found, name)), np.abs(getattr(scene, name)), err_msg=name)


def test_extreme_values():
    scene = made_scene(6, 1)
    scene.means[:3] = [[1e15, -1e15, 1e-40], [np.inf, 0, 0], [0, np.nan, 0]]
    scene.scales[:] = [[-np.inf, 30, -30], *[[0, 0, 0]] * 4, [30, 30, 30]]
    scene.opacities[:2] = [-np.inf, np.inf]
    scene.sh0[4] = 1e30
    found = read_gltf(written(scene))
    assert_alike(found, clean(scene)[0], rtol=1e-6, opacities=0.1)
    assert all(np.isfinite(getattr(found, name)).all() for name in ATTRIBUTES)


def test_scenes_that_glb_cannot_hold(monkeypatch):
    message = r"^a scene without Gaussians cannot be written as \.glb; write it as \.ply$"
    with pytest.raises(UnsupportedError, match=message):
        written(made_scene(0, 1))
    size = len(written(made_scene(5, 1)))
    monkeypatch.setattr(gltf_writer, "_MAX_BYTES", size)
    assert struct.unpack_from("<I", written(made_scene(5, 1)), 8) == (size,)
    monkeypatch.setattr(gltf_writer, "_MAX_BYTES", size - 1)
    with pytest.raises(UnsupportedError, match=r"^5 Gaussians take [\d,]+ bytes, and \.glb ends at 4 GiB; write"):
        written(made_scene(5, 1))


@pytest.mark.parametrize(("count", "degree"), [(1, 0), (65, 1), (66, 3)])
def test_spz_inside(count, degree):
    """The file is a GLB around the bytes of the .spz, whose losses are those of the file."""
    scene, file, packed = clean(made_scene(count, degree))[0], io.BytesIO(), io.BytesIO()
    assert write_spz_glb(file, scene) == write_spz(packed, scene)
    data = file.getvalue()
    stated = describe(data)
    assert (stated.count, stated.sh_degree) == (count, degree)
    assert stated.details == {"binary": True, "primitives": 1, "spz": True, "antialiased": False}
    size, text = struct.unpack_from("<II", data, 8)
    assert size == len(data)
    root = json.loads(data[20 : 20 + text])
    (view,) = root["bufferViews"]
    assert root["buffers"] == [{"byteLength": view["byteLength"]}]
    body = data[28 + text :]
    assert body == packed.getvalue() + bytes(-len(packed.getvalue()) % 4)
    assert struct.unpack_from("<I4s", data, 20 + text) == (len(body), b"BIN\0")
    assert root["extensionsRequired"] == root["extensionsUsed"] == [NAME, SPZ]
    means = read_gltf(data).means * [-1, -1, 1]
    assert root["accessors"][0]["min"] == means.min(axis=0).tolist()
    assert root["accessors"][0]["max"] == means.max(axis=0).tolist()
    assert all("bufferView" not in accessor for accessor in root["accessors"])


def test_scenes_that_spz_inside_glb_cannot_hold(monkeypatch):
    with pytest.raises(UnsupportedError, match=r"^a scene without Gaussians cannot be written as \.glb; write it as"):
        write_spz_glb(io.BytesIO(), made_scene(0, 1))
    monkeypatch.setattr(gltf_writer, "_MAX_BYTES", 1000)
    with pytest.raises(UnsupportedError, match=r"^5 Gaussians take [\d,]+ bytes, and \.glb ends at 4 GiB; write"):
        write_spz_glb(io.BytesIO(), made_scene(5, 1))


def test_bytes_are_the_same_again():
    assert written(made_scene(70, 2)) == written(made_scene(70, 2))


@needs_splat_transform
@pytest.mark.parametrize("degree", [3, 0])
@pytest.mark.quick(1)
def test_numbers_are_those_that_splat_transform_writes(degree, tmp_path):
    """The tool writes .glb but does not read it."""
    scene = clean(made_scene(65, degree, extremes=False))[0]
    with (tmp_path / "a.ply").open("wb") as file:
        write_ply(file, scene)
    theirs = parse_glb(convert(tmp_path / "a.ply", tmp_path / "a.glb").read_bytes())[1]
    ours = parse_glb(written(scene))[1]
    assert set(ours) == set(theirs)
    theirs, ours = ({name: np.array(rows) for name, rows in columns.items()} for columns in (theirs, ours))
    for columns in (theirs, ours):
        order = np.lexsort(columns["POSITION"].T)
        columns.update({name: rows[order] for name, rows in columns.items()})
    for name in ours:
        if name != "COLOR_0":  # theirs has sRGB bytes, where the format's text asks for linear ones
            np.testing.assert_allclose(ours[name], theirs[name], rtol=1e-5, atol=1e-6, err_msg=name)
