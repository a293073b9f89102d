"""Oracle: a naive parser, and the naive columns of helpers/reference_gltf.py."""

import io
import json
import struct

import numpy as np
import pytest
from helpers.format_scenes import assert_alike, made_scene
from helpers.reference_gltf import NAME, SPZ, attributes, parse_glb

from kissgs.core.errors import UnsupportedError
from kissgs.core.splats import ATTRIBUTES, clean
from kissgs.io import gltf_document as gltf_writer
from kissgs.io.gltf import describe, read_gltf
from kissgs.io.gltf_document import write_glb, write_spz_glb
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
