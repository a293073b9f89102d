"""Oracle: a naive writer (helpers/reference_spz.py), and bytes decoded by hand."""

import gzip
import struct

import numpy as np
import pytest
from helpers.format_scenes import made_scene
from helpers.memory import takes_less_than
from helpers.reference_gltf import glb_bytes, spz_document
from helpers.reference_spz import FLIPS, frame, spz_bytes, streams, v4_file

from kissgs.core.errors import InvalidSceneError, UnsupportedError
from kissgs.core.splats import ATTRIBUTES
from kissgs.io.gltf import read_gltf
from kissgs.io.scene_format import Match, ReadOptions
from kissgs.io.spz import FORMAT, SpzInfo, read_spz, read_spz_info


def one(version, *, position=bytes(9), alpha=b"\0", color=bytes(3), scale=bytes(3), rotation=None, sh=b"", bits=12):
    """Return a file of one Gaussian of these bytes."""
    rotation = bytes(3 if version < 3 else 4) if rotation is None else rotation
    degree = {0: 0, 9: 1, 24: 2, 45: 3}[len(sh)]
    header = struct.pack("<4sIIBBBB", b"NGSP", version, 1, degree, bits, 0, 0)
    parts = [position, alpha, color, scale, rotation, sh]
    return v4_file(header, [p for p in parts if p]) if version == 4 else gzip.compress(header + b"".join(parts))


def test_positions_by_hand():
    data = one(2, position=bytes.fromhex("00f0ff 000800 ffff7f"))
    np.testing.assert_array_equal(read_spz(data, ReadOptions(raw_axes=True)).means, [[-1, 0.5, 2048 - 2**-12]])
    np.testing.assert_array_equal(read_spz(data).means, [[-1, -0.5, -(2048 - 2**-12)]])


@pytest.mark.parametrize(
    ("version", "rotation", "xyzw"),
    [
        (2, "8c66a6", (0.0980392, -0.2, 0.3019608, 0.9269347)),
        (3, "d9448ac4", (0.0996315, -0.2006467, 0.3002782, 0.9271717)),
        (4, "d9448ac4", (0.0996315, -0.2006467, 0.3002782, 0.9271717)),
    ],
)
def test_rotations_by_hand(version, rotation, xyzw):
    x, y, z, w = xyzw
    data = one(version, rotation=bytes.fromhex(rotation))
    np.testing.assert_allclose(read_spz(data, ReadOptions(raw_axes=True)).quats, [[w, x, y, z]], atol=1e-7)
    np.testing.assert_allclose(read_spz(data).quats, [[w, x, -y, -z]], atol=1e-7)


def test_bytes_by_hand():
    splats = read_spz(one(3, alpha=b"\xc8", color=bytes([0, 128, 255]), scale=bytes([0, 96, 255]), sh=bytes([120] * 9)))
    np.testing.assert_allclose(splats.sh0, [[-3.333333, 0.0130719, 3.333333]], rtol=1e-5)
    np.testing.assert_array_equal(splats.scales, [[-10, -4, 5.9375]])
    assert splats.opacities[0] == pytest.approx(1.2909842)
    np.testing.assert_array_equal(np.abs(splats.shN), np.full((1, 3, 3), 0.0625))
    for alpha, logit in ((0, -13.8155), (255, 13.8023)):
        assert read_spz(one(2, alpha=bytes([alpha]))).opacities[0] == pytest.approx(logit, abs=1e-4)


def storable(scene):
    """Return the scene with attributes that the format can hold, so that only rounding remains."""
    np.clip(scene.means, -2000, 2000, out=scene.means)
    np.clip(scene.scales, -10, 5.9, out=scene.scales)
    np.clip(scene.sh0, -3.3, 3.3, out=scene.sh0)
    np.clip(scene.shN, -0.99, 0.99, out=scene.shN)
    return scene


@pytest.mark.parametrize("version", [1, 2, 3, 4])
@pytest.mark.parametrize("degree", [0, 1, 2, 3])
@pytest.mark.parametrize("count", [1, 65])
def test_within_half_a_step(version, degree, count):
    scene = storable(made_scene(count, degree))
    data = spz_bytes(scene, version, flags=1)
    found = read_spz(data)
    assert read_spz_info(data) == SpzInfo(
        version=version,
        count=count,
        sh_degree=degree,
        stored_degree=degree,
        fractional_bits=12,
        antialiased=True,
        extensions=False,
    )
    assert FORMAT.sniff(data[:512], len(data)) == Match.SURE
    np.testing.assert_allclose(found.means, scene.means, rtol=1e-3 if version == 1 else 0, atol=2**-13 * 1.01)
    np.testing.assert_allclose(found.scales, scene.scales, atol=1 / 32 * 1.01)
    np.testing.assert_allclose(found.sh0, scene.sh0, atol=0.5 / 255 / 0.15 * 1.01)
    np.testing.assert_allclose(found.shN, scene.shN, atol=0.5 / 128 * 1.01)
    angle = 2 * np.arccos(np.clip(np.abs((found.quats.astype(float) * scene.quats).sum(axis=1)), 0, 1))
    # Close to half a turn, w of three bytes is the root of a small difference.
    assert angle.max() < (0.3 if version < 3 else 0.01)


@pytest.mark.parametrize("version", [3, 4])
def test_band_4_is_left_out(version):
    scene = storable(made_scene(65, 3))
    parts = streams(scene, version)
    parts[5] = b"".join(parts[5][45 * i : 45 * (i + 1)] + bytes(range(27)) for i in range(65))
    header = struct.pack("<4sIIBBBB", b"NGSP", version, 65, 4, 12, 0, 0)
    data = v4_file(header, parts) if version == 4 else gzip.compress(header + b"".join(parts))
    found, wanted = read_spz(data), read_spz(spz_bytes(scene, version))
    for name in ATTRIBUTES:
        np.testing.assert_array_equal(getattr(found, name), getattr(wanted, name))
    info = read_spz_info(data)
    assert (info.sh_degree, info.stored_degree) == (3, 4)
    assert found.notes == ("left out: the SH coefficients of degree 4",)
    inside = read_gltf(glb_bytes(*spz_document(data, 65)))
    assert inside.notes == found.notes


def test_no_gaussians():
    for version in (1, 2, 3, 4):
        assert len(read_spz(spz_bytes(made_scene(0, 2), version))) == 0


def test_fewer_fractional_bits():
    scene = storable(made_scene(30, 0))
    scene.means[:] *= 100
    found = read_spz(spz_bytes(scene, 3, bits=5))
    np.testing.assert_allclose(found.means, scene.means, atol=2**-6 * 1.01)


def extension(kind, payload):
    return struct.pack("<II", kind, len(payload)) + payload


@pytest.mark.parametrize("version", [2, 3, 4])
def test_an_extension_names_the_axes(version):
    scene = storable(made_scene(65, 3))
    orbit = extension(0xADBE0002, bytes(12))
    for value, y_up in ((0, True), (4, True), (6, False)):
        more = orbit + extension(0xADBE0003, struct.pack("<I", value))
        found = read_spz(spz_bytes(scene, version, y_up=y_up, extensions=more))
        np.testing.assert_allclose(found.means, scene.means, atol=2**-13 * 1.01)
        np.testing.assert_allclose(found.shN, scene.shN, atol=0.5 / 128 * 1.01)


def test_flips_turn_the_axes_half_about_x():
    raw, turned = (
        read_spz(spz_bytes(storable(made_scene(65, 3)), 3), ReadOptions(raw_axes=raw)) for raw in (True, False)
    )
    np.testing.assert_array_equal(turned.means, raw.means * [1, -1, -1])
    np.testing.assert_array_equal(turned.quats, raw.quats * [1, 1, -1, -1])
    signs = np.array([sign for band in FLIPS for sign in band])
    np.testing.assert_array_equal(turned.shN, raw.shN * signs[None, :, None])


SCENE = made_scene(20, 1)
V3, V4 = spz_bytes(SCENE, 3), spz_bytes(SCENE, 4)
HEADER = gzip.decompress(V3)[:16]


def with_header(offset, value):
    data = gzip.decompress(V3)
    return gzip.compress(data[:offset] + value + data[offset + len(value) :])


DAMAGED = {
    b"": "is not an .spz file: its header is missing; export or download it again",
    gzip.compress(b"hello"): "is not an .spz file: its header is missing; export or download it again",
    with_header(4, b"\5"): "is .spz of version 5 in gzip; versions 1 to 3 in gzip and 4 without are read",
    with_header(4, b"\4"): "is .spz of version 4 in gzip; versions 1 to 3 in gzip and 4 without are read",
    gzip.decompress(V3): "is .spz of version 3; versions 1 to 3 in gzip and 4 without are read",
    with_header(12, b"\5"): "has SH degree 5; export it with degree 3 or lower",
    with_header(14, b"\x80"): "holds Spark's levels of detail, coarse Gaussians among the fine ones; export it without",
    with_header(13, b"\x20"): "has 32 fractional bits of positions; 31 are the most; export or",
    V3[:-30]: "is cut short: it unpacks to",
    V3[:60] + bytes(40) + V3[100:]: "is damaged: gzip cannot unpack it; export or download it again",
    with_header(8, b"\x15"): "is cut short: it unpacks to 596 bytes of 625; export or download it again",
    with_header(8, b"\0\0\0\1"): "bytes cannot hold what its header declares; export or download it again",
    gzip.compress(
        gzip.decompress(V3) + bytes(1 << 21)
    ): "is damaged: it unpacks to more bytes than its header declares; export or",
    V4[:40]: "is cut short: it needs",
    V4[:-1]: "is cut short or damaged: its streams do not end at its last byte; export or download it again",
    V4[:15] + b"\5" + V4[16:]: "has 5 streams, where SH degree 1 needs 6; export or",
    V4[:8] + b"\x15" + V4[9:]: "declares 180 bytes of positions for 21 Gaussians; export or",
    V4[:16] + b"\xff\xff\xff\xff" + V4[20:]: "is damaged: its table of streams is at byte 4,294,967,295; export",
    V4[:-300] + bytes(300): "is damaged: zstd cannot unpack it; download the file again",
}


@pytest.mark.parametrize(("data", "message"), list(DAMAGED.items()), ids=list(DAMAGED.values()))
def test_damaged(data, message):
    with pytest.raises((InvalidSceneError, UnsupportedError)) as error:
        read_spz(data)
    assert message in str(error.value)


def test_streams_of_a_wrong_size():
    parts = streams(SCENE, 4)
    for part in (parts[0] + b"\0", parts[0][:-1], b""):
        frames = [frame(part), *map(frame, parts[1:])]
        table = b"".join(struct.pack("<QQ", len(f), len(p)) for f, p in zip(frames, parts, strict=True))
        data = HEADER[:4] + b"\4\0\0\0" + HEADER[8:15] + b"\6" + struct.pack("<I", 32) + bytes(12)
        with pytest.raises(InvalidSceneError, match=r"stream of positions is damaged"):
            read_spz(data + table + b"".join(frames))


@pytest.mark.parametrize("version", [2, 3, 4])
def test_unknown_extensions_are_named(version):
    records = struct.pack("<IIfff", 0xADBE0002, 12, 0, 1, 2) + struct.pack("<IIH", 0x12345678, 2, 7)
    axes = struct.pack("<III", 0xADBE0003, 4, 6)
    found = read_spz(spz_bytes(made_scene(5, 0), version, flags=2, extensions=records + axes))
    assert found.notes == ("left out: the limits of the camera, the extension record 0x12345678",)
    assert read_spz(spz_bytes(made_scene(5, 0), version, flags=2, extensions=axes)).notes == ()


def test_an_extension_that_is_cut_short():
    for damaged in (extension(0xADBE0003, b"")[:4] + b"\xff\0\0\0", struct.pack("<II", 7, 100)):
        with pytest.raises(InvalidSceneError, match=r"has an extension record that is cut short"):
            read_spz(spz_bytes(SCENE, 3, extensions=damaged))
    with pytest.raises(UnsupportedError, match=r"names a coordinate system 9, which is not read; export it with y up"):
        read_spz(spz_bytes(SCENE, 4, extensions=extension(0xADBE0003, struct.pack("<I", 9))))


def test_more_gaussians_than_the_limit_take_no_memory():
    """Five million Gaussians of zeros are a few kilobytes of gzip, and fewer of zstd."""
    count = 5_000_000
    header = struct.pack("<4sIIBBBB", b"NGSP", 3, count, 0, 12, 0, 0)
    bomb = gzip.compress(header + bytes(count * 20))

    def refused():
        with pytest.raises(UnsupportedError, match=r"has 5,000,000 Gaussians; the limit is 1,000,000"):
            read_spz(bomb, ReadOptions(max_gaussians=1_000_000))

    assert takes_less_than(1e6, refused)
