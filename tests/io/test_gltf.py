"""Oracle: a naive writer (helpers/reference_gltf.py), and renderings of moved scenes."""

import copy
import json
import struct

import numpy as np
import pytest
from helpers.format_scenes import assert_alike, made_scene
from helpers.reference_gltf import NAME, attributes, data_uri, document, glb_bytes, spz_document
from helpers.reference_spz import spz_bytes

from kissgs.core.errors import InvalidSceneError, UnsupportedError
from kissgs.core.spherical_harmonics import sh_basis
from kissgs.io.gltf import describe, read_gltf
from kissgs.io.scene_format import ReadOptions
from kissgs.io.spz import read_spz


@pytest.mark.parametrize(("degree", "count"), [(0, 1), (1, 65), (2, 1), (3, 65)])
def test_floats(degree, count):
    scene = made_scene(count, degree)
    data = glb_bytes(*document(attributes(scene)))
    assert_alike(read_gltf(data), scene, rtol=1e-5, atol=1e-6, opacities=30)
    stated = describe(data)
    assert (stated.count, stated.sh_degree) == (count, degree)
    assert stated.details == {"binary": True, "primitives": 1, "spz": False, "antialiased": False}


@pytest.mark.parametrize(
    ("rotation", "step", "opacity", "scale"), [("b", 1 / 127, "B", "H"), ("h", 1 / 32767, "H", "B")]
)
def test_normalised_integers(rotation, step, opacity, scale):
    scene = made_scene(65, 1, extremes=False)
    codes = {f"{NAME}:ROTATION": rotation, f"{NAME}:OPACITY": opacity, f"{NAME}:SCALE": scale}
    found = read_gltf(glb_bytes(*document(attributes(scene), codes)))
    np.testing.assert_allclose(found.quats, scene.quats, atol=step / 2 * 1.01)
    top = {"B": 255, "H": 65535}
    np.testing.assert_allclose(np.exp(found.scales), np.exp(scene.scales), atol=0.51 / top[scale])
    a, b = (1 / (1 + np.exp(-s.opacities.astype(float))) for s in (found, scene))
    np.testing.assert_allclose(a, b, atol=0.51 / top[opacity] + 2e-6)


def test_rows_with_a_stride():
    scene = made_scene(20, 1, extremes=False)
    data = glb_bytes(*document(attributes(scene), stride=20))
    assert_alike(read_gltf(data), scene, rtol=1e-5, atol=1e-5, opacities=1e-3)


def test_json_with_a_buffer_inside_or_beside(tmp_path):
    scene = made_scene(20, 1, extremes=False)
    root, buffer = document(attributes(scene))
    root["buffers"][0]["uri"] = data_uri(buffer)
    assert_alike(read_gltf(json.dumps(root).encode()), scene, rtol=1e-5, atol=1e-5, opacities=1e-3)
    root["buffers"][0]["uri"] = "a%20b/c.bin"
    (tmp_path / "a b").mkdir()
    (tmp_path / "a b/c.bin").write_bytes(buffer)
    (tmp_path / "scene.gltf").write_text(json.dumps(root))
    assert_alike(read_gltf(tmp_path / "scene.gltf"), scene, rtol=1e-5, atol=1e-5, opacities=1e-3)
    assert not describe(tmp_path / "scene.gltf").details["binary"]
    with pytest.raises(UnsupportedError, match=r"needs the file 'a b/c\.bin' beside it; give the path, or a \.glb"):
        read_gltf(json.dumps(root).encode())
    for outside in ("../c.bin", "/etc/passwd", "a/../../c.bin", "%2e%2e/c.bin", "https://example.org/c.bin", "C:/c"):
        root["buffers"][0]["uri"] = outside
        (tmp_path / "scene.gltf").write_text(json.dumps(root))
        with pytest.raises(UnsupportedError, match=r"names a buffer outside its folder; put the file beside it"):
            read_gltf(tmp_path / "scene.gltf")


@pytest.mark.parametrize("version", [2, 3, 4])
def test_spz_inside(version):
    """Equal Gaussians to those of the .spz alone; a rotation may differ by half a turn about its own axis."""
    spz = spz_bytes(made_scene(65, 2, extremes=False), version)
    data = glb_bytes(*spz_document(spz, 65))
    stated = describe(data)
    assert (stated.count, stated.sh_degree) == (65, 2)
    assert stated.details == {"binary": True, "primitives": 1, "spz": True, "antialiased": False}
    found, wanted = read_gltf(data), read_spz(spz)
    for name in ("means", "scales", "opacities", "sh0", "shN"):
        np.testing.assert_array_equal(getattr(found, name), getattr(wanted, name))
    np.testing.assert_allclose(covariances(found), covariances(wanted), rtol=1e-4, atol=1e-5)


def test_spz_inside_names_its_axes():
    scene = made_scene(65, 2, extremes=False)
    raw = spz_bytes(scene, 3, y_up=False, extensions=struct.pack("<III", 0xADBE0003, 4, 6))
    found, wanted = (read_gltf(glb_bytes(*spz_document(data, 65))) for data in (raw, spz_bytes(scene, 3)))
    np.testing.assert_allclose(found.means, wanted.means, atol=2**-12)
    np.testing.assert_allclose(found.shN, wanted.shN, atol=1 / 128)


def matrices(quats):
    w, x, y, z = (quats.astype(float) / np.linalg.norm(quats, axis=1, keepdims=True)).T
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return np.moveaxis(np.array(rows), 2, 0)


def covariances(splats):
    half = matrices(splats.quats) * np.exp(splats.scales.astype(float))[:, None]
    return half @ half.transpose(0, 2, 1)


TURN = matrices(np.array([[0.5, 0.1, -0.7, 0.3]]))[0]
HALF_TURN = np.diag([-1.0, -1.0, 1.0])
"""Matrix from the axes of glTF to those of a .ply."""


def test_nodes_move_scale_and_rotate():
    """Compared are positions, covariances, and colours in directions that turn with the scene."""
    scene = made_scene(30, 3, extremes=False)
    root, buffer = document(attributes(scene))
    shift, scale = np.array([1.0, -2.0, 3.0]), 2.5
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = TURN, shift
    root["nodes"] = [{"children": [1], "matrix": matrix.T.reshape(16).tolist()}, {"mesh": 0, "scale": [scale] * 3}]
    found = read_gltf(glb_bytes(root, buffer))
    turn = HALF_TURN @ TURN @ HALF_TURN
    means = scale * scene.means.astype(float) @ turn.T + HALF_TURN @ shift
    np.testing.assert_allclose(found.means, means, rtol=1e-5, atol=1e-5)
    wanted = scale**2 * turn @ covariances(scene) @ turn.T
    np.testing.assert_allclose(covariances(found), wanted, rtol=1e-4, atol=1e-6)
    directions = np.random.default_rng(0).normal(size=(50, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    before = np.einsum("dk,nkc->ndc", sh_basis(directions, 3)[:, 1:], scene.shN)
    after = np.einsum("dk,nkc->ndc", sh_basis(directions @ turn.T, 3)[:, 1:], found.shN)
    np.testing.assert_allclose(after, before, atol=1e-5)


def test_a_rotation_of_a_node_as_a_quaternion():
    scene = made_scene(10, 1, extremes=False)
    root, buffer = document(attributes(scene))
    root["nodes"] = [{"mesh": 0, "rotation": [0, 0, np.sin(0.3), np.cos(0.3)], "translation": [0, 0, 1]}]
    found = read_gltf(glb_bytes(root, buffer))
    c, s = np.cos(0.6), np.sin(0.6)
    turn = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])  # about the axis that both frames share
    np.testing.assert_allclose(found.means, scene.means @ turn.T + [0, 0, 1], atol=1e-5)


def test_several_primitives_and_nodes():
    scene = made_scene(4, 1, extremes=False)
    root, buffer = document(attributes(scene))
    root["meshes"].append({"primitives": [{"attributes": {}}]})  # another mesh, without Gaussians
    root["meshes"][0]["primitives"] *= 2
    root["nodes"] = [{"mesh": 0}, {"mesh": 1}, {"mesh": 0}]
    root["scenes"] = [{"nodes": [0, 1, 2]}]
    root["animations"] = [{}]
    root["meshes"][0]["primitives"][0]["attributes"]["_LABEL"] = 0
    found = read_gltf(glb_bytes(root, buffer))
    assert len(found) == 16
    assert found.notes == ("left out: animations, _LABEL, meshes without Gaussians",)
    np.testing.assert_allclose(found.means, np.tile(scene.means, (4, 1)), atol=1e-6)
    with pytest.raises(UnsupportedError, match=r"has 16 Gaussians; the limit is 15"):
        read_gltf(glb_bytes(root, buffer), ReadOptions(max_gaussians=15))


def test_what_is_left_out_is_named():
    root, buffer = document(attributes(made_scene(4, 0, extremes=False)))
    root["scenes"].append({"nodes": [0]})
    root["asset"] = {"version": "2.1"}
    root["extensionsUsed"] = [NAME, "CESIUM_RTC", "KHR_materials_unlit"]
    root["meshes"][0]["primitives"][0]["indices"] = 0
    splatting(root)["sortingMethod"] = "zDepth"
    found = read_gltf(glb_bytes(root, buffer))
    assert found.notes == ("left out: extension CESIUM_RTC, other scenes, indices, sortingMethod 'zDepth'",)


def test_quantised_positions():
    scene = made_scene(20, 0, extremes=False)
    scene.means[:] /= np.abs(scene.means).max()
    root, buffer = document(attributes(scene), {"POSITION": "h"})
    root["extensionsRequired"] = ["KHR_mesh_quantization", "KHR_texture_transform", NAME]
    root["nodes"][0]["scale"] = [4] * 3
    np.testing.assert_allclose(read_gltf(glb_bytes(root, buffer)).means, 4 * scene.means, atol=4 / 32767)


def meshopt(root):
    """Let all views be compressed, whose buffer has no data: decoders fill it."""
    for view in root["bufferViews"]:
        view["buffer"] = 1
    root["buffers"].append({"byteLength": len(BUFFER), "extensions": {"EXT_meshopt_compression": {"fallback": True}}})


def optional_meshopt(root):
    for view in root["bufferViews"]:
        view |= {"buffer": 1, "extensions": {"EXT_meshopt_compression": {"buffer": 0}}}
    root["buffers"].append({"byteLength": len(BUFFER)})


SCENE = made_scene(4, 2, extremes=False)
ROOT, BUFFER = document(attributes(SCENE))


def changed(change):
    root = copy.deepcopy(ROOT)
    change(root)
    return glb_bytes(root, BUFFER)


def primitive(root):
    return root["meshes"][0]["primitives"][0]


def splatting(root):
    return primitive(root)["extensions"][NAME]


PLAIN = glb_bytes(ROOT, BUFFER)
CHANGES = {
    "needs the extension 'VENDOR_unknown',": changed(lambda r: r.update(extensionsRequired=[NAME, "VENDOR_unknown"])),
    "is not valid glTF: extensionsRequired is not a list": changed(lambda r: r.update(extensionsRequired={})),
    "needs the extension 'KHR_meshopt": changed(lambda r: r.update(extensionsRequired=["KHR_meshopt_compression"])),
    "buffers[1] has no data": changed(meshopt),
    "needs the extension 'EXT_meshopt_compression', which": changed(optional_meshopt),
    "needs the extension 'KHR_draco_mesh_compression', which": changed(
        lambda r: primitive(r)["extensions"].update(KHR_draco_mesh_compression={"bufferView": 0})
    ),
    "is glTF of version '2.1'; export it": changed(lambda r: r.update(asset={"version": "2.0", "minVersion": "2.1"})),
    "is glTF of version '1.0'; export it as glTF 2.0": changed(lambda r: r.update(asset={"version": "1.0"})),
    "has no Gaussians: no mesh that its scene shows uses KHR": changed(lambda r: r["scenes"][0].update(nodes=[])),
    "the extension 'EXT_mesh": changed(lambda r: r["nodes"][0].update(extensions={"EXT_mesh_gpu_instancing": {}})),
    "needs the extension 'KHR_node_visibility', which": changed(
        lambda r: r["nodes"][0].update(extensions={"KHR_node_visibility": {"visible": False}})
    ),
    "read as glTF, is not readable JSON; export the scene again": b"{",
    "has more than 262,144 values": b'{"nodes": [' + b"0," * 262_144 + b"0]}",
    "is cut short: it needs": PLAIN[:-1],
    "is GLB of version 1; version 2 is read": PLAIN[:4] + b"\1" + PLAIN[5:],
    "is not valid GLB: its first chunk is not JSON; export it again": PLAIN[:16] + b"BIN\0" + PLAIN[20:],
    "no mesh that its scene shows uses KHR_gaussian_splatting": changed(lambda r: primitive(r).pop("extensions")),
    "has the kernel 'cube'; export it with 'ellipse'": changed(lambda r: splatting(r).update(kernel="cube")),
    "has the colorSpace 'lin_rec709_display'": changed(lambda r: splatting(r).update(colorSpace="lin_rec709_display")),
    "needs the extension 'X', which is not read": changed(lambda r: splatting(r).update(extensions={"X": {}})),
    "a primitive has no POSITION": changed(lambda r: primitive(r)["attributes"].pop("POSITION")),
    "has no KHR_gaussian_splatting:SCALE": changed(lambda r: primitive(r)["attributes"].pop(f"{NAME}:SCALE")),
    "has no KHR_gaussian_splatting:SH": changed(lambda r: primitive(r)["attributes"].pop(f"{NAME}:SH_DEGREE_1_COEF_2")),
    "has SH degree 4; export it with degree 3 or lower": changed(
        lambda r: primitive(r)["attributes"].update({f"{NAME}:SH_DEGREE_4_COEF_0": 0})
    ),
    "has 3 values for 4 Gaussians": changed(lambda r: r["accessors"][1].update(count=3)),
    "POSITION has rows of 12 bytes every 8": changed(lambda r: r["bufferViews"][0].update(byteStride=8)),
    "POSITION has rows of 12 bytes every 4,096": changed(lambda r: r["bufferViews"][0].update(byteStride=4096)),
    "an accessor needs more bytes than its buffer view has": changed(lambda r: r["accessors"][0].update(byteOffset=4)),
    "a buffer view reaches beyond its buffer": changed(lambda r: r["bufferViews"][0].update(byteLength=1 << 40)),
    "has sparse or empty data for POSITION": changed(lambda r: r["accessors"][0].update(sparse={})),
    "POSITION is 'VEC2' of component type": changed(lambda r: r["accessors"][0].update(type="VEC2")),
    "it names accessors['99'] of": changed(lambda r: primitive(r)["attributes"].update(POSITION=99)),
    "has a node that mirrors or stretches its Gaussians": changed(lambda r: r["nodes"][0].update(scale=[1, 1, 2])),
    "a node's translation is not 3 numbers": changed(lambda r: r["nodes"][0].update(translation=[1, None, 2])),
    "its nodes form a circle": changed(lambda r: r["nodes"][0].update(children=[0])),
}


def many_accessors(root):
    root["accessors"] += [{}] * 120_000
    root["nodes"] = [{"mesh": 0}] * 900
    root["scenes"] = [{"nodes": list(range(900))}]
    root["accessors"][0]["count"] = 3


def many_primitives(root):
    root["meshes"][0]["primitives"] *= 50
    root["nodes"] = [{"mesh": 0}] * 900
    root["scenes"] = [{"nodes": list(range(900))}]


CHANGES |= {
    "has 4 values for 3 Gaussians": changed(many_accessors),
    "its nodes show more than 1,000 primitives": changed(many_primitives),
    "a primitive has 210 attributes": changed(
        lambda r: primitive(r)["attributes"].update({f"_{i}": 0 for i in range(197)})
    ),
}


@pytest.mark.parametrize(("message", "data"), list(CHANGES.items()), ids=list(CHANGES))
def test_damaged(message, data):
    with pytest.raises((InvalidSceneError, UnsupportedError)) as error:
        read_gltf(data)
    assert message in str(error.value)


def test_negative_scales_are_those_of_a_draft():
    columns = attributes(SCENE)
    columns[f"{NAME}:SCALE"] = SCENE.scales.tolist()
    with pytest.raises(InvalidSceneError, match=r"it has negative scales, as drafts of the extension had them"):
        read_gltf(glb_bytes(*document(columns)))
