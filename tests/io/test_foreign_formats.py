"""Agreement with readers and writers that others wrote (docs/reference/formats.md lists all such tests).

Scenes have degrees 0 to 3 and the ends of every attribute.
"""

import csv
import json
import struct

import numpy as np
import pytest
from helpers.format_scenes import assert_alike, made_scene
from helpers.reference_gltf import NAME, attributes
from helpers.reference_splat import ksplat_bytes, splat_bytes
from helpers.reference_spz import spz_bytes
from helpers.splat_transform import convert, needs_splat_transform
from helpers.web_tools import DECODER, run_node

from kissgs.core.splats import ATTRIBUTES, Splats, clean
from kissgs.io.gltf import read_gltf, write_glb, write_spz_glb
from kissgs.io.ksplat import read_ksplat
from kissgs.io.ply import read_ply, write_ply
from kissgs.io.scene_format import ReadOptions
from kissgs.io.splat import read_splat, write_splat
from kissgs.io.spz import read_spz, write_spz
from kissgs.sog.decode import decode

SH_C0 = 0.28209479177387814
PACKAGES = ("@adobe/spz", "@cesium/engine", "@mkkellogg/gaussian-splats-3d", "gltf-validator", "three")

needs_foreign_formats = pytest.mark.skipif(
    not all((DECODER / "node_modules" / name).exists() for name in PACKAGES),
    reason=f"scripts/setup dev installs {', '.join(PACKAGES)}",
)


def foreign(work, file, *arguments, text=""):
    """Do one work of the program and return what it printed."""
    return json.loads(run_node("foreign_formats.mjs", text, work, file, *arguments, timeout=120))


def floats(values, *shape):
    """Return an array of numbers, of which infinite ones are text."""
    return np.array([float(value) for value in values], np.float32).reshape(shape)


def bounded(opacities):
    """Return logits with infinite ones as this library has them."""
    return np.clip(opacities, -13.8155, 13.8023).astype(np.float32)


def splats_of_cloud(cloud):
    """Return the scene of the library of .spz, in whatever axes it is."""
    count, coefficients = cloud["numPoints"], (0, 3, 8, 15)[cloud["shDegree"]]
    return Splats(
        means=floats(cloud["positions"], count, 3),
        quats=np.roll(floats(cloud["rotations"], count, 4), 1, axis=1),
        scales=floats(cloud["scales"], count, 3),
        opacities=bounded(floats(cloud["alphas"], count)),
        sh0=floats(cloud["colors"], count, 3),
        shN=floats(cloud["sh"], count, coefficients, 3),
    )


def cloud_of_splats(splats):
    """Return a scene as the library of .spz takes it, as JSON."""
    cloud = {
        "numPoints": len(splats),
        "shDegree": splats.sh_degree,
        "positions": splats.means,
        "rotations": np.roll(splats.quats, -1, axis=1),
        "scales": splats.scales,
        "alphas": splats.opacities,
        "colors": splats.sh0,
        "sh": splats.shN,
    }
    return json.dumps({key: v.ravel().tolist() if isinstance(v, np.ndarray) else v for key, v in cloud.items()})


def splats_of_rows(rows, sh=()):
    """Return the scene of GaussianSplats3D: centre, scale, rotation, and a byte each for colour and opacity."""
    count = len(rows)
    table = np.array([row[:14] for row in rows], float).reshape(count, 14)
    with np.errstate(divide="ignore"):
        opacities = -np.log(255 / table[:, 13] - 1)
        scales = np.log(table[:, 3:6])
    return Splats(
        means=table[:, :3].astype(np.float32),
        quats=table[:, 6:10].astype(np.float32),
        scales=scales.astype(np.float32),
        opacities=bounded(opacities),
        sh0=((table[:, 10:13] / 255 - 0.5) / SH_C0).astype(np.float32),
        shN=floats(sh, count, len(sh) // (3 * max(count, 1)), 3),
    )


SCENES = pytest.mark.parametrize(("count", "degree"), [(65, 3), (1, 0), (65, 1), (65, 2)])
"""Scenes of every degree; the quick one is the first."""


def odd_scene(count, degree):
    """Return a made scene that also has large coordinates, and rotations far from unit length."""
    scene = made_scene(count, degree)
    if count >= 8:
        scene.means[4:6] = [[1e5, -3e4, 7], [-12345.678, 1e-5, 99999]]
        scene.quats[4:8] *= np.float32([[3], [0.01], [100], [-2]])
    return scene


def unit(splats):
    """Return the scene with rotations of unit length, which most writers make."""
    arrays = {name: getattr(splats, name) for name in ATTRIBUTES}
    arrays["quats"] = splats.quats / np.linalg.norm(splats.quats, axis=1, keepdims=True)
    return Splats(**arrays)


def ply_of(scene, path):
    with path.open("wb") as file:
        write_ply(file, scene)
    return path


def written(writer, scene, path):
    """Write the cleaned scene, and return the path."""
    with path.open("wb") as file:
        writer(file, clean(scene)[0])
    return path


@needs_splat_transform
@SCENES
@pytest.mark.quick(1)
def test_ply(count, degree, tmp_path):
    """The tool's table has every number of our file, bit by bit, and we read its file as it does."""
    scene = odd_scene(count, degree)
    source = ply_of(scene, tmp_path / "a.ply")
    with convert(source, tmp_path / "a.csv").open() as file:
        rows = [{name: np.float32(value) for name, value in row.items()} for row in csv.DictReader(file)]
    columns = {name: np.array([row[name] for row in rows]) for name in rows[0]}
    rest = scene.shN.transpose(0, 2, 1).reshape(count, -1)
    wanted = {
        **{name: scene.means[:, i] for i, name in enumerate("xyz")},
        **{f"rot_{i}": scene.quats[:, i] for i in range(4)},
        **{f"scale_{i}": scene.scales[:, i] for i in range(3)},
        **{f"f_dc_{i}": scene.sh0[:, i] for i in range(3)},
        **{f"f_rest_{i}": rest[:, i] for i in range(rest.shape[1])},
        "opacity": scene.opacities,
    }
    assert set(columns) - set(wanted) <= {"nx", "ny", "nz"}
    for name, values in wanted.items():
        np.testing.assert_array_equal(columns[name], values, err_msg=name)
    assert_alike(read_ply(convert(source, tmp_path / "b.ply")), scene, opacities=0)


@needs_splat_transform
@pytest.mark.parametrize(("count", "degree"), [(300, 3), (1, 0), (65, 1), (65, 2)])
@pytest.mark.quick(1)
def test_compressed_ply_of_splat_transform(count, degree, tmp_path):
    packed = convert(ply_of(odd_scene(count, degree), tmp_path / "a.ply"), tmp_path / "a.compressed.ply")
    theirs = read_ply(convert(packed, tmp_path / "b.ply"))
    assert_alike(read_ply(packed), theirs, rtol=1e-5, atol=1e-5, opacities=0.02)


@needs_splat_transform
@pytest.mark.parametrize(("degree", "name"), [(3, "a.sog"), (1, "folder/meta.json")])
def test_sog_of_splat_transform(degree, name, tmp_path):
    packed = convert(ply_of(odd_scene(65, degree), tmp_path / "a.ply"), tmp_path / name, "-i", "2")
    source = packed if packed.suffix == ".sog" else packed.parent
    assert_alike(decode(source), read_ply(convert(packed, tmp_path / "b.ply")), rtol=1e-6, atol=1e-6)


@needs_foreign_formats
@pytest.mark.parametrize(("version", "count", "degree"), [(2, 65, 3), (3, 65, 2), (3, 1, 0), (4, 65, 1), (4, 65, 3)])
@pytest.mark.quick(3)
def test_spz_of_its_library(version, count, degree, tmp_path):
    """Differences are those of floats: the library has them where we have doubles."""
    path = tmp_path / "a.spz"
    foreign("write-spz", path, "RDF", version, text=cloud_of_splats(odd_scene(count, degree)))
    theirs = splats_of_cloud(foreign("read-spz", path, "RDF"))
    assert_alike(read_spz(path), theirs, atol=2e-5 if version == 2 else 5e-7, opacities=1e-4)
    stored = splats_of_cloud(foreign("read-spz", path, "UNSPECIFIED"))
    assert_alike(
        read_spz(path, ReadOptions(raw_axes=True)), stored, atol=2e-5 if version == 2 else 5e-7, opacities=1e-4
    )


@needs_foreign_formats
@SCENES
@pytest.mark.quick(1)
def test_spz_of_version_1(count, degree, tmp_path):
    """The library reads it, but does not write it."""
    path = tmp_path / "a.spz"
    path.write_bytes(spz_bytes(made_scene(count, degree), 1))
    theirs = splats_of_cloud(foreign("read-spz", path, "RDF"))
    assert_alike(read_spz(path), theirs, atol=2e-5, opacities=1e-4)


@needs_foreign_formats
@pytest.mark.parametrize("frame", range(9))
@pytest.mark.quick(2)
def test_axes_of_spz(frame, tmp_path):
    """The extension for coordinate systems; the library finds it in version 4, and no records behind older ones."""
    path = tmp_path / "a.spz"
    record = struct.pack("<III", 0xADBE0003, 4, frame)
    path.write_bytes(spz_bytes(made_scene(65, 3), 4, bits=11, y_up=False, extensions=record))
    theirs = splats_of_cloud(foreign("read-spz", path, "RDF"))
    assert_alike(read_spz(path), theirs, atol=5e-7, opacities=1e-4)


@needs_foreign_formats
@SCENES
@pytest.mark.quick(1)
def test_our_spz_in_its_library(count, degree, tmp_path):
    scene = made_scene(count, degree)
    path = written(write_spz, scene, tmp_path / "a.spz")
    theirs = splats_of_cloud(foreign("read-spz", path, "RDF"))
    assert_alike(read_spz(path), theirs, atol=5e-7, opacities=1e-4)
    in_steps_of_spz(theirs, clean(scene)[0])


def in_steps_of_spz(found, wanted):
    """Check each value within half a step, and what the format cannot hold at its ends."""
    step = 2.0 ** -min(12, 23 - int(np.frexp(np.abs(wanted.means).max())[1]))
    np.testing.assert_allclose(found.means, wanted.means, atol=step / 2 * 1.01)
    np.testing.assert_allclose(found.sh0, np.clip(wanted.sh0, -10 / 3, 10 / 3), atol=0.5 / 255 / 0.15 * 1.01)
    for band, step in ((slice(0, 3), 4 / 128), (slice(3, 15), 8 / 128)):
        held = np.clip(wanted.shN[:, band], -1, 1)
        np.testing.assert_allclose(found.shN[:, band], held, atol=step / 2 + 0.51 / 128)
    np.testing.assert_allclose(found.scales, np.clip(wanted.scales, -10, 5.9375), atol=1 / 32 * 1.01)
    opacities = [1 / (1 + np.exp(-splats.opacities.astype(float))) for splats in (found, wanted)]
    np.testing.assert_allclose(*opacities, atol=0.51 / 255)


@needs_foreign_formats
@pytest.mark.parametrize(
    ("level", "count", "degree"), [(0, 65, 2), (0, 0, 1), (1, 300, 1), (1, 1, 0), (2, 65, 2), (2, 300, 0)]
)
@pytest.mark.quick(3)
def test_ksplat_of_its_own_tool(level, count, degree, tmp_path):
    """The tool writes degrees up to 2."""
    path = tmp_path / "a.ksplat"
    foreign("write-ksplat", path, ply_of(odd_scene(count, degree), tmp_path / "a.ply"), level)
    found = foreign("read-ksplat", path)
    ours = read_ksplat(path)
    assert ours.sh_degree == found["degree"] == (degree if count else 0)
    assert_alike(ours, splats_of_rows(found["rows"], found["sh"]), rtol=1e-5, atol=2e-6, opacities=1e-4)


@needs_foreign_formats
@pytest.mark.parametrize("level", [0, 1, 2])
@pytest.mark.quick(1)
def test_ksplat_of_several_sections(level, tmp_path):
    path = tmp_path / "a.ksplat"
    scenes = [made_scene(300, 1), made_scene(7, 1)]
    path.write_bytes(ksplat_bytes(scenes, level))
    found = foreign("read-ksplat", path)
    assert_alike(read_ksplat(path), splats_of_rows(found["rows"], found["sh"]), rtol=1e-5, atol=2e-6, opacities=1e-4)


@needs_foreign_formats
@pytest.mark.parametrize(("count", "ours"), [(65, True), (0, True), (1, False), (65, False)])
@pytest.mark.quick(2)
def test_splat(ours, count, tmp_path):
    """Files of ours and of a naive writer."""
    path, scene = tmp_path / "a.splat", odd_scene(count, 0)
    if ours:
        written(write_splat, scene, path)
    else:
        path.write_bytes(splat_bytes(unit(scene)))
    theirs = splats_of_rows(foreign("read-splat", path)["rows"])
    assert_alike(read_splat(path), theirs, rtol=1e-5, atol=2e-6, opacities=1e-4)


def columns_of(found):
    """Return name -> array of the accessors that three.js has read."""
    columns = found["columns"].items()
    return {name: floats(item["values"], -1, item["width"]) for name, item in columns}


@needs_foreign_formats
@SCENES
@pytest.mark.quick(1)
def test_our_glb_in_three_js(count, degree, tmp_path):
    scene = odd_scene(count, degree)
    found = columns_of(foreign("read-glb", written(write_glb, scene, tmp_path / "a.glb")))
    assert found.pop("COLOR_0").shape == (count, 4)
    wanted = attributes(clean(scene)[0])
    assert set(found) == set(wanted)
    for name, rows in wanted.items():
        np.testing.assert_allclose(found[name], rows, rtol=1e-6, atol=1e-7, err_msg=name)


@needs_splat_transform
@needs_foreign_formats
@pytest.mark.parametrize("degree", [3, 0, 1, 2])
@pytest.mark.quick(1)
def test_glb_of_splat_transform(degree, tmp_path):
    """Compared are our reading of its file and that of three.js, in glTF's axes."""
    packed = convert(ply_of(odd_scene(65, degree), tmp_path / "a.ply"), tmp_path / "a.glb")
    theirs, ours = columns_of(foreign("read-glb", packed)), attributes(read_gltf(packed))
    for name, rows in ours.items():
        np.testing.assert_allclose(rows, theirs[name], rtol=1e-5, atol=2e-6, err_msg=name)


@needs_foreign_formats
@SCENES
@pytest.mark.quick(1)
def test_our_spz_inside_glb(count, degree, tmp_path):
    """The library of .spz turns what three.js finds in the file to glTF's axes, as the extension's text has it."""
    scene = made_scene(count, degree)
    path = written(write_spz_glb, scene, tmp_path / "a.spz.glb")
    found = foreign("read-glb", path)
    names = {f"{NAME}:SCALE", f"{NAME}:ROTATION", "POSITION", "COLOR_0"}
    names |= {name for name in attributes(scene) if "SH_DEGREE" in name and "DEGREE_0" not in name}
    assert {name: len(item["values"]) // item["width"] for name, item in found["columns"].items()} == dict.fromkeys(
        names, count
    )
    theirs, ours = splats_of_cloud(found["spz"]), read_gltf(path)
    in_steps_of_spz(ours, clean(scene)[0])
    np.testing.assert_allclose(ours.opacities, theirs.opacities, atol=1e-4)
    np.testing.assert_allclose(ours.sh0, theirs.sh0, atol=5e-7)
    columns = attributes(ours)  # in glTF's axes
    np.testing.assert_allclose(np.array(columns["POSITION"]), theirs.means, atol=5e-7)
    np.testing.assert_allclose(np.log(columns[f"{NAME}:SCALE"]), theirs.scales, atol=5e-7)
    cosines = (np.roll(columns[f"{NAME}:ROTATION"], 1, axis=1) * theirs.quats).sum(axis=1)
    np.testing.assert_allclose(np.abs(cosines), 1, atol=5e-7)
    for k, name in enumerate(name for name in columns if "SH_" in name and "DEGREE_0" not in name):
        np.testing.assert_allclose(columns[name], theirs.shN[:, k], atol=5e-7)


@needs_foreign_formats
@SCENES
@pytest.mark.quick(1)
def test_our_spz_inside_glb_in_cesium(count, degree, tmp_path):
    """Cesium takes the axes as they are stored, which is half a turn about the vertical axis from the extension's."""
    scene = made_scene(count, degree)
    found = foreign("read-glb-in-cesium", written(write_spz_glb, scene, tmp_path / "a.spz.glb"))
    wanted = read_spz(written(write_spz, scene, tmp_path / "a.spz"), ReadOptions(raw_axes=True))
    np.testing.assert_array_equal(floats(found.pop("POSITION"), count, 3), wanted.means)
    np.testing.assert_allclose(floats(found.pop(f"{NAME}:SCALE"), count, 3), np.exp(wanted.scales), rtol=1e-5)
    quats = np.roll(floats(found.pop(f"{NAME}:ROTATION"), count, 4), 1, axis=1)
    np.testing.assert_allclose(np.abs((quats * wanted.quats).sum(axis=1)), 1, atol=1e-6)
    opacities = 1 / (1 + np.exp(-wanted.opacities[:, None].astype(float)))
    colours = np.concatenate([SH_C0 * wanted.sh0 + 0.5, opacities], axis=1).clip(0, 1) * 255
    np.testing.assert_allclose(floats(found.pop("COLOR_0"), count, 4), colours, atol=1)  # it rounds down
    assert len(found) == wanted.shN.shape[1]
    for name, values in found.items():
        band, i = (int(part) for part in name.removeprefix(f"{NAME}:SH_DEGREE_").split("_COEF_"))
        np.testing.assert_array_equal(floats(values, count, 3), wanted.shN[:, band * band - 1 + i])


@needs_foreign_formats
@pytest.mark.parametrize("writer", [write_glb, write_spz_glb])
@pytest.mark.parametrize("degree", [0, 3])
@pytest.mark.quick(2)
def test_the_validator_finds_no_error(writer, degree, tmp_path):
    """Khronos' validator knows neither extension, and takes names of attributes with a colon as errors."""
    messages = foreign("validate-glb", written(writer, made_scene(65, degree), tmp_path / "a.glb"))
    unknown = {
        "UNSUPPORTED_EXTENSION": "/extensionsUsed/",
        "MESH_PRIMITIVE_INVALID_ATTRIBUTE": f"/meshes/0/primitives/0/attributes/{NAME}:",
        "UNUSED_OBJECT": "/bufferViews/0" if writer is write_spz_glb else "none",
    }
    assert messages
    for message in messages:
        assert message["pointer"].startswith(unknown.get(message["code"], "none")), message
