"""Oracle: a naive writer (helpers/reference_splat.py), and bytes decoded by hand."""

import struct

import numpy as np
import pytest
from helpers.format_scenes import made_scene
from helpers.reference_splat import SH_C0, ksplat_bytes, splat_bytes

from kissgs.core.errors import InvalidSceneError, UnsupportedError
from kissgs.core.splats import Splats, blocks, clean
from kissgs.io import splat
from kissgs.io.ksplat import FORMAT, read_ksplat
from kissgs.io.scene_format import Match
from kissgs.io.splat import read_splat


def test_one_row_by_hand():
    row = struct.pack("<6f", 1, 2, 3, 0.5, 0.25, 0.125) + bytes.fromhex("ff8000c8 c0a06080")
    splats = read_splat(row)
    np.testing.assert_array_equal(splats.means, [[1, 2, 3]])
    np.testing.assert_allclose(splats.scales, np.log([[0.5, 0.25, 0.125]]), rtol=1e-7)
    np.testing.assert_allclose(splats.quats, np.array([[0.5, 0.25, -0.25, 0]]) / np.sqrt(0.375), rtol=1e-6)
    assert splats.sh0[0, 0] == pytest.approx(1.7724539)
    assert splats.opacities[0] == pytest.approx(1.2909842)
    assert splats.sh_degree == 0


def test_opacities_0_and_1_and_scales_of_0():
    rows = struct.pack("<6f", 0, 0, 0, 0, 1, -1) + bytes([0, 0, 0, 0, 128, 128, 128, 128])
    rows += struct.pack("<6f", 0, 0, 0, 1, 1, 1) + bytes([0, 0, 0, 255, 255, 128, 128, 128])
    splats = read_splat(rows)
    np.testing.assert_allclose(splats.opacities, [-13.8155, 13.8023], atol=1e-4)
    assert splats.scales[0, 0] == -np.inf
    assert np.isnan(splats.scales[0, 2]), "a negative size is no size"
    np.testing.assert_array_equal(splats.quats[0], 0)
    cleaned, changes = clean(splats)
    assert (changes.non_finite, changes.infinite_opacities, len(cleaned)) == (1, 0, 1)


@pytest.mark.parametrize("count", [0, 1, 65, 600])
def test_splat_within_half_a_step(count, monkeypatch):
    monkeypatch.setattr(blocks, "__defaults__", (100,))
    scene = made_scene(count, 0)
    found = read_splat(splat_bytes(scene))
    assert splat.FORMAT.info(splat_bytes(scene), 0).count == len(found) == count
    np.testing.assert_array_equal(found.means, scene.means)
    np.testing.assert_allclose(found.scales, scene.scales, rtol=1e-5, atol=1e-6)
    visible = np.clip(scene.sh0 * SH_C0 + 0.5, 0, 1)
    np.testing.assert_allclose(found.sh0 * SH_C0 + 0.5, visible, atol=0.5 / 255 * 1.01)
    assert (np.abs((found.quats * scene.quats).sum(axis=1)) > 1 - 2e-4).all()


@pytest.mark.parametrize("size", [1, 31, 33])
def test_splat_of_a_wrong_size(size):
    message = rf"^the data is no \.splat file or is cut short: its {size} bytes are no multiple of 32; "
    with pytest.raises(InvalidSceneError, match=message):
        read_splat(bytes(size))


def test_a_position_of_level_1_by_hand():
    scene = made_scene(1, 0)
    data = bytearray(ksplat_bytes([scene], 1))
    start = 4096 + 1024 + 4  # behind the headers and the length of the bucket
    data[start : start + 18] = struct.pack("<3f3H", 10, 20, 30, 32867, 32767, 32667)
    np.testing.assert_allclose(read_ksplat(bytes(data)).means, [[10.00763, 20, 29.99237]], rtol=1e-6)


TOLERANCE = {0: 1e-6, 1: 2e-3, 2: 0.5 * 3 / 255 * 1.01}


def inside(scene):
    """Return a scene of attributes that all levels can hold."""
    middle = scene.means / np.abs(scene.means).max() * 2
    arrays = {"scales": np.clip(scene.scales, -8, 3), "shN": np.clip(scene.shN, -1.5, 1.5), "means": middle}
    return Splats(quats=scene.quats, opacities=scene.opacities, sh0=scene.sh0, **arrays)


@pytest.mark.parametrize("level", [0, 1, 2])
@pytest.mark.parametrize(("degree", "counts"), [(0, (1,)), (1, (600,)), (2, (65, 300)), (3, (600,))])
def test_ksplat_within_half_a_step(level, degree, counts):
    scenes = [inside(made_scene(count, degree)) for count in counts]
    data = ksplat_bytes(scenes, level, unused=2)
    found = read_ksplat(data)
    stated = FORMAT.info(data, 0)
    assert (stated.count, stated.sh_degree) == (sum(counts), degree)
    assert stated.details == {"compression_level": level, "sections": len(counts)}
    assert FORMAT.sniff(data[:512], len(data)) == Match.LIKELY
    wanted = {name: np.concatenate([getattr(s, name) for s in scenes]) for name in ("means", "scales", "quats", "shN")}
    np.testing.assert_allclose(found.means, wanted["means"], atol=1e-6 if level == 0 else 2.5 / 32767)
    np.testing.assert_allclose(found.scales, wanted["scales"], atol=1e-6 if level == 0 else 1e-3)
    np.testing.assert_allclose(found.quats, wanted["quats"], atol=1e-6 if level == 0 else 1e-3)
    np.testing.assert_allclose(found.shN, wanted["shN"], atol=TOLERANCE[level])


def test_sections_of_different_degrees():
    found = read_ksplat(ksplat_bytes([made_scene(5, 1), made_scene(6, 2), made_scene(0, 0)], 0))
    assert found.sh_degree == 2
    np.testing.assert_array_equal(found.shN[:5, 3:], 0)
    np.testing.assert_array_equal(found.shN[5:], made_scene(6, 2).shN)


def test_the_range_of_bytes_is_in_the_header():
    scene = inside(made_scene(20, 1))
    found = read_ksplat(ksplat_bytes([scene], 2, sh_range=(-2, 6)))
    np.testing.assert_allclose(found.shN, scene.shN, atol=8 / 255 / 2 * 1.01)


GOOD = ksplat_bytes([made_scene(300, 1)], 1)


def overwritten(offset, value):
    return GOOD[:offset] + value + GOOD[offset + len(value) :]


DAMAGED = {
    b"": "is cut short: it needs 4,096 bytes but has 0; export or download it again",
    GOOD[:5000]: "is cut short: it needs 5,120 bytes but has 5,000; export or download it again",
    GOOD[:-1]: f"is cut short: it needs {len(GOOD):,} bytes but has {len(GOOD) - 1:,}; export or download it again",
    overwritten(1, b"\2"): "is .ksplat of version 0.2; 0.1 is read: export it again",
    overwritten(20, b"\3"): "has compression level 3; levels 0 to 2 are read",
    overwritten(8, b"\2"): "declares 2 sections with room for 1; export or download it again",
    overwritten(16, b"\1"): "declares 257 Gaussians, but its sections have 300; export or download it again",
    overwritten(
        36, struct.pack("<f", np.inf)
    ): "has a range of SH coefficients that is not finite; export or download it again",
    overwritten(4096, b"\xff\xff"): "section 1: it declares 65,535 Gaussians with room for 300; export it again",
    overwritten(4108, b"\xff"): "section 1: its buckets contradict each other; export or download the scene again",
    overwritten(4136, b"\4"): "section 1 has SH degree 4; export it with degree 3 or lower",
    overwritten(5120, b"\0"): "has a section whose buckets hold fewer Gaussians than it; export or download it again",
}


@pytest.mark.parametrize(("data", "message"), list(DAMAGED.items()), ids=list(DAMAGED.values()))
def test_damaged_ksplat(data, message):
    with pytest.raises((InvalidSceneError, UnsupportedError)) as error:
        read_ksplat(data)
    assert str(error.value).endswith(message)
