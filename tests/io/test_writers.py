"""Writers of scene formats, and the table of formats. Oracles: naive writers and parsers (helpers/reference_*.py),
bytes encoded by hand, codecs and pages."""

import gzip
import io
import json
import struct
from pathlib import Path

import numpy as np
import pytest
from helpers.format_scenes import assert_alike, made_scene
from helpers.reference_compressed_ply import SH_C0, compressed_bytes
from helpers.reference_gltf import NAME, SPZ, attributes, parse_glb
from helpers.reference_splat import splat_bytes
from helpers.reference_spz import streams

from kissgs.core.context import silent
from kissgs.core.errors import UnsupportedError
from kissgs.core.splats import ATTRIBUTES, Splats, blocks, clean
from kissgs.formats import ENDINGS, FORMATS, MANIFESTS, SCENE_ENDINGS, WRITTEN, named_container
from kissgs.io import gltf
from kissgs.io.conventions import morton_order
from kissgs.io.scene_format import DEFAULT_READ_OPTIONS
from kissgs.io.splat import ROW
from kissgs.io.spz import (
    encode_colors,
    encode_scales,
    encode_sh,
    encode_smallest_three,
    fractional_bits_for,
    read_spz_info,
)
from kissgs.pipeline.scene_files import write_scene

CODECS = {ending: each.codec for each in FORMATS.values() for ending in each.written if not each.is_container}
CLEANED = [ending for ending in CODECS if ending != ".ply"]
"""Endings of formats that hold a clean scene, not any numbers."""


def written(splats, ending, **options):
    """Return a file of the scene, and the notes."""
    file = io.BytesIO()
    notes = write_scene(file, splats, ending.removeprefix("."), **options)
    return file.getvalue(), notes


def read(data, ending):
    return CODECS[ending].read(data, DEFAULT_READ_OPTIONS, 1, silent)


def replaced(splats, **arrays):
    return Splats(**{name: arrays.get(name, getattr(splats, name)) for name in ATTRIBUTES})


@pytest.mark.parametrize("ending", CLEANED)
def test_extreme_values_are_cleaned_and_written_without_a_warning(ending):
    scene = made_scene(300, 1)
    scene.means[:4] = [[1e15, -1e15, 1e-40], [np.inf, 0, 0], [0, np.nan, 0], [0, 0, 0]]
    scene.scales[4:6] = [[30, 30, 30], [-np.inf, 30, -30]]
    scene.sh0[6] = 1e30
    scene.opacities[:2] = [-np.inf, np.inf]
    found = read(written(scene, ending)[0], ending)
    if ending == ".glb":
        assert_alike(found, clean(scene)[0], rtol=1e-6, opacities=0.1)
    found = clean(found)[0]
    assert len(found) == 298
    assert all(np.isfinite(getattr(found, name)).all() for name in ATTRIBUTES)
    assert found.means.max() == np.float32(1e15 if "spz" not in ending else (1 << 23) - 1)


@pytest.mark.parametrize("ending", CLEANED)
def test_bytes_are_the_same_again_and_the_scene_is_unchanged(ending):
    scene = clean(made_scene(70, 3))[0]
    before = {name: getattr(scene, name).copy() for name in ATTRIBUTES}
    data = written(scene, ending)[0]
    assert data == written(scene, ending)[0]
    for name, values in before.items():
        np.testing.assert_array_equal(getattr(scene, name), values)
    if ending == ".spz":
        assert data[:4] == b"\x1f\x8b\x08\0"
        assert struct.unpack_from("<I", data, 4) == (0,), "gzip's time"


# The compressed .ply.


def dicts(splats):
    """Return the Gaussians as the naive writer takes them."""
    rest = splats.shN.transpose(0, 2, 1).reshape(len(splats), 3 * splats.shN.shape[1])
    return [
        {
            "position": splats.means[i].tolist(),
            "quat": splats.quats[i].tolist(),
            "log_scale": np.clip(splats.scales[i], -20, 20).tolist(),
            "rgb": [0.5 + SH_C0 * float(v) for v in splats.sh0[i]],
            "opacity": float(1 / (1 + np.exp(-splats.opacities[i].astype(float)))),
            "rest": rest[i].tolist(),
        }
        for i in range(len(splats))
    ]


@pytest.mark.parametrize(("count", "degree"), [(0, 2), (1, 0), (256, 1), (257, 2), (700, 3)])
def test_compressed_ply_has_the_bytes_of_the_reference(count, degree):
    """A few steps differ by one where a half is rounded, or a colour's bound is rounded to a float."""
    scene = clean(made_scene(count, degree))[0]
    scene = scene.select(morton_order(scene.means))
    data, _ = written(scene, ".compressed.ply")
    wanted = compressed_bytes(dicts(scene), 3 * scene.shN.shape[1])
    assert len(data) == len(wanted)
    head = data.index(b"end_header\n") + 11
    assert data[:head] == wanted[:head]
    body = slice(head + 72 * -(-count // 256), None)
    same = np.frombuffer(data[body], np.uint8) == np.frombuffer(wanted[body], np.uint8)
    assert count == 0 or same.mean() > 0.99
    found, theirs = (read(each, ".compressed.ply") for each in (data, wanted))
    assert_alike(found, theirs, atol=0.02 if count else 0, rtol=1e-3, opacities=20)


def test_chunks_are_close_together():
    """Random order would give steps of the whole scene; an outlier must not coarsen the order of the others."""
    scene = made_scene(20_000, 0, extremes=False)
    scene.means[7] = 1e12
    order = morton_order(scene.means)
    assert sorted(order.tolist()) == list(range(20_000))
    edges = [np.ptp(scene.means[order[start : start + 256]], axis=0).mean() for start in range(0, 19_000, 256)]
    assert np.median(edges) < 0.25 * np.ptp(np.delete(scene.means, 7, axis=0), axis=0).mean()
    np.testing.assert_array_equal(morton_order(np.ones((9, 3), np.float32)), np.arange(9))  # equal places


def test_notes_of_compressed_ply():
    scene = clean(made_scene(20, 1, extremes=False))[0]
    assert written(scene, ".compressed.ply")[1] == ()
    scene.scales[0] = 25
    scene.shN[3:5] = -5
    assert written(scene, ".compressed.ply")[1] == (
        "scales of 1 Gaussian are clamped to e^±20",
        "view-dependent colours of 2 Gaussians are clamped to coefficients of ±4",
    )


# .splat


@pytest.mark.parametrize(("count", "degree"), [(1, 0), (65, 1), (600, 3)])
def test_rows_of_splat_are_those_of_the_reference(count, degree, monkeypatch):
    """Compared as a set: floats differ in their last bit, bytes where a half is rounded."""
    monkeypatch.setattr(blocks, "__defaults__", (100,))
    scene = clean(made_scene(count, degree))[0]
    found = np.frombuffer(written(scene, ".splat")[0], ROW)
    wanted = np.frombuffer(splat_bytes(scene), ROW)
    found, wanted = (rows[np.lexsort(rows["means"].T)] for rows in (found, wanted))
    np.testing.assert_array_equal(found["means"], wanted["means"])
    np.testing.assert_allclose(found["scales"], wanted["scales"], rtol=1e-6)
    for name in ("rgba", "quats"):
        assert np.abs(found[name].astype(int) - wanted[name]).max(initial=0) <= 1
        assert (found[name] == wanted[name]).mean() > 0.99


def test_large_and_opaque_gaussians_come_first():
    scene = clean(made_scene(600, 0, extremes=False))[0]
    scene.opacities[:] = np.linspace(-1, 3, 600)  # where rounding changes little
    found = read(written(scene, ".splat")[0], ".splat")
    weight = np.exp(found.scales.sum(axis=1)) / (1 + np.exp(-found.opacities))
    assert (np.diff(weight) <= 0.01 * weight[:-1]).all()
    same = scene.select(np.zeros(300, int))
    same.means[:, 0] = np.arange(300)
    np.testing.assert_array_equal(read(written(same, ".splat")[0], ".splat").means[:, 0], np.arange(300))


def test_notes_of_splat():
    scene = clean(made_scene(20, 0, extremes=False))[0]
    scene.sh0[:] = 0.5 / SH_C0
    assert written(scene, ".splat")[1] == ()
    scene.sh0[:2] = [[1.8, 0, 0], [-1.8, 0, 0]]
    assert written(scene, ".splat")[1] == ("colours of 2 Gaussians are clamped to 0 to 1",)
    notes = written(made_scene(20, 2, extremes=False), ".splat")[1]
    assert notes[0] == "view-dependent colour (SH degree 2) is left out"


# .spz


@pytest.mark.parametrize(
    ("degree", "count", "raw_axes"), [(0, 1, False), (1, 65, True), (2, 1, True), (3, 65, False), (3, 65, True)]
)
def test_all_streams_of_spz_but_sh_are_those_of_the_reference(degree, count, raw_axes):
    scene = made_scene(count, degree)
    scene.quats[:4] = np.float32([0.9, 0.1, 0.3, -0.3])  # no two components equally large
    data, _ = written(scene, ".spz", raw_axes=raw_axes)
    bits = fractional_bits_for(float(np.abs(scene.means).max()))
    info = read_spz_info(data)
    assert (info.version, info.count, info.sh_degree, info.fractional_bits) == (3, count, degree, bits)
    assert not info.antialiased
    assert not info.extensions
    body = gzip.decompress(data)[16:]
    for wanted in streams(clean(scene)[0], 3, bits, not raw_axes)[:5]:
        # The reference rounds halves to even.
        found, body = np.frombuffer(body[: len(wanted)], np.uint8), body[len(wanted) :]
        assert np.abs(found.astype(int) - np.frombuffer(wanted, np.uint8)).max(initial=0) <= 1
        assert (found == np.frombuffer(wanted, np.uint8)).mean() > 0.99
    assert len(body) == 3 * count * (0, 3, 8, 15)[degree]


def test_values_of_spz_by_hand():
    """The examples of the specification's table."""
    quat = np.float32([[0.9273618, 0.1, -0.2, 0.3]])
    assert encode_smallest_three(quat).tobytes() == bytes.fromhex("d9448ac4")
    assert encode_smallest_three(-quat).tobytes() == bytes.fromhex("d9448ac4")
    np.testing.assert_array_equal(encode_colors(np.float32([[-10 / 3, 0.0130719, 10 / 3]])), [[0, 128, 255]])
    np.testing.assert_array_equal(encode_scales(np.float32([[-10, -4, 5.9375]])), [[0, 96, 255]])
    np.testing.assert_array_equal(encode_scales(np.float32([[-30, 30, -10.1]])), [[0, 255, 0]])
    low = np.float32([[[-0.0625, 0, 1], [-1, -1e6, 1e6], [0.02, 0.04, -0.04], [0.0625, 0.0624, -0.0626]]])
    wanted = [120, 128, 255, 0, 0, 255, 132, 132, 124, 136, 136, 120]
    np.testing.assert_array_equal(encode_sh(low), [wanted])
    scene = replaced(made_scene(1, 0), means=np.float32([[-1, 0.5, 2048 - 2**-12]]))
    data = gzip.decompress(written(scene, ".spz", raw_axes=True)[0])
    assert data[16:25] == bytes.fromhex("00f0ff 000800 ffff7f")
    scene = replaced(made_scene(2, 0), opacities=np.float32([-np.inf, np.inf]))
    data = written(scene, ".spz")[0]
    assert gzip.decompress(data)[16 + 18 : 16 + 20] == b"\x00\xff"
    np.testing.assert_allclose(read(data, ".spz").opacities, clean(scene)[0].opacities)


@pytest.mark.parametrize(
    ("reach", "bits"),
    [(2047.9, 12), (2048, 11), (4096, 10), (5, 12), (3.9, 13), (1e-9, 23), (0, 15), (8.3e6, 0), (1e15, 0)],
)
def test_fractional_bits_follow_the_extent(reach, bits):
    assert fractional_bits_for(reach) == bits


@pytest.mark.parametrize("reach", [0.01, 100, 2048, 8e6])
def test_spz_of_scenes_of_any_extent(reach):
    scene = made_scene(100, 0, extremes=False)
    scene.means[:] = scene.means / np.abs(scene.means).max() * np.float32(reach)
    data, notes = written(scene, ".spz")
    bits = read_spz_info(data).fractional_bits
    # The largest code has no step above it.
    np.testing.assert_allclose(read(data, ".spz").means, scene.means, atol=2.0**-bits, rtol=1e-7)
    assert reach / 2.0**-bits >= 2**14
    assert bool(notes) == (reach >= 2048)


def test_notes_of_spz():
    scene = clean(made_scene(20, 1, extremes=False))[0]
    assert written(replaced(scene, shN=np.clip(scene.shN, -1, 0.9)), ".spz")[1] == ()
    scene.means[0] = 3e4
    scene.means[1] = -1e14
    scene.scales[:3] = [[-11, 0, 0], [0, 6, 0], [-10, 0, 5.95]]
    scene.sh0[:2] = [[4, 0, 0], [-3.35, 0, 0]]
    scene.shN[:] = 0
    scene.shN[5] = 1.5
    assert written(scene, ".spz")[1] == (
        "positions have steps of 1, because the scene reaches 100,000,000,376,832 from the origin",
        "positions of 1 Gaussian are clamped to ±8,388,607",
        "scales of 2 Gaussians are clamped to e^-10 to e^5.94",
        "colours of 2 Gaussians are clamped to coefficients of ±3.33",
        "view-dependent colours of 1 Gaussian are clamped to coefficients of ±1",
    )


# .glb


@pytest.mark.parametrize(("count", "degree"), [(1, 0), (65, 1), (3, 2), (65, 3)])
def test_a_naive_parser_finds_the_scene_in_glb(count, degree):
    scene = clean(made_scene(count, degree))[0]
    data, notes = written(scene, ".glb")
    assert notes == ()
    root, columns = parse_glb(data)
    colours = np.array(columns.pop("COLOR_0"))
    wanted = attributes(scene)
    assert set(columns) == set(wanted)
    for name, rows in wanted.items():
        np.testing.assert_allclose(columns[name], rows, rtol=1e-6, atol=1e-7, err_msg=name)
    srgb = np.clip(0.5 + SH_C0 * scene.sh0.astype(float), 0, 1)
    np.testing.assert_allclose(np.round((colours[:, :3] / 255) ** (1 / 2.2), 1), np.round(srgb, 1), atol=0.11)
    np.testing.assert_allclose(colours[:, 3:] / 255, columns[f"{NAME}:OPACITY"], atol=0.51 / 255)
    (primitive,) = root["meshes"][0]["primitives"]
    assert primitive["mode"] == 0
    assert primitive["extensions"][NAME]["kernel"] == "ellipse"
    assert primitive["extensions"][NAME]["colorSpace"] == "srgb_rec709_display"
    assert root["extensionsUsed"] == [NAME]
    assert root["accessors"][primitive["attributes"]["COLOR_0"]]["normalized"] is True


@pytest.mark.parametrize("ending", [".glb", ".spz.glb"])
def test_glb_ends_at_4_gib(ending, monkeypatch):
    size = len(written(made_scene(5, 1), ending)[0])
    monkeypatch.setattr(gltf, "MAX_GLB_BYTES", size)
    assert struct.unpack_from("<I", written(made_scene(5, 1), ending)[0], 8) == (size,)
    monkeypatch.setattr(gltf, "MAX_GLB_BYTES", size - 1)
    with pytest.raises(UnsupportedError, match=r"^5 Gaussians take [\d,]+ bytes, and \.glb ends at 4 GiB; write"):
        written(made_scene(5, 1), ending)


@pytest.mark.parametrize(("count", "degree"), [(1, 0), (65, 1), (66, 3)])
def test_spz_inside_glb(count, degree):
    """The file is a GLB around the bytes of the .spz, whose losses are those of the file."""
    scene = clean(made_scene(count, degree))[0]
    (data, notes), (packed, losses) = (written(scene, ending) for ending in (".spz.glb", ".spz"))
    assert notes == losses
    stated = CODECS[".glb"].info(data, 0)
    assert (stated.count, stated.sh_degree) == (count, degree)
    assert stated.details == {"binary": True, "primitives": 1, "spz": True, "antialiased": False}
    size, text = struct.unpack_from("<II", data, 8)
    assert size == len(data)
    root = json.loads(data[20 : 20 + text])
    (view,) = root["bufferViews"]
    assert root["buffers"] == [{"byteLength": view["byteLength"]}]
    body = data[28 + text :]
    assert body == packed + bytes(-len(packed) % 4)
    assert struct.unpack_from("<I4s", data, 20 + text) == (len(body), b"BIN\0")
    assert root["extensionsRequired"] == root["extensionsUsed"] == [NAME, SPZ]
    means = read(data, ".glb").means * [-1, -1, 1]
    assert root["accessors"][0]["min"] == means.min(axis=0).tolist()
    assert root["accessors"][0]["max"] == means.max(axis=0).tolist()
    assert all("bufferView" not in accessor for accessor in root["accessors"])


PAGES = [Path(__file__).parents[2] / page for page in ("docs/reference/formats.md", "web_decoder/preview.html")]


@pytest.mark.parametrize("name", FORMATS)
def test_a_line_says_what_its_module_can_do(name):
    line = FORMATS[name]
    assert [*line.codec.write] == ([] if line.is_container else [*line.written])
    assert line.manifest is None or MANIFESTS[line.manifest] == name.removeprefix("streamed-")


def test_pages_name_the_endings():
    reference, preview = (page.read_text() for page in PAGES)
    assert all(f"`{ending}`" in reference for ending in (*SCENE_ENDINGS, *WRITTEN, *ENDINGS))
    (offered,) = (line for line in preview.splitlines() if "accept=" in line)
    assert {*offered.split('"')[1].split(",")} <= {*SCENE_ENDINGS, *ENDINGS}


def test_the_refusal_of_an_unknown_ending_names_all_that_are_written():
    with pytest.raises(Exception, match="is not the name of a container") as caught:
        named_container(None, "out.xyz")
    assert all(ending in str(caught.value) for ending in (*ENDINGS, *MANIFESTS, ".sogxt"))
