"""Oracle: the naive writer (helpers/reference_spz.py), and bytes encoded by hand."""

import gzip
import io
import struct

import numpy as np
import pytest
from helpers.format_scenes import made_scene
from helpers.reference_spz import streams

from kissgs.core.errors import UnsupportedError
from kissgs.core.splats import ATTRIBUTES, Splats, clean
from kissgs.io.spz import (
    SpzInfo,
    encode_colors,
    encode_scales,
    encode_sh,
    encode_smallest_three,
    fractional_bits_for,
    read_spz,
    read_spz_info,
    write_spz,
)


def written(splats, **options):
    """Return a file of the scene once it is cleaned, and the notes."""
    file = io.BytesIO()
    notes = write_spz(file, clean(splats)[0], **options)
    return file.getvalue(), notes


def replaced(splats, **arrays):
    return Splats(**{name: arrays.get(name, getattr(splats, name)) for name in ATTRIBUTES})


@pytest.mark.parametrize(
    ("degree", "count", "raw_axes"), [(0, 1, False), (1, 65, True), (2, 1, True), (3, 65, False), (3, 65, True)]
)
def test_all_streams_but_sh_are_those_of_the_reference(degree, count, raw_axes):
    scene = made_scene(count, degree)
    scene.quats[:4] = np.float32([0.9, 0.1, 0.3, -0.3])  # no two components equally large
    data, _ = written(scene, raw_axes=raw_axes)
    bits = fractional_bits_for(float(np.abs(scene.means).max()))
    assert read_spz_info(data) == SpzInfo(
        version=3,
        count=count,
        sh_degree=degree,
        stored_degree=degree,
        fractional_bits=bits,
        antialiased=False,
        extensions=False,
    )
    body = gzip.decompress(data)[16:]
    for wanted in streams(clean(scene)[0], 3, bits, not raw_axes)[:5]:
        # The reference rounds halves to even.
        found, body = np.frombuffer(body[: len(wanted)], np.uint8), body[len(wanted) :]
        assert np.abs(found.astype(int) - np.frombuffer(wanted, np.uint8)).max(initial=0) <= 1
        assert (found == np.frombuffer(wanted, np.uint8)).mean() > 0.99
    assert len(body) == 3 * count * (0, 3, 8, 15)[degree]


def test_values_by_hand():
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


def test_positions_by_hand():
    scene = replaced(made_scene(1, 0), means=np.float32([[-1, 0.5, 2048 - 2**-12]]))
    assert gzip.decompress(written(scene, raw_axes=True)[0])[16:25] == bytes.fromhex("00f0ff 000800 ffff7f")


@pytest.mark.parametrize(
    ("reach", "bits"),
    [(2047.9, 12), (2048, 11), (4096, 10), (5, 12), (3.9, 13), (1e-9, 23), (0, 15), (8.3e6, 0), (1e15, 0)],
)
def test_fractional_bits_follow_the_extent(reach, bits):
    assert fractional_bits_for(reach) == bits


@pytest.mark.parametrize("reach", [0.01, 100, 2048, 8e6])
def test_scenes_of_any_extent(reach):
    scene = made_scene(100, 0, extremes=False)
    scene.means[:] = scene.means / np.abs(scene.means).max() * np.float32(reach)
    data, notes = written(scene)
    bits = read_spz_info(data).fractional_bits
    # The largest code has no step above it.
    np.testing.assert_allclose(read_spz(data).means, scene.means, atol=2.0**-bits, rtol=1e-7)
    assert reach / 2.0**-bits >= 2**14
    assert bool(notes) == (reach >= 2048)


def test_what_the_format_cannot_hold_is_in_the_notes():
    scene = clean(made_scene(20, 1, extremes=False))[0]
    assert written(replaced(scene, shN=np.clip(scene.shN, -1, 0.9)))[1] == ()
    scene.means[0] = 3e4
    scene.means[1] = -1e14
    scene.scales[:3] = [[-11, 0, 0], [0, 6, 0], [-10, 0, 5.95]]
    scene.sh0[:2] = [[4, 0, 0], [-3.35, 0, 0]]
    scene.shN[:] = 0
    scene.shN[5] = 1.5
    assert written(scene)[1] == (
        "positions have steps of 1, because the scene reaches 100,000,000,376,832 from the origin",
        "positions of 1 Gaussian are clamped to ±8,388,607",
        "scales of 2 Gaussians are clamped to e^-10 to e^5.94",
        "colours of 2 Gaussians are clamped to coefficients of ±3.33",
        "view-dependent colours of 1 Gaussian are clamped to coefficients of ±1",
    )


def test_saturated_opacities_are_bytes_0_and_255():
    scene = replaced(made_scene(2, 0), opacities=np.float32([-np.inf, np.inf]))
    data, _ = written(scene)
    assert gzip.decompress(data)[16 + 18 : 16 + 20] == b"\x00\xff"
    np.testing.assert_allclose(read_spz(data).opacities, clean(scene)[0].opacities)


def test_a_scene_without_gaussians_is_refused():
    message = r"^a scene without Gaussians cannot be written as \.spz; write it as \.ply$"
    with pytest.raises(UnsupportedError, match=message):
        written(made_scene(0, 1))


def test_bytes_are_the_same_again_and_the_scene_is_unchanged():
    scene = clean(made_scene(70, 3))[0]
    before = {name: getattr(scene, name).copy() for name in ATTRIBUTES}
    data = written(scene)[0]
    assert data == written(scene)[0]
    assert data[:4] == b"\x1f\x8b\x08\0"
    assert struct.unpack_from("<I", data, 4) == (0,), "gzip's time"
    for name, values in before.items():
        np.testing.assert_array_equal(getattr(scene, name), values)
